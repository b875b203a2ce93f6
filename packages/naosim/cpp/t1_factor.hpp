// Written by topology.py; included by humanoid_dynamics.hpp within its namespace.
inline void factor_tree(Real* __restrict H, Real* __restrict inv) {
  Real D[29];
  {
    Real a0 = H[406], a1 = H[407], a2 = H[408], a3 = H[409], a4 = H[410], a5 = H[411], a16 = H[422], a23 = H[429], a24 = H[430], a25 = H[431], a26 = H[432], a27 = H[433], a28 = H[434];
    const Real iv = 1.0 / a28; D[28] = a28; inv[28] = iv;
    H[406] = a0 * iv; H[407] = a1 * iv; H[408] = a2 * iv; H[409] = a3 * iv; H[410] = a4 * iv; H[411] = a5 * iv; H[422] = a16 * iv; H[429] = a23 * iv; H[430] = a24 * iv; H[431] = a25 * iv; H[432] = a26 * iv; H[433] = a27 * iv;
  }
  {
    Real a0 = H[378], a1 = H[379], a2 = H[380], a3 = H[381], a4 = H[382], a5 = H[383], a16 = H[394], a23 = H[401], a24 = H[402], a25 = H[403], a26 = H[404], a27 = H[405];
    { const Real f = H[433] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; a26 -= f * H[432]; a27 -= f * H[433]; }
    const Real iv = 1.0 / a27; D[27] = a27; inv[27] = iv;
    H[378] = a0 * iv; H[379] = a1 * iv; H[380] = a2 * iv; H[381] = a3 * iv; H[382] = a4 * iv; H[383] = a5 * iv; H[394] = a16 * iv; H[401] = a23 * iv; H[402] = a24 * iv; H[403] = a25 * iv; H[404] = a26 * iv;
  }
  {
    Real a0 = H[351], a1 = H[352], a2 = H[353], a3 = H[354], a4 = H[355], a5 = H[356], a16 = H[367], a23 = H[374], a24 = H[375], a25 = H[376], a26 = H[377];
    { const Real f = H[432] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; a26 -= f * H[432]; }
    { const Real f = H[404] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; a25 -= f * H[403]; a26 -= f * H[404]; }
    const Real iv = 1.0 / a26; D[26] = a26; inv[26] = iv;
    H[351] = a0 * iv; H[352] = a1 * iv; H[353] = a2 * iv; H[354] = a3 * iv; H[355] = a4 * iv; H[356] = a5 * iv; H[367] = a16 * iv; H[374] = a23 * iv; H[375] = a24 * iv; H[376] = a25 * iv;
  }
  {
    Real a0 = H[325], a1 = H[326], a2 = H[327], a3 = H[328], a4 = H[329], a5 = H[330], a16 = H[341], a23 = H[348], a24 = H[349], a25 = H[350];
    { const Real f = H[431] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; }
    { const Real f = H[403] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; a25 -= f * H[403]; }
    { const Real f = H[376] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; a24 -= f * H[375]; a25 -= f * H[376]; }
    const Real iv = 1.0 / a25; D[25] = a25; inv[25] = iv;
    H[325] = a0 * iv; H[326] = a1 * iv; H[327] = a2 * iv; H[328] = a3 * iv; H[329] = a4 * iv; H[330] = a5 * iv; H[341] = a16 * iv; H[348] = a23 * iv; H[349] = a24 * iv;
  }
  {
    Real a0 = H[300], a1 = H[301], a2 = H[302], a3 = H[303], a4 = H[304], a5 = H[305], a16 = H[316], a23 = H[323], a24 = H[324];
    { const Real f = H[430] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; }
    { const Real f = H[402] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; }
    { const Real f = H[375] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; a24 -= f * H[375]; }
    { const Real f = H[349] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; a23 -= f * H[348]; a24 -= f * H[349]; }
    const Real iv = 1.0 / a24; D[24] = a24; inv[24] = iv;
    H[300] = a0 * iv; H[301] = a1 * iv; H[302] = a2 * iv; H[303] = a3 * iv; H[304] = a4 * iv; H[305] = a5 * iv; H[316] = a16 * iv; H[323] = a23 * iv;
  }
  {
    Real a0 = H[276], a1 = H[277], a2 = H[278], a3 = H[279], a4 = H[280], a5 = H[281], a16 = H[292], a23 = H[299];
    { const Real f = H[429] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; }
    { const Real f = H[401] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; }
    { const Real f = H[374] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; }
    { const Real f = H[348] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; a23 -= f * H[348]; }
    { const Real f = H[323] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a16 -= f * H[316]; a23 -= f * H[323]; }
    const Real iv = 1.0 / a23; D[23] = a23; inv[23] = iv;
    H[276] = a0 * iv; H[277] = a1 * iv; H[278] = a2 * iv; H[279] = a3 * iv; H[280] = a4 * iv; H[281] = a5 * iv; H[292] = a16 * iv;
  }
  {
    Real a0 = H[253], a1 = H[254], a2 = H[255], a3 = H[256], a4 = H[257], a5 = H[258], a16 = H[269], a17 = H[270], a18 = H[271], a19 = H[272], a20 = H[273], a21 = H[274], a22 = H[275];
    const Real iv = 1.0 / a22; D[22] = a22; inv[22] = iv;
    H[253] = a0 * iv; H[254] = a1 * iv; H[255] = a2 * iv; H[256] = a3 * iv; H[257] = a4 * iv; H[258] = a5 * iv; H[269] = a16 * iv; H[270] = a17 * iv; H[271] = a18 * iv; H[272] = a19 * iv; H[273] = a20 * iv; H[274] = a21 * iv;
  }
  {
    Real a0 = H[231], a1 = H[232], a2 = H[233], a3 = H[234], a4 = H[235], a5 = H[236], a16 = H[247], a17 = H[248], a18 = H[249], a19 = H[250], a20 = H[251], a21 = H[252];
    { const Real f = H[274] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; a20 -= f * H[273]; a21 -= f * H[274]; }
    const Real iv = 1.0 / a21; D[21] = a21; inv[21] = iv;
    H[231] = a0 * iv; H[232] = a1 * iv; H[233] = a2 * iv; H[234] = a3 * iv; H[235] = a4 * iv; H[236] = a5 * iv; H[247] = a16 * iv; H[248] = a17 * iv; H[249] = a18 * iv; H[250] = a19 * iv; H[251] = a20 * iv;
  }
  {
    Real a0 = H[210], a1 = H[211], a2 = H[212], a3 = H[213], a4 = H[214], a5 = H[215], a16 = H[226], a17 = H[227], a18 = H[228], a19 = H[229], a20 = H[230];
    { const Real f = H[273] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; a20 -= f * H[273]; }
    { const Real f = H[251] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; a19 -= f * H[250]; a20 -= f * H[251]; }
    const Real iv = 1.0 / a20; D[20] = a20; inv[20] = iv;
    H[210] = a0 * iv; H[211] = a1 * iv; H[212] = a2 * iv; H[213] = a3 * iv; H[214] = a4 * iv; H[215] = a5 * iv; H[226] = a16 * iv; H[227] = a17 * iv; H[228] = a18 * iv; H[229] = a19 * iv;
  }
  {
    Real a0 = H[190], a1 = H[191], a2 = H[192], a3 = H[193], a4 = H[194], a5 = H[195], a16 = H[206], a17 = H[207], a18 = H[208], a19 = H[209];
    { const Real f = H[272] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; }
    { const Real f = H[250] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; a19 -= f * H[250]; }
    { const Real f = H[229] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; a18 -= f * H[228]; a19 -= f * H[229]; }
    const Real iv = 1.0 / a19; D[19] = a19; inv[19] = iv;
    H[190] = a0 * iv; H[191] = a1 * iv; H[192] = a2 * iv; H[193] = a3 * iv; H[194] = a4 * iv; H[195] = a5 * iv; H[206] = a16 * iv; H[207] = a17 * iv; H[208] = a18 * iv;
  }
  {
    Real a0 = H[171], a1 = H[172], a2 = H[173], a3 = H[174], a4 = H[175], a5 = H[176], a16 = H[187], a17 = H[188], a18 = H[189];
    { const Real f = H[271] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; }
    { const Real f = H[249] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; }
    { const Real f = H[228] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; a18 -= f * H[228]; }
    { const Real f = H[208] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; a17 -= f * H[207]; a18 -= f * H[208]; }
    const Real iv = 1.0 / a18; D[18] = a18; inv[18] = iv;
    H[171] = a0 * iv; H[172] = a1 * iv; H[173] = a2 * iv; H[174] = a3 * iv; H[175] = a4 * iv; H[176] = a5 * iv; H[187] = a16 * iv; H[188] = a17 * iv;
  }
  {
    Real a0 = H[153], a1 = H[154], a2 = H[155], a3 = H[156], a4 = H[157], a5 = H[158], a16 = H[169], a17 = H[170];
    { const Real f = H[270] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; }
    { const Real f = H[248] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; }
    { const Real f = H[227] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; }
    { const Real f = H[207] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; a17 -= f * H[207]; }
    { const Real f = H[188] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a16 -= f * H[187]; a17 -= f * H[188]; }
    const Real iv = 1.0 / a17; D[17] = a17; inv[17] = iv;
    H[153] = a0 * iv; H[154] = a1 * iv; H[155] = a2 * iv; H[156] = a3 * iv; H[157] = a4 * iv; H[158] = a5 * iv; H[169] = a16 * iv;
  }
  {
    Real a0 = H[136], a1 = H[137], a2 = H[138], a3 = H[139], a4 = H[140], a5 = H[141], a16 = H[152];
    { const Real f = H[422] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; }
    { const Real f = H[394] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; }
    { const Real f = H[367] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; }
    { const Real f = H[341] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; }
    { const Real f = H[316] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a16 -= f * H[316]; }
    { const Real f = H[292] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a16 -= f * H[292]; }
    { const Real f = H[269] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; }
    { const Real f = H[247] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; }
    { const Real f = H[226] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; }
    { const Real f = H[206] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; }
    { const Real f = H[187] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a16 -= f * H[187]; }
    { const Real f = H[169] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a16 -= f * H[169]; }
    const Real iv = 1.0 / a16; D[16] = a16; inv[16] = iv;
    H[136] = a0 * iv; H[137] = a1 * iv; H[138] = a2 * iv; H[139] = a3 * iv; H[140] = a4 * iv; H[141] = a5 * iv;
  }
  {
    Real a0 = H[120], a1 = H[121], a2 = H[122], a3 = H[123], a4 = H[124], a5 = H[125], a12 = H[132], a13 = H[133], a14 = H[134], a15 = H[135];
    const Real iv = 1.0 / a15; D[15] = a15; inv[15] = iv;
    H[120] = a0 * iv; H[121] = a1 * iv; H[122] = a2 * iv; H[123] = a3 * iv; H[124] = a4 * iv; H[125] = a5 * iv; H[132] = a12 * iv; H[133] = a13 * iv; H[134] = a14 * iv;
  }
  {
    Real a0 = H[105], a1 = H[106], a2 = H[107], a3 = H[108], a4 = H[109], a5 = H[110], a12 = H[117], a13 = H[118], a14 = H[119];
    { const Real f = H[134] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a12 -= f * H[132]; a13 -= f * H[133]; a14 -= f * H[134]; }
    const Real iv = 1.0 / a14; D[14] = a14; inv[14] = iv;
    H[105] = a0 * iv; H[106] = a1 * iv; H[107] = a2 * iv; H[108] = a3 * iv; H[109] = a4 * iv; H[110] = a5 * iv; H[117] = a12 * iv; H[118] = a13 * iv;
  }
  {
    Real a0 = H[91], a1 = H[92], a2 = H[93], a3 = H[94], a4 = H[95], a5 = H[96], a12 = H[103], a13 = H[104];
    { const Real f = H[133] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a12 -= f * H[132]; a13 -= f * H[133]; }
    { const Real f = H[118] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a12 -= f * H[117]; a13 -= f * H[118]; }
    const Real iv = 1.0 / a13; D[13] = a13; inv[13] = iv;
    H[91] = a0 * iv; H[92] = a1 * iv; H[93] = a2 * iv; H[94] = a3 * iv; H[95] = a4 * iv; H[96] = a5 * iv; H[103] = a12 * iv;
  }
  {
    Real a0 = H[78], a1 = H[79], a2 = H[80], a3 = H[81], a4 = H[82], a5 = H[83], a12 = H[90];
    { const Real f = H[132] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a12 -= f * H[132]; }
    { const Real f = H[117] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a12 -= f * H[117]; }
    { const Real f = H[103] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a12 -= f * H[103]; }
    const Real iv = 1.0 / a12; D[12] = a12; inv[12] = iv;
    H[78] = a0 * iv; H[79] = a1 * iv; H[80] = a2 * iv; H[81] = a3 * iv; H[82] = a4 * iv; H[83] = a5 * iv;
  }
  {
    Real a0 = H[66], a1 = H[67], a2 = H[68], a3 = H[69], a4 = H[70], a5 = H[71], a8 = H[74], a9 = H[75], a10 = H[76], a11 = H[77];
    const Real iv = 1.0 / a11; D[11] = a11; inv[11] = iv;
    H[66] = a0 * iv; H[67] = a1 * iv; H[68] = a2 * iv; H[69] = a3 * iv; H[70] = a4 * iv; H[71] = a5 * iv; H[74] = a8 * iv; H[75] = a9 * iv; H[76] = a10 * iv;
  }
  {
    Real a0 = H[55], a1 = H[56], a2 = H[57], a3 = H[58], a4 = H[59], a5 = H[60], a8 = H[63], a9 = H[64], a10 = H[65];
    { const Real f = H[76] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; a9 -= f * H[75]; a10 -= f * H[76]; }
    const Real iv = 1.0 / a10; D[10] = a10; inv[10] = iv;
    H[55] = a0 * iv; H[56] = a1 * iv; H[57] = a2 * iv; H[58] = a3 * iv; H[59] = a4 * iv; H[60] = a5 * iv; H[63] = a8 * iv; H[64] = a9 * iv;
  }
  {
    Real a0 = H[45], a1 = H[46], a2 = H[47], a3 = H[48], a4 = H[49], a5 = H[50], a8 = H[53], a9 = H[54];
    { const Real f = H[75] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; a9 -= f * H[75]; }
    { const Real f = H[64] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; a8 -= f * H[63]; a9 -= f * H[64]; }
    const Real iv = 1.0 / a9; D[9] = a9; inv[9] = iv;
    H[45] = a0 * iv; H[46] = a1 * iv; H[47] = a2 * iv; H[48] = a3 * iv; H[49] = a4 * iv; H[50] = a5 * iv; H[53] = a8 * iv;
  }
  {
    Real a0 = H[36], a1 = H[37], a2 = H[38], a3 = H[39], a4 = H[40], a5 = H[41], a8 = H[44];
    { const Real f = H[74] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; }
    { const Real f = H[63] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; a8 -= f * H[63]; }
    { const Real f = H[53] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; a5 -= f * H[50]; a8 -= f * H[53]; }
    const Real iv = 1.0 / a8; D[8] = a8; inv[8] = iv;
    H[36] = a0 * iv; H[37] = a1 * iv; H[38] = a2 * iv; H[39] = a3 * iv; H[40] = a4 * iv; H[41] = a5 * iv;
  }
  {
    Real a0 = H[28], a1 = H[29], a2 = H[30], a3 = H[31], a4 = H[32], a5 = H[33], a6 = H[34], a7 = H[35];
    const Real iv = 1.0 / a7; D[7] = a7; inv[7] = iv;
    H[28] = a0 * iv; H[29] = a1 * iv; H[30] = a2 * iv; H[31] = a3 * iv; H[32] = a4 * iv; H[33] = a5 * iv; H[34] = a6 * iv;
  }
  {
    Real a0 = H[21], a1 = H[22], a2 = H[23], a3 = H[24], a4 = H[25], a5 = H[26], a6 = H[27];
    { const Real f = H[34] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; a5 -= f * H[33]; a6 -= f * H[34]; }
    const Real iv = 1.0 / a6; D[6] = a6; inv[6] = iv;
    H[21] = a0 * iv; H[22] = a1 * iv; H[23] = a2 * iv; H[24] = a3 * iv; H[25] = a4 * iv; H[26] = a5 * iv;
  }
  {
    Real a0 = H[15], a1 = H[16], a2 = H[17], a3 = H[18], a4 = H[19], a5 = H[20];
    { const Real f = H[411] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; }
    { const Real f = H[383] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; }
    { const Real f = H[356] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; }
    { const Real f = H[330] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; }
    { const Real f = H[305] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; }
    { const Real f = H[281] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; }
    { const Real f = H[258] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; }
    { const Real f = H[236] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; }
    { const Real f = H[215] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; }
    { const Real f = H[195] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; }
    { const Real f = H[176] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; }
    { const Real f = H[158] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; }
    { const Real f = H[141] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; }
    { const Real f = H[125] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; }
    { const Real f = H[110] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; }
    { const Real f = H[96] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; }
    { const Real f = H[83] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; }
    { const Real f = H[71] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; }
    { const Real f = H[60] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; }
    { const Real f = H[50] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; a5 -= f * H[50]; }
    { const Real f = H[41] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; a4 -= f * H[40]; a5 -= f * H[41]; }
    { const Real f = H[33] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; a5 -= f * H[33]; }
    { const Real f = H[26] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; a4 -= f * H[25]; a5 -= f * H[26]; }
    const Real iv = 1.0 / a5; D[5] = a5; inv[5] = iv;
    H[15] = a0 * iv; H[16] = a1 * iv; H[17] = a2 * iv; H[18] = a3 * iv; H[19] = a4 * iv;
  }
  {
    Real a0 = H[10], a1 = H[11], a2 = H[12], a3 = H[13], a4 = H[14];
    { const Real f = H[410] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; }
    { const Real f = H[382] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; }
    { const Real f = H[355] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; }
    { const Real f = H[329] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; }
    { const Real f = H[304] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; }
    { const Real f = H[280] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; }
    { const Real f = H[257] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; }
    { const Real f = H[235] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; }
    { const Real f = H[214] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; }
    { const Real f = H[194] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; }
    { const Real f = H[175] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; }
    { const Real f = H[157] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; }
    { const Real f = H[140] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; }
    { const Real f = H[124] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; }
    { const Real f = H[109] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; }
    { const Real f = H[95] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; }
    { const Real f = H[82] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; }
    { const Real f = H[70] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; }
    { const Real f = H[59] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; }
    { const Real f = H[49] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; }
    { const Real f = H[40] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; a4 -= f * H[40]; }
    { const Real f = H[32] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; }
    { const Real f = H[25] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; a4 -= f * H[25]; }
    { const Real f = H[19] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; a3 -= f * H[18]; a4 -= f * H[19]; }
    const Real iv = 1.0 / a4; D[4] = a4; inv[4] = iv;
    H[10] = a0 * iv; H[11] = a1 * iv; H[12] = a2 * iv; H[13] = a3 * iv;
  }
  {
    Real a0 = H[6], a1 = H[7], a2 = H[8], a3 = H[9];
    { const Real f = H[409] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; }
    { const Real f = H[381] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; }
    { const Real f = H[354] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; }
    { const Real f = H[328] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; }
    { const Real f = H[303] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; }
    { const Real f = H[279] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; }
    { const Real f = H[256] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; }
    { const Real f = H[234] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; }
    { const Real f = H[213] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; }
    { const Real f = H[193] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; }
    { const Real f = H[174] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; }
    { const Real f = H[156] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; }
    { const Real f = H[139] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; }
    { const Real f = H[123] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; }
    { const Real f = H[108] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; }
    { const Real f = H[94] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; }
    { const Real f = H[81] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; }
    { const Real f = H[69] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; }
    { const Real f = H[58] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; }
    { const Real f = H[48] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; }
    { const Real f = H[39] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; }
    { const Real f = H[31] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; }
    { const Real f = H[24] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; }
    { const Real f = H[18] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; a3 -= f * H[18]; }
    { const Real f = H[13] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; a2 -= f * H[12]; a3 -= f * H[13]; }
    const Real iv = 1.0 / a3; D[3] = a3; inv[3] = iv;
    H[6] = a0 * iv; H[7] = a1 * iv; H[8] = a2 * iv;
  }
  {
    Real a0 = H[3], a1 = H[4], a2 = H[5];
    { const Real f = H[408] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; }
    { const Real f = H[380] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; }
    { const Real f = H[353] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; }
    { const Real f = H[327] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; }
    { const Real f = H[302] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; }
    { const Real f = H[278] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; }
    { const Real f = H[255] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; }
    { const Real f = H[233] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; }
    { const Real f = H[212] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; }
    { const Real f = H[192] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; }
    { const Real f = H[173] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; }
    { const Real f = H[155] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; }
    { const Real f = H[138] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; }
    { const Real f = H[122] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; }
    { const Real f = H[107] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; }
    { const Real f = H[93] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; }
    { const Real f = H[80] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; }
    { const Real f = H[68] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; }
    { const Real f = H[57] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; }
    { const Real f = H[47] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; }
    { const Real f = H[38] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; }
    { const Real f = H[30] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; }
    { const Real f = H[23] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; }
    { const Real f = H[17] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; }
    { const Real f = H[12] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; a2 -= f * H[12]; }
    { const Real f = H[8] * D[3]; a0 -= f * H[6]; a1 -= f * H[7]; a2 -= f * H[8]; }
    const Real iv = 1.0 / a2; D[2] = a2; inv[2] = iv;
    H[3] = a0 * iv; H[4] = a1 * iv;
  }
  {
    Real a0 = H[1], a1 = H[2];
    { const Real f = H[407] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; }
    { const Real f = H[379] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; }
    { const Real f = H[352] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; }
    { const Real f = H[326] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; }
    { const Real f = H[301] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; }
    { const Real f = H[277] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; }
    { const Real f = H[254] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; }
    { const Real f = H[232] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; }
    { const Real f = H[211] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; }
    { const Real f = H[191] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; }
    { const Real f = H[172] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; }
    { const Real f = H[154] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; }
    { const Real f = H[137] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; }
    { const Real f = H[121] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; }
    { const Real f = H[106] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; }
    { const Real f = H[92] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; }
    { const Real f = H[79] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; }
    { const Real f = H[67] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; }
    { const Real f = H[56] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; }
    { const Real f = H[46] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; }
    { const Real f = H[37] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; }
    { const Real f = H[29] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; }
    { const Real f = H[22] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; }
    { const Real f = H[16] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; }
    { const Real f = H[11] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; }
    { const Real f = H[7] * D[3]; a0 -= f * H[6]; a1 -= f * H[7]; }
    { const Real f = H[4] * D[2]; a0 -= f * H[3]; a1 -= f * H[4]; }
    const Real iv = 1.0 / a1; D[1] = a1; inv[1] = iv;
    H[1] = a0 * iv;
  }
  {
    Real a0 = H[0];
    { const Real f = H[406] * D[28]; a0 -= f * H[406]; }
    { const Real f = H[378] * D[27]; a0 -= f * H[378]; }
    { const Real f = H[351] * D[26]; a0 -= f * H[351]; }
    { const Real f = H[325] * D[25]; a0 -= f * H[325]; }
    { const Real f = H[300] * D[24]; a0 -= f * H[300]; }
    { const Real f = H[276] * D[23]; a0 -= f * H[276]; }
    { const Real f = H[253] * D[22]; a0 -= f * H[253]; }
    { const Real f = H[231] * D[21]; a0 -= f * H[231]; }
    { const Real f = H[210] * D[20]; a0 -= f * H[210]; }
    { const Real f = H[190] * D[19]; a0 -= f * H[190]; }
    { const Real f = H[171] * D[18]; a0 -= f * H[171]; }
    { const Real f = H[153] * D[17]; a0 -= f * H[153]; }
    { const Real f = H[136] * D[16]; a0 -= f * H[136]; }
    { const Real f = H[120] * D[15]; a0 -= f * H[120]; }
    { const Real f = H[105] * D[14]; a0 -= f * H[105]; }
    { const Real f = H[91] * D[13]; a0 -= f * H[91]; }
    { const Real f = H[78] * D[12]; a0 -= f * H[78]; }
    { const Real f = H[66] * D[11]; a0 -= f * H[66]; }
    { const Real f = H[55] * D[10]; a0 -= f * H[55]; }
    { const Real f = H[45] * D[9]; a0 -= f * H[45]; }
    { const Real f = H[36] * D[8]; a0 -= f * H[36]; }
    { const Real f = H[28] * D[7]; a0 -= f * H[28]; }
    { const Real f = H[21] * D[6]; a0 -= f * H[21]; }
    { const Real f = H[15] * D[5]; a0 -= f * H[15]; }
    { const Real f = H[10] * D[4]; a0 -= f * H[10]; }
    { const Real f = H[6] * D[3]; a0 -= f * H[6]; }
    { const Real f = H[3] * D[2]; a0 -= f * H[3]; }
    { const Real f = H[1] * D[1]; a0 -= f * H[1]; }
    const Real iv = 1.0 / a0; D[0] = a0; inv[0] = iv;
    
  }
}
inline void solve_tree(const Real* __restrict H, const Real* __restrict inv, Real* __restrict x) {
  { Real s = x[27], t = splat(0); s -= H[433] * x[28]; x[27] = s - t; }
  { Real s = x[26], t = splat(0); s -= H[432] * x[28]; t += H[404] * x[27]; x[26] = s - t; }
  { Real s = x[25], t = splat(0); s -= H[431] * x[28]; s -= H[376] * x[26]; t += H[403] * x[27]; x[25] = s - t; }
  { Real s = x[24], t = splat(0); s -= H[430] * x[28]; s -= H[375] * x[26]; t += H[402] * x[27]; t += H[349] * x[25]; x[24] = s - t; }
  { Real s = x[23], t = splat(0); s -= H[429] * x[28]; s -= H[374] * x[26]; s -= H[323] * x[24]; t += H[401] * x[27]; t += H[348] * x[25]; x[23] = s - t; }
  { Real s = x[21], t = splat(0); s -= H[274] * x[22]; x[21] = s - t; }
  { Real s = x[20], t = splat(0); s -= H[273] * x[22]; t += H[251] * x[21]; x[20] = s - t; }
  { Real s = x[19], t = splat(0); s -= H[272] * x[22]; s -= H[229] * x[20]; t += H[250] * x[21]; x[19] = s - t; }
  { Real s = x[18], t = splat(0); s -= H[271] * x[22]; s -= H[228] * x[20]; t += H[249] * x[21]; t += H[208] * x[19]; x[18] = s - t; }
  { Real s = x[17], t = splat(0); s -= H[270] * x[22]; s -= H[227] * x[20]; s -= H[188] * x[18]; t += H[248] * x[21]; t += H[207] * x[19]; x[17] = s - t; }
  { Real s = x[16], t = splat(0); s -= H[422] * x[28]; s -= H[367] * x[26]; s -= H[316] * x[24]; s -= H[269] * x[22]; s -= H[226] * x[20]; s -= H[187] * x[18]; t += H[394] * x[27]; t += H[341] * x[25]; t += H[292] * x[23]; t += H[247] * x[21]; t += H[206] * x[19]; t += H[169] * x[17]; x[16] = s - t; }
  { Real s = x[14], t = splat(0); t += H[134] * x[15]; x[14] = s - t; }
  { Real s = x[13], t = splat(0); s -= H[118] * x[14]; t += H[133] * x[15]; x[13] = s - t; }
  { Real s = x[12], t = splat(0); s -= H[117] * x[14]; t += H[132] * x[15]; t += H[103] * x[13]; x[12] = s - t; }
  { Real s = x[10], t = splat(0); t += H[76] * x[11]; x[10] = s - t; }
  { Real s = x[9], t = splat(0); s -= H[64] * x[10]; t += H[75] * x[11]; x[9] = s - t; }
  { Real s = x[8], t = splat(0); s -= H[63] * x[10]; t += H[74] * x[11]; t += H[53] * x[9]; x[8] = s - t; }
  { Real s = x[6], t = splat(0); t += H[34] * x[7]; x[6] = s - t; }
  { Real s = x[5], t = splat(0); s -= H[411] * x[28]; s -= H[356] * x[26]; s -= H[305] * x[24]; s -= H[258] * x[22]; s -= H[215] * x[20]; s -= H[176] * x[18]; s -= H[141] * x[16]; s -= H[110] * x[14]; s -= H[83] * x[12]; s -= H[60] * x[10]; s -= H[41] * x[8]; s -= H[26] * x[6]; t += H[383] * x[27]; t += H[330] * x[25]; t += H[281] * x[23]; t += H[236] * x[21]; t += H[195] * x[19]; t += H[158] * x[17]; t += H[125] * x[15]; t += H[96] * x[13]; t += H[71] * x[11]; t += H[50] * x[9]; t += H[33] * x[7]; x[5] = s - t; }
  { Real s = x[4], t = splat(0); s -= H[410] * x[28]; s -= H[355] * x[26]; s -= H[304] * x[24]; s -= H[257] * x[22]; s -= H[214] * x[20]; s -= H[175] * x[18]; s -= H[140] * x[16]; s -= H[109] * x[14]; s -= H[82] * x[12]; s -= H[59] * x[10]; s -= H[40] * x[8]; s -= H[25] * x[6]; t += H[382] * x[27]; t += H[329] * x[25]; t += H[280] * x[23]; t += H[235] * x[21]; t += H[194] * x[19]; t += H[157] * x[17]; t += H[124] * x[15]; t += H[95] * x[13]; t += H[70] * x[11]; t += H[49] * x[9]; t += H[32] * x[7]; t += H[19] * x[5]; x[4] = s - t; }
  { Real s = x[3], t = splat(0); s -= H[409] * x[28]; s -= H[354] * x[26]; s -= H[303] * x[24]; s -= H[256] * x[22]; s -= H[213] * x[20]; s -= H[174] * x[18]; s -= H[139] * x[16]; s -= H[108] * x[14]; s -= H[81] * x[12]; s -= H[58] * x[10]; s -= H[39] * x[8]; s -= H[24] * x[6]; s -= H[13] * x[4]; t += H[381] * x[27]; t += H[328] * x[25]; t += H[279] * x[23]; t += H[234] * x[21]; t += H[193] * x[19]; t += H[156] * x[17]; t += H[123] * x[15]; t += H[94] * x[13]; t += H[69] * x[11]; t += H[48] * x[9]; t += H[31] * x[7]; t += H[18] * x[5]; x[3] = s - t; }
  { Real s = x[2], t = splat(0); s -= H[408] * x[28]; s -= H[353] * x[26]; s -= H[302] * x[24]; s -= H[255] * x[22]; s -= H[212] * x[20]; s -= H[173] * x[18]; s -= H[138] * x[16]; s -= H[107] * x[14]; s -= H[80] * x[12]; s -= H[57] * x[10]; s -= H[38] * x[8]; s -= H[23] * x[6]; s -= H[12] * x[4]; t += H[380] * x[27]; t += H[327] * x[25]; t += H[278] * x[23]; t += H[233] * x[21]; t += H[192] * x[19]; t += H[155] * x[17]; t += H[122] * x[15]; t += H[93] * x[13]; t += H[68] * x[11]; t += H[47] * x[9]; t += H[30] * x[7]; t += H[17] * x[5]; t += H[8] * x[3]; x[2] = s - t; }
  { Real s = x[1], t = splat(0); s -= H[407] * x[28]; s -= H[352] * x[26]; s -= H[301] * x[24]; s -= H[254] * x[22]; s -= H[211] * x[20]; s -= H[172] * x[18]; s -= H[137] * x[16]; s -= H[106] * x[14]; s -= H[79] * x[12]; s -= H[56] * x[10]; s -= H[37] * x[8]; s -= H[22] * x[6]; s -= H[11] * x[4]; s -= H[4] * x[2]; t += H[379] * x[27]; t += H[326] * x[25]; t += H[277] * x[23]; t += H[232] * x[21]; t += H[191] * x[19]; t += H[154] * x[17]; t += H[121] * x[15]; t += H[92] * x[13]; t += H[67] * x[11]; t += H[46] * x[9]; t += H[29] * x[7]; t += H[16] * x[5]; t += H[7] * x[3]; x[1] = s - t; }
  { Real s = x[0], t = splat(0); s -= H[406] * x[28]; s -= H[351] * x[26]; s -= H[300] * x[24]; s -= H[253] * x[22]; s -= H[210] * x[20]; s -= H[171] * x[18]; s -= H[136] * x[16]; s -= H[105] * x[14]; s -= H[78] * x[12]; s -= H[55] * x[10]; s -= H[36] * x[8]; s -= H[21] * x[6]; s -= H[10] * x[4]; s -= H[3] * x[2]; t += H[378] * x[27]; t += H[325] * x[25]; t += H[276] * x[23]; t += H[231] * x[21]; t += H[190] * x[19]; t += H[153] * x[17]; t += H[120] * x[15]; t += H[91] * x[13]; t += H[66] * x[11]; t += H[45] * x[9]; t += H[28] * x[7]; t += H[15] * x[5]; t += H[6] * x[3]; t += H[1] * x[1]; x[0] = s - t; }
  for (int i = 0; i < 29; ++i) x[i] *= inv[i];
  { Real s = x[1], t = splat(0); s -= H[1] * x[0]; x[1] = s - t; }
  { Real s = x[2], t = splat(0); s -= H[3] * x[0]; t += H[4] * x[1]; x[2] = s - t; }
  { Real s = x[3], t = splat(0); s -= H[6] * x[0]; s -= H[8] * x[2]; t += H[7] * x[1]; x[3] = s - t; }
  { Real s = x[4], t = splat(0); s -= H[10] * x[0]; s -= H[12] * x[2]; t += H[11] * x[1]; t += H[13] * x[3]; x[4] = s - t; }
  { Real s = x[5], t = splat(0); s -= H[15] * x[0]; s -= H[17] * x[2]; s -= H[19] * x[4]; t += H[16] * x[1]; t += H[18] * x[3]; x[5] = s - t; }
  { Real s = x[6], t = splat(0); s -= H[21] * x[0]; s -= H[23] * x[2]; s -= H[25] * x[4]; t += H[22] * x[1]; t += H[24] * x[3]; t += H[26] * x[5]; x[6] = s - t; }
  { Real s = x[7], t = splat(0); s -= H[28] * x[0]; s -= H[30] * x[2]; s -= H[32] * x[4]; s -= H[34] * x[6]; t += H[29] * x[1]; t += H[31] * x[3]; t += H[33] * x[5]; x[7] = s - t; }
  { Real s = x[8], t = splat(0); s -= H[36] * x[0]; s -= H[38] * x[2]; s -= H[40] * x[4]; t += H[37] * x[1]; t += H[39] * x[3]; t += H[41] * x[5]; x[8] = s - t; }
  { Real s = x[9], t = splat(0); s -= H[45] * x[0]; s -= H[47] * x[2]; s -= H[49] * x[4]; s -= H[53] * x[8]; t += H[46] * x[1]; t += H[48] * x[3]; t += H[50] * x[5]; x[9] = s - t; }
  { Real s = x[10], t = splat(0); s -= H[55] * x[0]; s -= H[57] * x[2]; s -= H[59] * x[4]; s -= H[63] * x[8]; t += H[56] * x[1]; t += H[58] * x[3]; t += H[60] * x[5]; t += H[64] * x[9]; x[10] = s - t; }
  { Real s = x[11], t = splat(0); s -= H[66] * x[0]; s -= H[68] * x[2]; s -= H[70] * x[4]; s -= H[74] * x[8]; s -= H[76] * x[10]; t += H[67] * x[1]; t += H[69] * x[3]; t += H[71] * x[5]; t += H[75] * x[9]; x[11] = s - t; }
  { Real s = x[12], t = splat(0); s -= H[78] * x[0]; s -= H[80] * x[2]; s -= H[82] * x[4]; t += H[79] * x[1]; t += H[81] * x[3]; t += H[83] * x[5]; x[12] = s - t; }
  { Real s = x[13], t = splat(0); s -= H[91] * x[0]; s -= H[93] * x[2]; s -= H[95] * x[4]; s -= H[103] * x[12]; t += H[92] * x[1]; t += H[94] * x[3]; t += H[96] * x[5]; x[13] = s - t; }
  { Real s = x[14], t = splat(0); s -= H[105] * x[0]; s -= H[107] * x[2]; s -= H[109] * x[4]; s -= H[117] * x[12]; t += H[106] * x[1]; t += H[108] * x[3]; t += H[110] * x[5]; t += H[118] * x[13]; x[14] = s - t; }
  { Real s = x[15], t = splat(0); s -= H[120] * x[0]; s -= H[122] * x[2]; s -= H[124] * x[4]; s -= H[132] * x[12]; s -= H[134] * x[14]; t += H[121] * x[1]; t += H[123] * x[3]; t += H[125] * x[5]; t += H[133] * x[13]; x[15] = s - t; }
  { Real s = x[16], t = splat(0); s -= H[136] * x[0]; s -= H[138] * x[2]; s -= H[140] * x[4]; t += H[137] * x[1]; t += H[139] * x[3]; t += H[141] * x[5]; x[16] = s - t; }
  { Real s = x[17], t = splat(0); s -= H[153] * x[0]; s -= H[155] * x[2]; s -= H[157] * x[4]; s -= H[169] * x[16]; t += H[154] * x[1]; t += H[156] * x[3]; t += H[158] * x[5]; x[17] = s - t; }
  { Real s = x[18], t = splat(0); s -= H[171] * x[0]; s -= H[173] * x[2]; s -= H[175] * x[4]; s -= H[187] * x[16]; t += H[172] * x[1]; t += H[174] * x[3]; t += H[176] * x[5]; t += H[188] * x[17]; x[18] = s - t; }
  { Real s = x[19], t = splat(0); s -= H[190] * x[0]; s -= H[192] * x[2]; s -= H[194] * x[4]; s -= H[206] * x[16]; s -= H[208] * x[18]; t += H[191] * x[1]; t += H[193] * x[3]; t += H[195] * x[5]; t += H[207] * x[17]; x[19] = s - t; }
  { Real s = x[20], t = splat(0); s -= H[210] * x[0]; s -= H[212] * x[2]; s -= H[214] * x[4]; s -= H[226] * x[16]; s -= H[228] * x[18]; t += H[211] * x[1]; t += H[213] * x[3]; t += H[215] * x[5]; t += H[227] * x[17]; t += H[229] * x[19]; x[20] = s - t; }
  { Real s = x[21], t = splat(0); s -= H[231] * x[0]; s -= H[233] * x[2]; s -= H[235] * x[4]; s -= H[247] * x[16]; s -= H[249] * x[18]; s -= H[251] * x[20]; t += H[232] * x[1]; t += H[234] * x[3]; t += H[236] * x[5]; t += H[248] * x[17]; t += H[250] * x[19]; x[21] = s - t; }
  { Real s = x[22], t = splat(0); s -= H[253] * x[0]; s -= H[255] * x[2]; s -= H[257] * x[4]; s -= H[269] * x[16]; s -= H[271] * x[18]; s -= H[273] * x[20]; t += H[254] * x[1]; t += H[256] * x[3]; t += H[258] * x[5]; t += H[270] * x[17]; t += H[272] * x[19]; t += H[274] * x[21]; x[22] = s - t; }
  { Real s = x[23], t = splat(0); s -= H[276] * x[0]; s -= H[278] * x[2]; s -= H[280] * x[4]; s -= H[292] * x[16]; t += H[277] * x[1]; t += H[279] * x[3]; t += H[281] * x[5]; x[23] = s - t; }
  { Real s = x[24], t = splat(0); s -= H[300] * x[0]; s -= H[302] * x[2]; s -= H[304] * x[4]; s -= H[316] * x[16]; t += H[301] * x[1]; t += H[303] * x[3]; t += H[305] * x[5]; t += H[323] * x[23]; x[24] = s - t; }
  { Real s = x[25], t = splat(0); s -= H[325] * x[0]; s -= H[327] * x[2]; s -= H[329] * x[4]; s -= H[341] * x[16]; s -= H[349] * x[24]; t += H[326] * x[1]; t += H[328] * x[3]; t += H[330] * x[5]; t += H[348] * x[23]; x[25] = s - t; }
  { Real s = x[26], t = splat(0); s -= H[351] * x[0]; s -= H[353] * x[2]; s -= H[355] * x[4]; s -= H[367] * x[16]; s -= H[375] * x[24]; t += H[352] * x[1]; t += H[354] * x[3]; t += H[356] * x[5]; t += H[374] * x[23]; t += H[376] * x[25]; x[26] = s - t; }
  { Real s = x[27], t = splat(0); s -= H[378] * x[0]; s -= H[380] * x[2]; s -= H[382] * x[4]; s -= H[394] * x[16]; s -= H[402] * x[24]; s -= H[404] * x[26]; t += H[379] * x[1]; t += H[381] * x[3]; t += H[383] * x[5]; t += H[401] * x[23]; t += H[403] * x[25]; x[27] = s - t; }
  { Real s = x[28], t = splat(0); s -= H[406] * x[0]; s -= H[408] * x[2]; s -= H[410] * x[4]; s -= H[422] * x[16]; s -= H[430] * x[24]; s -= H[432] * x[26]; t += H[407] * x[1]; t += H[409] * x[3]; t += H[411] * x[5]; t += H[429] * x[23]; t += H[431] * x[25]; t += H[433] * x[27]; x[28] = s - t; }
}
inline void factor_arms(Real* __restrict H, Real* __restrict inv) {
  Real D[29];
  {
    Real a0 = H[406], a1 = H[407], a2 = H[408], a3 = H[409], a4 = H[410], a5 = H[411], a16 = H[422], a23 = H[429], a24 = H[430], a25 = H[431], a26 = H[432], a27 = H[433], a28 = H[434];
    const Real iv = 1.0 / a28; D[28] = a28; inv[28] = iv;
    H[406] = a0 * iv; H[407] = a1 * iv; H[408] = a2 * iv; H[409] = a3 * iv; H[410] = a4 * iv; H[411] = a5 * iv; H[422] = a16 * iv; H[429] = a23 * iv; H[430] = a24 * iv; H[431] = a25 * iv; H[432] = a26 * iv; H[433] = a27 * iv;
  }
  {
    Real a0 = H[378], a1 = H[379], a2 = H[380], a3 = H[381], a4 = H[382], a5 = H[383], a16 = H[394], a23 = H[401], a24 = H[402], a25 = H[403], a26 = H[404], a27 = H[405];
    { const Real f = H[433] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; a26 -= f * H[432]; a27 -= f * H[433]; }
    const Real iv = 1.0 / a27; D[27] = a27; inv[27] = iv;
    H[378] = a0 * iv; H[379] = a1 * iv; H[380] = a2 * iv; H[381] = a3 * iv; H[382] = a4 * iv; H[383] = a5 * iv; H[394] = a16 * iv; H[401] = a23 * iv; H[402] = a24 * iv; H[403] = a25 * iv; H[404] = a26 * iv;
  }
  {
    Real a0 = H[351], a1 = H[352], a2 = H[353], a3 = H[354], a4 = H[355], a5 = H[356], a16 = H[367], a23 = H[374], a24 = H[375], a25 = H[376], a26 = H[377];
    { const Real f = H[432] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; a26 -= f * H[432]; }
    { const Real f = H[404] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; a25 -= f * H[403]; a26 -= f * H[404]; }
    const Real iv = 1.0 / a26; D[26] = a26; inv[26] = iv;
    H[351] = a0 * iv; H[352] = a1 * iv; H[353] = a2 * iv; H[354] = a3 * iv; H[355] = a4 * iv; H[356] = a5 * iv; H[367] = a16 * iv; H[374] = a23 * iv; H[375] = a24 * iv; H[376] = a25 * iv;
  }
  {
    Real a0 = H[325], a1 = H[326], a2 = H[327], a3 = H[328], a4 = H[329], a5 = H[330], a16 = H[341], a23 = H[348], a24 = H[349], a25 = H[350];
    { const Real f = H[431] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; a25 -= f * H[431]; }
    { const Real f = H[403] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; a25 -= f * H[403]; }
    { const Real f = H[376] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; a24 -= f * H[375]; a25 -= f * H[376]; }
    const Real iv = 1.0 / a25; D[25] = a25; inv[25] = iv;
    H[325] = a0 * iv; H[326] = a1 * iv; H[327] = a2 * iv; H[328] = a3 * iv; H[329] = a4 * iv; H[330] = a5 * iv; H[341] = a16 * iv; H[348] = a23 * iv; H[349] = a24 * iv;
  }
  {
    Real a0 = H[300], a1 = H[301], a2 = H[302], a3 = H[303], a4 = H[304], a5 = H[305], a8 = H[308], a9 = H[309], a10 = H[310], a11 = H[311], a12 = H[312], a13 = H[313], a14 = H[314], a15 = H[315], a16 = H[316], a23 = H[323], a24 = H[324];
    { const Real f = H[430] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; a24 -= f * H[430]; }
    { const Real f = H[402] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; a24 -= f * H[402]; }
    { const Real f = H[375] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; a24 -= f * H[375]; }
    { const Real f = H[349] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; a23 -= f * H[348]; a24 -= f * H[349]; }
    const Real iv = 1.0 / a24; D[24] = a24; inv[24] = iv;
    H[300] = a0 * iv; H[301] = a1 * iv; H[302] = a2 * iv; H[303] = a3 * iv; H[304] = a4 * iv; H[305] = a5 * iv; H[308] = a8 * iv; H[309] = a9 * iv; H[310] = a10 * iv; H[311] = a11 * iv; H[312] = a12 * iv; H[313] = a13 * iv; H[314] = a14 * iv; H[315] = a15 * iv; H[316] = a16 * iv; H[323] = a23 * iv;
  }
  {
    Real a0 = H[276], a1 = H[277], a2 = H[278], a3 = H[279], a4 = H[280], a5 = H[281], a8 = H[284], a9 = H[285], a10 = H[286], a11 = H[287], a12 = H[288], a13 = H[289], a14 = H[290], a15 = H[291], a16 = H[292], a23 = H[299];
    { const Real f = H[429] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; a23 -= f * H[429]; }
    { const Real f = H[401] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; a23 -= f * H[401]; }
    { const Real f = H[374] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; a23 -= f * H[374]; }
    { const Real f = H[348] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; a23 -= f * H[348]; }
    { const Real f = H[323] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; a13 -= f * H[313]; a14 -= f * H[314]; a15 -= f * H[315]; a16 -= f * H[316]; a23 -= f * H[323]; }
    const Real iv = 1.0 / a23; D[23] = a23; inv[23] = iv;
    H[276] = a0 * iv; H[277] = a1 * iv; H[278] = a2 * iv; H[279] = a3 * iv; H[280] = a4 * iv; H[281] = a5 * iv; H[284] = a8 * iv; H[285] = a9 * iv; H[286] = a10 * iv; H[287] = a11 * iv; H[288] = a12 * iv; H[289] = a13 * iv; H[290] = a14 * iv; H[291] = a15 * iv; H[292] = a16 * iv;
  }
  {
    Real a0 = H[253], a1 = H[254], a2 = H[255], a3 = H[256], a4 = H[257], a5 = H[258], a16 = H[269], a17 = H[270], a18 = H[271], a19 = H[272], a20 = H[273], a21 = H[274], a22 = H[275];
    const Real iv = 1.0 / a22; D[22] = a22; inv[22] = iv;
    H[253] = a0 * iv; H[254] = a1 * iv; H[255] = a2 * iv; H[256] = a3 * iv; H[257] = a4 * iv; H[258] = a5 * iv; H[269] = a16 * iv; H[270] = a17 * iv; H[271] = a18 * iv; H[272] = a19 * iv; H[273] = a20 * iv; H[274] = a21 * iv;
  }
  {
    Real a0 = H[231], a1 = H[232], a2 = H[233], a3 = H[234], a4 = H[235], a5 = H[236], a16 = H[247], a17 = H[248], a18 = H[249], a19 = H[250], a20 = H[251], a21 = H[252];
    { const Real f = H[274] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; a20 -= f * H[273]; a21 -= f * H[274]; }
    const Real iv = 1.0 / a21; D[21] = a21; inv[21] = iv;
    H[231] = a0 * iv; H[232] = a1 * iv; H[233] = a2 * iv; H[234] = a3 * iv; H[235] = a4 * iv; H[236] = a5 * iv; H[247] = a16 * iv; H[248] = a17 * iv; H[249] = a18 * iv; H[250] = a19 * iv; H[251] = a20 * iv;
  }
  {
    Real a0 = H[210], a1 = H[211], a2 = H[212], a3 = H[213], a4 = H[214], a5 = H[215], a16 = H[226], a17 = H[227], a18 = H[228], a19 = H[229], a20 = H[230];
    { const Real f = H[273] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; a20 -= f * H[273]; }
    { const Real f = H[251] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; a19 -= f * H[250]; a20 -= f * H[251]; }
    const Real iv = 1.0 / a20; D[20] = a20; inv[20] = iv;
    H[210] = a0 * iv; H[211] = a1 * iv; H[212] = a2 * iv; H[213] = a3 * iv; H[214] = a4 * iv; H[215] = a5 * iv; H[226] = a16 * iv; H[227] = a17 * iv; H[228] = a18 * iv; H[229] = a19 * iv;
  }
  {
    Real a0 = H[190], a1 = H[191], a2 = H[192], a3 = H[193], a4 = H[194], a5 = H[195], a16 = H[206], a17 = H[207], a18 = H[208], a19 = H[209];
    { const Real f = H[272] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; a19 -= f * H[272]; }
    { const Real f = H[250] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; a19 -= f * H[250]; }
    { const Real f = H[229] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; a18 -= f * H[228]; a19 -= f * H[229]; }
    const Real iv = 1.0 / a19; D[19] = a19; inv[19] = iv;
    H[190] = a0 * iv; H[191] = a1 * iv; H[192] = a2 * iv; H[193] = a3 * iv; H[194] = a4 * iv; H[195] = a5 * iv; H[206] = a16 * iv; H[207] = a17 * iv; H[208] = a18 * iv;
  }
  {
    Real a0 = H[171], a1 = H[172], a2 = H[173], a3 = H[174], a4 = H[175], a5 = H[176], a8 = H[179], a9 = H[180], a10 = H[181], a11 = H[182], a12 = H[183], a13 = H[184], a14 = H[185], a15 = H[186], a16 = H[187], a17 = H[188], a18 = H[189];
    { const Real f = H[271] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; a18 -= f * H[271]; }
    { const Real f = H[249] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; a18 -= f * H[249]; }
    { const Real f = H[228] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; a18 -= f * H[228]; }
    { const Real f = H[208] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; a17 -= f * H[207]; a18 -= f * H[208]; }
    const Real iv = 1.0 / a18; D[18] = a18; inv[18] = iv;
    H[171] = a0 * iv; H[172] = a1 * iv; H[173] = a2 * iv; H[174] = a3 * iv; H[175] = a4 * iv; H[176] = a5 * iv; H[179] = a8 * iv; H[180] = a9 * iv; H[181] = a10 * iv; H[182] = a11 * iv; H[183] = a12 * iv; H[184] = a13 * iv; H[185] = a14 * iv; H[186] = a15 * iv; H[187] = a16 * iv; H[188] = a17 * iv;
  }
  {
    Real a0 = H[153], a1 = H[154], a2 = H[155], a3 = H[156], a4 = H[157], a5 = H[158], a8 = H[161], a9 = H[162], a10 = H[163], a11 = H[164], a12 = H[165], a13 = H[166], a14 = H[167], a15 = H[168], a16 = H[169], a17 = H[170];
    { const Real f = H[270] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; a17 -= f * H[270]; }
    { const Real f = H[248] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; a17 -= f * H[248]; }
    { const Real f = H[227] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; a17 -= f * H[227]; }
    { const Real f = H[207] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; a17 -= f * H[207]; }
    { const Real f = H[188] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; a13 -= f * H[184]; a14 -= f * H[185]; a15 -= f * H[186]; a16 -= f * H[187]; a17 -= f * H[188]; }
    const Real iv = 1.0 / a17; D[17] = a17; inv[17] = iv;
    H[153] = a0 * iv; H[154] = a1 * iv; H[155] = a2 * iv; H[156] = a3 * iv; H[157] = a4 * iv; H[158] = a5 * iv; H[161] = a8 * iv; H[162] = a9 * iv; H[163] = a10 * iv; H[164] = a11 * iv; H[165] = a12 * iv; H[166] = a13 * iv; H[167] = a14 * iv; H[168] = a15 * iv; H[169] = a16 * iv;
  }
  {
    Real a0 = H[136], a1 = H[137], a2 = H[138], a3 = H[139], a4 = H[140], a5 = H[141], a8 = H[144], a9 = H[145], a10 = H[146], a11 = H[147], a12 = H[148], a13 = H[149], a14 = H[150], a15 = H[151], a16 = H[152];
    { const Real f = H[422] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; a16 -= f * H[422]; }
    { const Real f = H[394] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; a16 -= f * H[394]; }
    { const Real f = H[367] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; a16 -= f * H[367]; }
    { const Real f = H[341] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; a16 -= f * H[341]; }
    { const Real f = H[316] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; a13 -= f * H[313]; a14 -= f * H[314]; a15 -= f * H[315]; a16 -= f * H[316]; }
    { const Real f = H[292] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; a12 -= f * H[288]; a13 -= f * H[289]; a14 -= f * H[290]; a15 -= f * H[291]; a16 -= f * H[292]; }
    { const Real f = H[269] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; a16 -= f * H[269]; }
    { const Real f = H[247] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; a16 -= f * H[247]; }
    { const Real f = H[226] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; a16 -= f * H[226]; }
    { const Real f = H[206] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; a16 -= f * H[206]; }
    { const Real f = H[187] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; a13 -= f * H[184]; a14 -= f * H[185]; a15 -= f * H[186]; a16 -= f * H[187]; }
    { const Real f = H[169] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; a12 -= f * H[165]; a13 -= f * H[166]; a14 -= f * H[167]; a15 -= f * H[168]; a16 -= f * H[169]; }
    const Real iv = 1.0 / a16; D[16] = a16; inv[16] = iv;
    H[136] = a0 * iv; H[137] = a1 * iv; H[138] = a2 * iv; H[139] = a3 * iv; H[140] = a4 * iv; H[141] = a5 * iv; H[144] = a8 * iv; H[145] = a9 * iv; H[146] = a10 * iv; H[147] = a11 * iv; H[148] = a12 * iv; H[149] = a13 * iv; H[150] = a14 * iv; H[151] = a15 * iv;
  }
  {
    Real a0 = H[120], a1 = H[121], a2 = H[122], a3 = H[123], a4 = H[124], a5 = H[125], a8 = H[128], a9 = H[129], a10 = H[130], a11 = H[131], a12 = H[132], a13 = H[133], a14 = H[134], a15 = H[135];
    { const Real f = H[315] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; a13 -= f * H[313]; a14 -= f * H[314]; a15 -= f * H[315]; }
    { const Real f = H[291] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; a12 -= f * H[288]; a13 -= f * H[289]; a14 -= f * H[290]; a15 -= f * H[291]; }
    { const Real f = H[186] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; a13 -= f * H[184]; a14 -= f * H[185]; a15 -= f * H[186]; }
    { const Real f = H[168] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; a12 -= f * H[165]; a13 -= f * H[166]; a14 -= f * H[167]; a15 -= f * H[168]; }
    { const Real f = H[151] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; a11 -= f * H[147]; a12 -= f * H[148]; a13 -= f * H[149]; a14 -= f * H[150]; a15 -= f * H[151]; }
    const Real iv = 1.0 / a15; D[15] = a15; inv[15] = iv;
    H[120] = a0 * iv; H[121] = a1 * iv; H[122] = a2 * iv; H[123] = a3 * iv; H[124] = a4 * iv; H[125] = a5 * iv; H[128] = a8 * iv; H[129] = a9 * iv; H[130] = a10 * iv; H[131] = a11 * iv; H[132] = a12 * iv; H[133] = a13 * iv; H[134] = a14 * iv;
  }
  {
    Real a0 = H[105], a1 = H[106], a2 = H[107], a3 = H[108], a4 = H[109], a5 = H[110], a8 = H[113], a9 = H[114], a10 = H[115], a11 = H[116], a12 = H[117], a13 = H[118], a14 = H[119];
    { const Real f = H[314] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; a13 -= f * H[313]; a14 -= f * H[314]; }
    { const Real f = H[290] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; a12 -= f * H[288]; a13 -= f * H[289]; a14 -= f * H[290]; }
    { const Real f = H[185] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; a13 -= f * H[184]; a14 -= f * H[185]; }
    { const Real f = H[167] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; a12 -= f * H[165]; a13 -= f * H[166]; a14 -= f * H[167]; }
    { const Real f = H[150] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; a11 -= f * H[147]; a12 -= f * H[148]; a13 -= f * H[149]; a14 -= f * H[150]; }
    { const Real f = H[134] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; a10 -= f * H[130]; a11 -= f * H[131]; a12 -= f * H[132]; a13 -= f * H[133]; a14 -= f * H[134]; }
    const Real iv = 1.0 / a14; D[14] = a14; inv[14] = iv;
    H[105] = a0 * iv; H[106] = a1 * iv; H[107] = a2 * iv; H[108] = a3 * iv; H[109] = a4 * iv; H[110] = a5 * iv; H[113] = a8 * iv; H[114] = a9 * iv; H[115] = a10 * iv; H[116] = a11 * iv; H[117] = a12 * iv; H[118] = a13 * iv;
  }
  {
    Real a0 = H[91], a1 = H[92], a2 = H[93], a3 = H[94], a4 = H[95], a5 = H[96], a8 = H[99], a9 = H[100], a10 = H[101], a11 = H[102], a12 = H[103], a13 = H[104];
    { const Real f = H[313] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; a13 -= f * H[313]; }
    { const Real f = H[289] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; a12 -= f * H[288]; a13 -= f * H[289]; }
    { const Real f = H[184] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; a13 -= f * H[184]; }
    { const Real f = H[166] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; a12 -= f * H[165]; a13 -= f * H[166]; }
    { const Real f = H[149] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; a11 -= f * H[147]; a12 -= f * H[148]; a13 -= f * H[149]; }
    { const Real f = H[133] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; a10 -= f * H[130]; a11 -= f * H[131]; a12 -= f * H[132]; a13 -= f * H[133]; }
    { const Real f = H[118] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; a9 -= f * H[114]; a10 -= f * H[115]; a11 -= f * H[116]; a12 -= f * H[117]; a13 -= f * H[118]; }
    const Real iv = 1.0 / a13; D[13] = a13; inv[13] = iv;
    H[91] = a0 * iv; H[92] = a1 * iv; H[93] = a2 * iv; H[94] = a3 * iv; H[95] = a4 * iv; H[96] = a5 * iv; H[99] = a8 * iv; H[100] = a9 * iv; H[101] = a10 * iv; H[102] = a11 * iv; H[103] = a12 * iv;
  }
  {
    Real a0 = H[78], a1 = H[79], a2 = H[80], a3 = H[81], a4 = H[82], a5 = H[83], a8 = H[86], a9 = H[87], a10 = H[88], a11 = H[89], a12 = H[90];
    { const Real f = H[312] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; a12 -= f * H[312]; }
    { const Real f = H[288] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; a12 -= f * H[288]; }
    { const Real f = H[183] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; a12 -= f * H[183]; }
    { const Real f = H[165] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; a12 -= f * H[165]; }
    { const Real f = H[148] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; a11 -= f * H[147]; a12 -= f * H[148]; }
    { const Real f = H[132] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; a10 -= f * H[130]; a11 -= f * H[131]; a12 -= f * H[132]; }
    { const Real f = H[117] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; a9 -= f * H[114]; a10 -= f * H[115]; a11 -= f * H[116]; a12 -= f * H[117]; }
    { const Real f = H[103] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a8 -= f * H[99]; a9 -= f * H[100]; a10 -= f * H[101]; a11 -= f * H[102]; a12 -= f * H[103]; }
    const Real iv = 1.0 / a12; D[12] = a12; inv[12] = iv;
    H[78] = a0 * iv; H[79] = a1 * iv; H[80] = a2 * iv; H[81] = a3 * iv; H[82] = a4 * iv; H[83] = a5 * iv; H[86] = a8 * iv; H[87] = a9 * iv; H[88] = a10 * iv; H[89] = a11 * iv;
  }
  {
    Real a0 = H[66], a1 = H[67], a2 = H[68], a3 = H[69], a4 = H[70], a5 = H[71], a8 = H[74], a9 = H[75], a10 = H[76], a11 = H[77];
    { const Real f = H[311] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; a11 -= f * H[311]; }
    { const Real f = H[287] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; a11 -= f * H[287]; }
    { const Real f = H[182] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; a11 -= f * H[182]; }
    { const Real f = H[164] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; a11 -= f * H[164]; }
    { const Real f = H[147] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; a11 -= f * H[147]; }
    { const Real f = H[131] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; a10 -= f * H[130]; a11 -= f * H[131]; }
    { const Real f = H[116] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; a9 -= f * H[114]; a10 -= f * H[115]; a11 -= f * H[116]; }
    { const Real f = H[102] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a8 -= f * H[99]; a9 -= f * H[100]; a10 -= f * H[101]; a11 -= f * H[102]; }
    { const Real f = H[89] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; a8 -= f * H[86]; a9 -= f * H[87]; a10 -= f * H[88]; a11 -= f * H[89]; }
    const Real iv = 1.0 / a11; D[11] = a11; inv[11] = iv;
    H[66] = a0 * iv; H[67] = a1 * iv; H[68] = a2 * iv; H[69] = a3 * iv; H[70] = a4 * iv; H[71] = a5 * iv; H[74] = a8 * iv; H[75] = a9 * iv; H[76] = a10 * iv;
  }
  {
    Real a0 = H[55], a1 = H[56], a2 = H[57], a3 = H[58], a4 = H[59], a5 = H[60], a8 = H[63], a9 = H[64], a10 = H[65];
    { const Real f = H[310] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; a10 -= f * H[310]; }
    { const Real f = H[286] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; a10 -= f * H[286]; }
    { const Real f = H[181] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; a10 -= f * H[181]; }
    { const Real f = H[163] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; a10 -= f * H[163]; }
    { const Real f = H[146] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; a10 -= f * H[146]; }
    { const Real f = H[130] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; a10 -= f * H[130]; }
    { const Real f = H[115] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; a9 -= f * H[114]; a10 -= f * H[115]; }
    { const Real f = H[101] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a8 -= f * H[99]; a9 -= f * H[100]; a10 -= f * H[101]; }
    { const Real f = H[88] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; a8 -= f * H[86]; a9 -= f * H[87]; a10 -= f * H[88]; }
    { const Real f = H[76] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; a9 -= f * H[75]; a10 -= f * H[76]; }
    const Real iv = 1.0 / a10; D[10] = a10; inv[10] = iv;
    H[55] = a0 * iv; H[56] = a1 * iv; H[57] = a2 * iv; H[58] = a3 * iv; H[59] = a4 * iv; H[60] = a5 * iv; H[63] = a8 * iv; H[64] = a9 * iv;
  }
  {
    Real a0 = H[45], a1 = H[46], a2 = H[47], a3 = H[48], a4 = H[49], a5 = H[50], a8 = H[53], a9 = H[54];
    { const Real f = H[309] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; a9 -= f * H[309]; }
    { const Real f = H[285] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; a9 -= f * H[285]; }
    { const Real f = H[180] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; a9 -= f * H[180]; }
    { const Real f = H[162] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; a9 -= f * H[162]; }
    { const Real f = H[145] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; a9 -= f * H[145]; }
    { const Real f = H[129] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; a9 -= f * H[129]; }
    { const Real f = H[114] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; a9 -= f * H[114]; }
    { const Real f = H[100] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a8 -= f * H[99]; a9 -= f * H[100]; }
    { const Real f = H[87] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; a8 -= f * H[86]; a9 -= f * H[87]; }
    { const Real f = H[75] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; a9 -= f * H[75]; }
    { const Real f = H[64] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; a8 -= f * H[63]; a9 -= f * H[64]; }
    const Real iv = 1.0 / a9; D[9] = a9; inv[9] = iv;
    H[45] = a0 * iv; H[46] = a1 * iv; H[47] = a2 * iv; H[48] = a3 * iv; H[49] = a4 * iv; H[50] = a5 * iv; H[53] = a8 * iv;
  }
  {
    Real a0 = H[36], a1 = H[37], a2 = H[38], a3 = H[39], a4 = H[40], a5 = H[41], a8 = H[44];
    { const Real f = H[308] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; a8 -= f * H[308]; }
    { const Real f = H[284] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; a8 -= f * H[284]; }
    { const Real f = H[179] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; a8 -= f * H[179]; }
    { const Real f = H[161] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; a8 -= f * H[161]; }
    { const Real f = H[144] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; a8 -= f * H[144]; }
    { const Real f = H[128] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; a8 -= f * H[128]; }
    { const Real f = H[113] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; a8 -= f * H[113]; }
    { const Real f = H[99] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; a8 -= f * H[99]; }
    { const Real f = H[86] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; a8 -= f * H[86]; }
    { const Real f = H[74] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; a8 -= f * H[74]; }
    { const Real f = H[63] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; a8 -= f * H[63]; }
    { const Real f = H[53] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; a5 -= f * H[50]; a8 -= f * H[53]; }
    const Real iv = 1.0 / a8; D[8] = a8; inv[8] = iv;
    H[36] = a0 * iv; H[37] = a1 * iv; H[38] = a2 * iv; H[39] = a3 * iv; H[40] = a4 * iv; H[41] = a5 * iv;
  }
  {
    Real a0 = H[28], a1 = H[29], a2 = H[30], a3 = H[31], a4 = H[32], a5 = H[33], a6 = H[34], a7 = H[35];
    const Real iv = 1.0 / a7; D[7] = a7; inv[7] = iv;
    H[28] = a0 * iv; H[29] = a1 * iv; H[30] = a2 * iv; H[31] = a3 * iv; H[32] = a4 * iv; H[33] = a5 * iv; H[34] = a6 * iv;
  }
  {
    Real a0 = H[21], a1 = H[22], a2 = H[23], a3 = H[24], a4 = H[25], a5 = H[26], a6 = H[27];
    { const Real f = H[34] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; a5 -= f * H[33]; a6 -= f * H[34]; }
    const Real iv = 1.0 / a6; D[6] = a6; inv[6] = iv;
    H[21] = a0 * iv; H[22] = a1 * iv; H[23] = a2 * iv; H[24] = a3 * iv; H[25] = a4 * iv; H[26] = a5 * iv;
  }
  {
    Real a0 = H[15], a1 = H[16], a2 = H[17], a3 = H[18], a4 = H[19], a5 = H[20];
    { const Real f = H[411] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; a5 -= f * H[411]; }
    { const Real f = H[383] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; a5 -= f * H[383]; }
    { const Real f = H[356] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; a5 -= f * H[356]; }
    { const Real f = H[330] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; a5 -= f * H[330]; }
    { const Real f = H[305] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; a5 -= f * H[305]; }
    { const Real f = H[281] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; a5 -= f * H[281]; }
    { const Real f = H[258] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; a5 -= f * H[258]; }
    { const Real f = H[236] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; a5 -= f * H[236]; }
    { const Real f = H[215] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; a5 -= f * H[215]; }
    { const Real f = H[195] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; a5 -= f * H[195]; }
    { const Real f = H[176] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; a5 -= f * H[176]; }
    { const Real f = H[158] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; a5 -= f * H[158]; }
    { const Real f = H[141] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; a5 -= f * H[141]; }
    { const Real f = H[125] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; a5 -= f * H[125]; }
    { const Real f = H[110] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; a5 -= f * H[110]; }
    { const Real f = H[96] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; a5 -= f * H[96]; }
    { const Real f = H[83] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; a5 -= f * H[83]; }
    { const Real f = H[71] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; a5 -= f * H[71]; }
    { const Real f = H[60] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; a5 -= f * H[60]; }
    { const Real f = H[50] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; a5 -= f * H[50]; }
    { const Real f = H[41] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; a4 -= f * H[40]; a5 -= f * H[41]; }
    { const Real f = H[33] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; a5 -= f * H[33]; }
    { const Real f = H[26] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; a4 -= f * H[25]; a5 -= f * H[26]; }
    const Real iv = 1.0 / a5; D[5] = a5; inv[5] = iv;
    H[15] = a0 * iv; H[16] = a1 * iv; H[17] = a2 * iv; H[18] = a3 * iv; H[19] = a4 * iv;
  }
  {
    Real a0 = H[10], a1 = H[11], a2 = H[12], a3 = H[13], a4 = H[14];
    { const Real f = H[410] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; a4 -= f * H[410]; }
    { const Real f = H[382] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; a4 -= f * H[382]; }
    { const Real f = H[355] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; a4 -= f * H[355]; }
    { const Real f = H[329] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; a4 -= f * H[329]; }
    { const Real f = H[304] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; a4 -= f * H[304]; }
    { const Real f = H[280] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; a4 -= f * H[280]; }
    { const Real f = H[257] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; a4 -= f * H[257]; }
    { const Real f = H[235] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; a4 -= f * H[235]; }
    { const Real f = H[214] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; a4 -= f * H[214]; }
    { const Real f = H[194] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; a4 -= f * H[194]; }
    { const Real f = H[175] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; a4 -= f * H[175]; }
    { const Real f = H[157] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; a4 -= f * H[157]; }
    { const Real f = H[140] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; a4 -= f * H[140]; }
    { const Real f = H[124] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; a4 -= f * H[124]; }
    { const Real f = H[109] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; a4 -= f * H[109]; }
    { const Real f = H[95] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; a4 -= f * H[95]; }
    { const Real f = H[82] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; a4 -= f * H[82]; }
    { const Real f = H[70] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; a4 -= f * H[70]; }
    { const Real f = H[59] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; a4 -= f * H[59]; }
    { const Real f = H[49] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; a4 -= f * H[49]; }
    { const Real f = H[40] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; a4 -= f * H[40]; }
    { const Real f = H[32] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; a4 -= f * H[32]; }
    { const Real f = H[25] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; a4 -= f * H[25]; }
    { const Real f = H[19] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; a3 -= f * H[18]; a4 -= f * H[19]; }
    const Real iv = 1.0 / a4; D[4] = a4; inv[4] = iv;
    H[10] = a0 * iv; H[11] = a1 * iv; H[12] = a2 * iv; H[13] = a3 * iv;
  }
  {
    Real a0 = H[6], a1 = H[7], a2 = H[8], a3 = H[9];
    { const Real f = H[409] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; a3 -= f * H[409]; }
    { const Real f = H[381] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; a3 -= f * H[381]; }
    { const Real f = H[354] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; a3 -= f * H[354]; }
    { const Real f = H[328] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; a3 -= f * H[328]; }
    { const Real f = H[303] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; a3 -= f * H[303]; }
    { const Real f = H[279] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; a3 -= f * H[279]; }
    { const Real f = H[256] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; a3 -= f * H[256]; }
    { const Real f = H[234] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; a3 -= f * H[234]; }
    { const Real f = H[213] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; a3 -= f * H[213]; }
    { const Real f = H[193] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; a3 -= f * H[193]; }
    { const Real f = H[174] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; a3 -= f * H[174]; }
    { const Real f = H[156] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; a3 -= f * H[156]; }
    { const Real f = H[139] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; a3 -= f * H[139]; }
    { const Real f = H[123] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; a3 -= f * H[123]; }
    { const Real f = H[108] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; a3 -= f * H[108]; }
    { const Real f = H[94] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; a3 -= f * H[94]; }
    { const Real f = H[81] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; a3 -= f * H[81]; }
    { const Real f = H[69] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; a3 -= f * H[69]; }
    { const Real f = H[58] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; a3 -= f * H[58]; }
    { const Real f = H[48] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; a3 -= f * H[48]; }
    { const Real f = H[39] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; a3 -= f * H[39]; }
    { const Real f = H[31] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; a3 -= f * H[31]; }
    { const Real f = H[24] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; a3 -= f * H[24]; }
    { const Real f = H[18] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; a3 -= f * H[18]; }
    { const Real f = H[13] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; a2 -= f * H[12]; a3 -= f * H[13]; }
    const Real iv = 1.0 / a3; D[3] = a3; inv[3] = iv;
    H[6] = a0 * iv; H[7] = a1 * iv; H[8] = a2 * iv;
  }
  {
    Real a0 = H[3], a1 = H[4], a2 = H[5];
    { const Real f = H[408] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; a2 -= f * H[408]; }
    { const Real f = H[380] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; a2 -= f * H[380]; }
    { const Real f = H[353] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; a2 -= f * H[353]; }
    { const Real f = H[327] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; a2 -= f * H[327]; }
    { const Real f = H[302] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; a2 -= f * H[302]; }
    { const Real f = H[278] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; a2 -= f * H[278]; }
    { const Real f = H[255] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; a2 -= f * H[255]; }
    { const Real f = H[233] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; a2 -= f * H[233]; }
    { const Real f = H[212] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; a2 -= f * H[212]; }
    { const Real f = H[192] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; a2 -= f * H[192]; }
    { const Real f = H[173] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; a2 -= f * H[173]; }
    { const Real f = H[155] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; a2 -= f * H[155]; }
    { const Real f = H[138] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; a2 -= f * H[138]; }
    { const Real f = H[122] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; a2 -= f * H[122]; }
    { const Real f = H[107] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; a2 -= f * H[107]; }
    { const Real f = H[93] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; a2 -= f * H[93]; }
    { const Real f = H[80] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; a2 -= f * H[80]; }
    { const Real f = H[68] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; a2 -= f * H[68]; }
    { const Real f = H[57] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; a2 -= f * H[57]; }
    { const Real f = H[47] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; a2 -= f * H[47]; }
    { const Real f = H[38] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; a2 -= f * H[38]; }
    { const Real f = H[30] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; a2 -= f * H[30]; }
    { const Real f = H[23] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; a2 -= f * H[23]; }
    { const Real f = H[17] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; a2 -= f * H[17]; }
    { const Real f = H[12] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; a2 -= f * H[12]; }
    { const Real f = H[8] * D[3]; a0 -= f * H[6]; a1 -= f * H[7]; a2 -= f * H[8]; }
    const Real iv = 1.0 / a2; D[2] = a2; inv[2] = iv;
    H[3] = a0 * iv; H[4] = a1 * iv;
  }
  {
    Real a0 = H[1], a1 = H[2];
    { const Real f = H[407] * D[28]; a0 -= f * H[406]; a1 -= f * H[407]; }
    { const Real f = H[379] * D[27]; a0 -= f * H[378]; a1 -= f * H[379]; }
    { const Real f = H[352] * D[26]; a0 -= f * H[351]; a1 -= f * H[352]; }
    { const Real f = H[326] * D[25]; a0 -= f * H[325]; a1 -= f * H[326]; }
    { const Real f = H[301] * D[24]; a0 -= f * H[300]; a1 -= f * H[301]; }
    { const Real f = H[277] * D[23]; a0 -= f * H[276]; a1 -= f * H[277]; }
    { const Real f = H[254] * D[22]; a0 -= f * H[253]; a1 -= f * H[254]; }
    { const Real f = H[232] * D[21]; a0 -= f * H[231]; a1 -= f * H[232]; }
    { const Real f = H[211] * D[20]; a0 -= f * H[210]; a1 -= f * H[211]; }
    { const Real f = H[191] * D[19]; a0 -= f * H[190]; a1 -= f * H[191]; }
    { const Real f = H[172] * D[18]; a0 -= f * H[171]; a1 -= f * H[172]; }
    { const Real f = H[154] * D[17]; a0 -= f * H[153]; a1 -= f * H[154]; }
    { const Real f = H[137] * D[16]; a0 -= f * H[136]; a1 -= f * H[137]; }
    { const Real f = H[121] * D[15]; a0 -= f * H[120]; a1 -= f * H[121]; }
    { const Real f = H[106] * D[14]; a0 -= f * H[105]; a1 -= f * H[106]; }
    { const Real f = H[92] * D[13]; a0 -= f * H[91]; a1 -= f * H[92]; }
    { const Real f = H[79] * D[12]; a0 -= f * H[78]; a1 -= f * H[79]; }
    { const Real f = H[67] * D[11]; a0 -= f * H[66]; a1 -= f * H[67]; }
    { const Real f = H[56] * D[10]; a0 -= f * H[55]; a1 -= f * H[56]; }
    { const Real f = H[46] * D[9]; a0 -= f * H[45]; a1 -= f * H[46]; }
    { const Real f = H[37] * D[8]; a0 -= f * H[36]; a1 -= f * H[37]; }
    { const Real f = H[29] * D[7]; a0 -= f * H[28]; a1 -= f * H[29]; }
    { const Real f = H[22] * D[6]; a0 -= f * H[21]; a1 -= f * H[22]; }
    { const Real f = H[16] * D[5]; a0 -= f * H[15]; a1 -= f * H[16]; }
    { const Real f = H[11] * D[4]; a0 -= f * H[10]; a1 -= f * H[11]; }
    { const Real f = H[7] * D[3]; a0 -= f * H[6]; a1 -= f * H[7]; }
    { const Real f = H[4] * D[2]; a0 -= f * H[3]; a1 -= f * H[4]; }
    const Real iv = 1.0 / a1; D[1] = a1; inv[1] = iv;
    H[1] = a0 * iv;
  }
  {
    Real a0 = H[0];
    { const Real f = H[406] * D[28]; a0 -= f * H[406]; }
    { const Real f = H[378] * D[27]; a0 -= f * H[378]; }
    { const Real f = H[351] * D[26]; a0 -= f * H[351]; }
    { const Real f = H[325] * D[25]; a0 -= f * H[325]; }
    { const Real f = H[300] * D[24]; a0 -= f * H[300]; }
    { const Real f = H[276] * D[23]; a0 -= f * H[276]; }
    { const Real f = H[253] * D[22]; a0 -= f * H[253]; }
    { const Real f = H[231] * D[21]; a0 -= f * H[231]; }
    { const Real f = H[210] * D[20]; a0 -= f * H[210]; }
    { const Real f = H[190] * D[19]; a0 -= f * H[190]; }
    { const Real f = H[171] * D[18]; a0 -= f * H[171]; }
    { const Real f = H[153] * D[17]; a0 -= f * H[153]; }
    { const Real f = H[136] * D[16]; a0 -= f * H[136]; }
    { const Real f = H[120] * D[15]; a0 -= f * H[120]; }
    { const Real f = H[105] * D[14]; a0 -= f * H[105]; }
    { const Real f = H[91] * D[13]; a0 -= f * H[91]; }
    { const Real f = H[78] * D[12]; a0 -= f * H[78]; }
    { const Real f = H[66] * D[11]; a0 -= f * H[66]; }
    { const Real f = H[55] * D[10]; a0 -= f * H[55]; }
    { const Real f = H[45] * D[9]; a0 -= f * H[45]; }
    { const Real f = H[36] * D[8]; a0 -= f * H[36]; }
    { const Real f = H[28] * D[7]; a0 -= f * H[28]; }
    { const Real f = H[21] * D[6]; a0 -= f * H[21]; }
    { const Real f = H[15] * D[5]; a0 -= f * H[15]; }
    { const Real f = H[10] * D[4]; a0 -= f * H[10]; }
    { const Real f = H[6] * D[3]; a0 -= f * H[6]; }
    { const Real f = H[3] * D[2]; a0 -= f * H[3]; }
    { const Real f = H[1] * D[1]; a0 -= f * H[1]; }
    const Real iv = 1.0 / a0; D[0] = a0; inv[0] = iv;
    
  }
}
inline void solve_arms(const Real* __restrict H, const Real* __restrict inv, Real* __restrict x) {
  { Real s = x[27], t = splat(0); s -= H[433] * x[28]; x[27] = s - t; }
  { Real s = x[26], t = splat(0); s -= H[432] * x[28]; t += H[404] * x[27]; x[26] = s - t; }
  { Real s = x[25], t = splat(0); s -= H[431] * x[28]; s -= H[376] * x[26]; t += H[403] * x[27]; x[25] = s - t; }
  { Real s = x[24], t = splat(0); s -= H[430] * x[28]; s -= H[375] * x[26]; t += H[402] * x[27]; t += H[349] * x[25]; x[24] = s - t; }
  { Real s = x[23], t = splat(0); s -= H[429] * x[28]; s -= H[374] * x[26]; s -= H[323] * x[24]; t += H[401] * x[27]; t += H[348] * x[25]; x[23] = s - t; }
  { Real s = x[21], t = splat(0); s -= H[274] * x[22]; x[21] = s - t; }
  { Real s = x[20], t = splat(0); s -= H[273] * x[22]; t += H[251] * x[21]; x[20] = s - t; }
  { Real s = x[19], t = splat(0); s -= H[272] * x[22]; s -= H[229] * x[20]; t += H[250] * x[21]; x[19] = s - t; }
  { Real s = x[18], t = splat(0); s -= H[271] * x[22]; s -= H[228] * x[20]; t += H[249] * x[21]; t += H[208] * x[19]; x[18] = s - t; }
  { Real s = x[17], t = splat(0); s -= H[270] * x[22]; s -= H[227] * x[20]; s -= H[188] * x[18]; t += H[248] * x[21]; t += H[207] * x[19]; x[17] = s - t; }
  { Real s = x[16], t = splat(0); s -= H[422] * x[28]; s -= H[367] * x[26]; s -= H[316] * x[24]; s -= H[269] * x[22]; s -= H[226] * x[20]; s -= H[187] * x[18]; t += H[394] * x[27]; t += H[341] * x[25]; t += H[292] * x[23]; t += H[247] * x[21]; t += H[206] * x[19]; t += H[169] * x[17]; x[16] = s - t; }
  { Real s = x[15], t = splat(0); s -= H[315] * x[24]; s -= H[186] * x[18]; s -= H[151] * x[16]; t += H[291] * x[23]; t += H[168] * x[17]; x[15] = s - t; }
  { Real s = x[14], t = splat(0); s -= H[314] * x[24]; s -= H[185] * x[18]; s -= H[150] * x[16]; t += H[290] * x[23]; t += H[167] * x[17]; t += H[134] * x[15]; x[14] = s - t; }
  { Real s = x[13], t = splat(0); s -= H[313] * x[24]; s -= H[184] * x[18]; s -= H[149] * x[16]; s -= H[118] * x[14]; t += H[289] * x[23]; t += H[166] * x[17]; t += H[133] * x[15]; x[13] = s - t; }
  { Real s = x[12], t = splat(0); s -= H[312] * x[24]; s -= H[183] * x[18]; s -= H[148] * x[16]; s -= H[117] * x[14]; t += H[288] * x[23]; t += H[165] * x[17]; t += H[132] * x[15]; t += H[103] * x[13]; x[12] = s - t; }
  { Real s = x[11], t = splat(0); s -= H[311] * x[24]; s -= H[182] * x[18]; s -= H[147] * x[16]; s -= H[116] * x[14]; s -= H[89] * x[12]; t += H[287] * x[23]; t += H[164] * x[17]; t += H[131] * x[15]; t += H[102] * x[13]; x[11] = s - t; }
  { Real s = x[10], t = splat(0); s -= H[310] * x[24]; s -= H[181] * x[18]; s -= H[146] * x[16]; s -= H[115] * x[14]; s -= H[88] * x[12]; t += H[286] * x[23]; t += H[163] * x[17]; t += H[130] * x[15]; t += H[101] * x[13]; t += H[76] * x[11]; x[10] = s - t; }
  { Real s = x[9], t = splat(0); s -= H[309] * x[24]; s -= H[180] * x[18]; s -= H[145] * x[16]; s -= H[114] * x[14]; s -= H[87] * x[12]; s -= H[64] * x[10]; t += H[285] * x[23]; t += H[162] * x[17]; t += H[129] * x[15]; t += H[100] * x[13]; t += H[75] * x[11]; x[9] = s - t; }
  { Real s = x[8], t = splat(0); s -= H[308] * x[24]; s -= H[179] * x[18]; s -= H[144] * x[16]; s -= H[113] * x[14]; s -= H[86] * x[12]; s -= H[63] * x[10]; t += H[284] * x[23]; t += H[161] * x[17]; t += H[128] * x[15]; t += H[99] * x[13]; t += H[74] * x[11]; t += H[53] * x[9]; x[8] = s - t; }
  { Real s = x[6], t = splat(0); t += H[34] * x[7]; x[6] = s - t; }
  { Real s = x[5], t = splat(0); s -= H[411] * x[28]; s -= H[356] * x[26]; s -= H[305] * x[24]; s -= H[258] * x[22]; s -= H[215] * x[20]; s -= H[176] * x[18]; s -= H[141] * x[16]; s -= H[110] * x[14]; s -= H[83] * x[12]; s -= H[60] * x[10]; s -= H[41] * x[8]; s -= H[26] * x[6]; t += H[383] * x[27]; t += H[330] * x[25]; t += H[281] * x[23]; t += H[236] * x[21]; t += H[195] * x[19]; t += H[158] * x[17]; t += H[125] * x[15]; t += H[96] * x[13]; t += H[71] * x[11]; t += H[50] * x[9]; t += H[33] * x[7]; x[5] = s - t; }
  { Real s = x[4], t = splat(0); s -= H[410] * x[28]; s -= H[355] * x[26]; s -= H[304] * x[24]; s -= H[257] * x[22]; s -= H[214] * x[20]; s -= H[175] * x[18]; s -= H[140] * x[16]; s -= H[109] * x[14]; s -= H[82] * x[12]; s -= H[59] * x[10]; s -= H[40] * x[8]; s -= H[25] * x[6]; t += H[382] * x[27]; t += H[329] * x[25]; t += H[280] * x[23]; t += H[235] * x[21]; t += H[194] * x[19]; t += H[157] * x[17]; t += H[124] * x[15]; t += H[95] * x[13]; t += H[70] * x[11]; t += H[49] * x[9]; t += H[32] * x[7]; t += H[19] * x[5]; x[4] = s - t; }
  { Real s = x[3], t = splat(0); s -= H[409] * x[28]; s -= H[354] * x[26]; s -= H[303] * x[24]; s -= H[256] * x[22]; s -= H[213] * x[20]; s -= H[174] * x[18]; s -= H[139] * x[16]; s -= H[108] * x[14]; s -= H[81] * x[12]; s -= H[58] * x[10]; s -= H[39] * x[8]; s -= H[24] * x[6]; s -= H[13] * x[4]; t += H[381] * x[27]; t += H[328] * x[25]; t += H[279] * x[23]; t += H[234] * x[21]; t += H[193] * x[19]; t += H[156] * x[17]; t += H[123] * x[15]; t += H[94] * x[13]; t += H[69] * x[11]; t += H[48] * x[9]; t += H[31] * x[7]; t += H[18] * x[5]; x[3] = s - t; }
  { Real s = x[2], t = splat(0); s -= H[408] * x[28]; s -= H[353] * x[26]; s -= H[302] * x[24]; s -= H[255] * x[22]; s -= H[212] * x[20]; s -= H[173] * x[18]; s -= H[138] * x[16]; s -= H[107] * x[14]; s -= H[80] * x[12]; s -= H[57] * x[10]; s -= H[38] * x[8]; s -= H[23] * x[6]; s -= H[12] * x[4]; t += H[380] * x[27]; t += H[327] * x[25]; t += H[278] * x[23]; t += H[233] * x[21]; t += H[192] * x[19]; t += H[155] * x[17]; t += H[122] * x[15]; t += H[93] * x[13]; t += H[68] * x[11]; t += H[47] * x[9]; t += H[30] * x[7]; t += H[17] * x[5]; t += H[8] * x[3]; x[2] = s - t; }
  { Real s = x[1], t = splat(0); s -= H[407] * x[28]; s -= H[352] * x[26]; s -= H[301] * x[24]; s -= H[254] * x[22]; s -= H[211] * x[20]; s -= H[172] * x[18]; s -= H[137] * x[16]; s -= H[106] * x[14]; s -= H[79] * x[12]; s -= H[56] * x[10]; s -= H[37] * x[8]; s -= H[22] * x[6]; s -= H[11] * x[4]; s -= H[4] * x[2]; t += H[379] * x[27]; t += H[326] * x[25]; t += H[277] * x[23]; t += H[232] * x[21]; t += H[191] * x[19]; t += H[154] * x[17]; t += H[121] * x[15]; t += H[92] * x[13]; t += H[67] * x[11]; t += H[46] * x[9]; t += H[29] * x[7]; t += H[16] * x[5]; t += H[7] * x[3]; x[1] = s - t; }
  { Real s = x[0], t = splat(0); s -= H[406] * x[28]; s -= H[351] * x[26]; s -= H[300] * x[24]; s -= H[253] * x[22]; s -= H[210] * x[20]; s -= H[171] * x[18]; s -= H[136] * x[16]; s -= H[105] * x[14]; s -= H[78] * x[12]; s -= H[55] * x[10]; s -= H[36] * x[8]; s -= H[21] * x[6]; s -= H[10] * x[4]; s -= H[3] * x[2]; t += H[378] * x[27]; t += H[325] * x[25]; t += H[276] * x[23]; t += H[231] * x[21]; t += H[190] * x[19]; t += H[153] * x[17]; t += H[120] * x[15]; t += H[91] * x[13]; t += H[66] * x[11]; t += H[45] * x[9]; t += H[28] * x[7]; t += H[15] * x[5]; t += H[6] * x[3]; t += H[1] * x[1]; x[0] = s - t; }
  for (int i = 0; i < 29; ++i) x[i] *= inv[i];
  { Real s = x[1], t = splat(0); s -= H[1] * x[0]; x[1] = s - t; }
  { Real s = x[2], t = splat(0); s -= H[3] * x[0]; t += H[4] * x[1]; x[2] = s - t; }
  { Real s = x[3], t = splat(0); s -= H[6] * x[0]; s -= H[8] * x[2]; t += H[7] * x[1]; x[3] = s - t; }
  { Real s = x[4], t = splat(0); s -= H[10] * x[0]; s -= H[12] * x[2]; t += H[11] * x[1]; t += H[13] * x[3]; x[4] = s - t; }
  { Real s = x[5], t = splat(0); s -= H[15] * x[0]; s -= H[17] * x[2]; s -= H[19] * x[4]; t += H[16] * x[1]; t += H[18] * x[3]; x[5] = s - t; }
  { Real s = x[6], t = splat(0); s -= H[21] * x[0]; s -= H[23] * x[2]; s -= H[25] * x[4]; t += H[22] * x[1]; t += H[24] * x[3]; t += H[26] * x[5]; x[6] = s - t; }
  { Real s = x[7], t = splat(0); s -= H[28] * x[0]; s -= H[30] * x[2]; s -= H[32] * x[4]; s -= H[34] * x[6]; t += H[29] * x[1]; t += H[31] * x[3]; t += H[33] * x[5]; x[7] = s - t; }
  { Real s = x[8], t = splat(0); s -= H[36] * x[0]; s -= H[38] * x[2]; s -= H[40] * x[4]; t += H[37] * x[1]; t += H[39] * x[3]; t += H[41] * x[5]; x[8] = s - t; }
  { Real s = x[9], t = splat(0); s -= H[45] * x[0]; s -= H[47] * x[2]; s -= H[49] * x[4]; s -= H[53] * x[8]; t += H[46] * x[1]; t += H[48] * x[3]; t += H[50] * x[5]; x[9] = s - t; }
  { Real s = x[10], t = splat(0); s -= H[55] * x[0]; s -= H[57] * x[2]; s -= H[59] * x[4]; s -= H[63] * x[8]; t += H[56] * x[1]; t += H[58] * x[3]; t += H[60] * x[5]; t += H[64] * x[9]; x[10] = s - t; }
  { Real s = x[11], t = splat(0); s -= H[66] * x[0]; s -= H[68] * x[2]; s -= H[70] * x[4]; s -= H[74] * x[8]; s -= H[76] * x[10]; t += H[67] * x[1]; t += H[69] * x[3]; t += H[71] * x[5]; t += H[75] * x[9]; x[11] = s - t; }
  { Real s = x[12], t = splat(0); s -= H[78] * x[0]; s -= H[80] * x[2]; s -= H[82] * x[4]; s -= H[86] * x[8]; s -= H[88] * x[10]; t += H[79] * x[1]; t += H[81] * x[3]; t += H[83] * x[5]; t += H[87] * x[9]; t += H[89] * x[11]; x[12] = s - t; }
  { Real s = x[13], t = splat(0); s -= H[91] * x[0]; s -= H[93] * x[2]; s -= H[95] * x[4]; s -= H[99] * x[8]; s -= H[101] * x[10]; s -= H[103] * x[12]; t += H[92] * x[1]; t += H[94] * x[3]; t += H[96] * x[5]; t += H[100] * x[9]; t += H[102] * x[11]; x[13] = s - t; }
  { Real s = x[14], t = splat(0); s -= H[105] * x[0]; s -= H[107] * x[2]; s -= H[109] * x[4]; s -= H[113] * x[8]; s -= H[115] * x[10]; s -= H[117] * x[12]; t += H[106] * x[1]; t += H[108] * x[3]; t += H[110] * x[5]; t += H[114] * x[9]; t += H[116] * x[11]; t += H[118] * x[13]; x[14] = s - t; }
  { Real s = x[15], t = splat(0); s -= H[120] * x[0]; s -= H[122] * x[2]; s -= H[124] * x[4]; s -= H[128] * x[8]; s -= H[130] * x[10]; s -= H[132] * x[12]; s -= H[134] * x[14]; t += H[121] * x[1]; t += H[123] * x[3]; t += H[125] * x[5]; t += H[129] * x[9]; t += H[131] * x[11]; t += H[133] * x[13]; x[15] = s - t; }
  { Real s = x[16], t = splat(0); s -= H[136] * x[0]; s -= H[138] * x[2]; s -= H[140] * x[4]; s -= H[144] * x[8]; s -= H[146] * x[10]; s -= H[148] * x[12]; s -= H[150] * x[14]; t += H[137] * x[1]; t += H[139] * x[3]; t += H[141] * x[5]; t += H[145] * x[9]; t += H[147] * x[11]; t += H[149] * x[13]; t += H[151] * x[15]; x[16] = s - t; }
  { Real s = x[17], t = splat(0); s -= H[153] * x[0]; s -= H[155] * x[2]; s -= H[157] * x[4]; s -= H[161] * x[8]; s -= H[163] * x[10]; s -= H[165] * x[12]; s -= H[167] * x[14]; s -= H[169] * x[16]; t += H[154] * x[1]; t += H[156] * x[3]; t += H[158] * x[5]; t += H[162] * x[9]; t += H[164] * x[11]; t += H[166] * x[13]; t += H[168] * x[15]; x[17] = s - t; }
  { Real s = x[18], t = splat(0); s -= H[171] * x[0]; s -= H[173] * x[2]; s -= H[175] * x[4]; s -= H[179] * x[8]; s -= H[181] * x[10]; s -= H[183] * x[12]; s -= H[185] * x[14]; s -= H[187] * x[16]; t += H[172] * x[1]; t += H[174] * x[3]; t += H[176] * x[5]; t += H[180] * x[9]; t += H[182] * x[11]; t += H[184] * x[13]; t += H[186] * x[15]; t += H[188] * x[17]; x[18] = s - t; }
  { Real s = x[19], t = splat(0); s -= H[190] * x[0]; s -= H[192] * x[2]; s -= H[194] * x[4]; s -= H[206] * x[16]; s -= H[208] * x[18]; t += H[191] * x[1]; t += H[193] * x[3]; t += H[195] * x[5]; t += H[207] * x[17]; x[19] = s - t; }
  { Real s = x[20], t = splat(0); s -= H[210] * x[0]; s -= H[212] * x[2]; s -= H[214] * x[4]; s -= H[226] * x[16]; s -= H[228] * x[18]; t += H[211] * x[1]; t += H[213] * x[3]; t += H[215] * x[5]; t += H[227] * x[17]; t += H[229] * x[19]; x[20] = s - t; }
  { Real s = x[21], t = splat(0); s -= H[231] * x[0]; s -= H[233] * x[2]; s -= H[235] * x[4]; s -= H[247] * x[16]; s -= H[249] * x[18]; s -= H[251] * x[20]; t += H[232] * x[1]; t += H[234] * x[3]; t += H[236] * x[5]; t += H[248] * x[17]; t += H[250] * x[19]; x[21] = s - t; }
  { Real s = x[22], t = splat(0); s -= H[253] * x[0]; s -= H[255] * x[2]; s -= H[257] * x[4]; s -= H[269] * x[16]; s -= H[271] * x[18]; s -= H[273] * x[20]; t += H[254] * x[1]; t += H[256] * x[3]; t += H[258] * x[5]; t += H[270] * x[17]; t += H[272] * x[19]; t += H[274] * x[21]; x[22] = s - t; }
  { Real s = x[23], t = splat(0); s -= H[276] * x[0]; s -= H[278] * x[2]; s -= H[280] * x[4]; s -= H[284] * x[8]; s -= H[286] * x[10]; s -= H[288] * x[12]; s -= H[290] * x[14]; s -= H[292] * x[16]; t += H[277] * x[1]; t += H[279] * x[3]; t += H[281] * x[5]; t += H[285] * x[9]; t += H[287] * x[11]; t += H[289] * x[13]; t += H[291] * x[15]; x[23] = s - t; }
  { Real s = x[24], t = splat(0); s -= H[300] * x[0]; s -= H[302] * x[2]; s -= H[304] * x[4]; s -= H[308] * x[8]; s -= H[310] * x[10]; s -= H[312] * x[12]; s -= H[314] * x[14]; s -= H[316] * x[16]; t += H[301] * x[1]; t += H[303] * x[3]; t += H[305] * x[5]; t += H[309] * x[9]; t += H[311] * x[11]; t += H[313] * x[13]; t += H[315] * x[15]; t += H[323] * x[23]; x[24] = s - t; }
  { Real s = x[25], t = splat(0); s -= H[325] * x[0]; s -= H[327] * x[2]; s -= H[329] * x[4]; s -= H[341] * x[16]; s -= H[349] * x[24]; t += H[326] * x[1]; t += H[328] * x[3]; t += H[330] * x[5]; t += H[348] * x[23]; x[25] = s - t; }
  { Real s = x[26], t = splat(0); s -= H[351] * x[0]; s -= H[353] * x[2]; s -= H[355] * x[4]; s -= H[367] * x[16]; s -= H[375] * x[24]; t += H[352] * x[1]; t += H[354] * x[3]; t += H[356] * x[5]; t += H[374] * x[23]; t += H[376] * x[25]; x[26] = s - t; }
  { Real s = x[27], t = splat(0); s -= H[378] * x[0]; s -= H[380] * x[2]; s -= H[382] * x[4]; s -= H[394] * x[16]; s -= H[402] * x[24]; s -= H[404] * x[26]; t += H[379] * x[1]; t += H[381] * x[3]; t += H[383] * x[5]; t += H[401] * x[23]; t += H[403] * x[25]; x[27] = s - t; }
  { Real s = x[28], t = splat(0); s -= H[406] * x[0]; s -= H[408] * x[2]; s -= H[410] * x[4]; s -= H[422] * x[16]; s -= H[430] * x[24]; s -= H[432] * x[26]; t += H[407] * x[1]; t += H[409] * x[3]; t += H[411] * x[5]; t += H[429] * x[23]; t += H[431] * x[25]; t += H[433] * x[27]; x[28] = s - t; }
}
inline void mul_tree(const Real* __restrict M, const Real* __restrict x, Real* __restrict y) {
  y[0] = (M[0] * x[0] + M[1] * x[1] + M[3] * x[2] + M[6] * x[3] + M[10] * x[4] + M[15] * x[5] + M[21] * x[6] + M[28] * x[7] + M[36] * x[8] + M[45] * x[9] + M[55] * x[10] + M[66] * x[11] + M[78] * x[12] + M[91] * x[13]) + (M[105] * x[14] + M[120] * x[15] + M[136] * x[16] + M[153] * x[17] + M[171] * x[18] + M[190] * x[19] + M[210] * x[20] + M[231] * x[21] + M[253] * x[22] + M[276] * x[23] + M[300] * x[24] + M[325] * x[25] + M[351] * x[26] + M[378] * x[27] + M[406] * x[28]);
  y[1] = (M[1] * x[0] + M[2] * x[1] + M[4] * x[2] + M[7] * x[3] + M[11] * x[4] + M[16] * x[5] + M[22] * x[6] + M[29] * x[7] + M[37] * x[8] + M[46] * x[9] + M[56] * x[10] + M[67] * x[11] + M[79] * x[12] + M[92] * x[13]) + (M[106] * x[14] + M[121] * x[15] + M[137] * x[16] + M[154] * x[17] + M[172] * x[18] + M[191] * x[19] + M[211] * x[20] + M[232] * x[21] + M[254] * x[22] + M[277] * x[23] + M[301] * x[24] + M[326] * x[25] + M[352] * x[26] + M[379] * x[27] + M[407] * x[28]);
  y[2] = (M[3] * x[0] + M[4] * x[1] + M[5] * x[2] + M[8] * x[3] + M[12] * x[4] + M[17] * x[5] + M[23] * x[6] + M[30] * x[7] + M[38] * x[8] + M[47] * x[9] + M[57] * x[10] + M[68] * x[11] + M[80] * x[12] + M[93] * x[13]) + (M[107] * x[14] + M[122] * x[15] + M[138] * x[16] + M[155] * x[17] + M[173] * x[18] + M[192] * x[19] + M[212] * x[20] + M[233] * x[21] + M[255] * x[22] + M[278] * x[23] + M[302] * x[24] + M[327] * x[25] + M[353] * x[26] + M[380] * x[27] + M[408] * x[28]);
  y[3] = (M[6] * x[0] + M[7] * x[1] + M[8] * x[2] + M[9] * x[3] + M[13] * x[4] + M[18] * x[5] + M[24] * x[6] + M[31] * x[7] + M[39] * x[8] + M[48] * x[9] + M[58] * x[10] + M[69] * x[11] + M[81] * x[12] + M[94] * x[13]) + (M[108] * x[14] + M[123] * x[15] + M[139] * x[16] + M[156] * x[17] + M[174] * x[18] + M[193] * x[19] + M[213] * x[20] + M[234] * x[21] + M[256] * x[22] + M[279] * x[23] + M[303] * x[24] + M[328] * x[25] + M[354] * x[26] + M[381] * x[27] + M[409] * x[28]);
  y[4] = (M[10] * x[0] + M[11] * x[1] + M[12] * x[2] + M[13] * x[3] + M[14] * x[4] + M[19] * x[5] + M[25] * x[6] + M[32] * x[7] + M[40] * x[8] + M[49] * x[9] + M[59] * x[10] + M[70] * x[11] + M[82] * x[12] + M[95] * x[13]) + (M[109] * x[14] + M[124] * x[15] + M[140] * x[16] + M[157] * x[17] + M[175] * x[18] + M[194] * x[19] + M[214] * x[20] + M[235] * x[21] + M[257] * x[22] + M[280] * x[23] + M[304] * x[24] + M[329] * x[25] + M[355] * x[26] + M[382] * x[27] + M[410] * x[28]);
  y[5] = (M[15] * x[0] + M[16] * x[1] + M[17] * x[2] + M[18] * x[3] + M[19] * x[4] + M[20] * x[5] + M[26] * x[6] + M[33] * x[7] + M[41] * x[8] + M[50] * x[9] + M[60] * x[10] + M[71] * x[11] + M[83] * x[12] + M[96] * x[13]) + (M[110] * x[14] + M[125] * x[15] + M[141] * x[16] + M[158] * x[17] + M[176] * x[18] + M[195] * x[19] + M[215] * x[20] + M[236] * x[21] + M[258] * x[22] + M[281] * x[23] + M[305] * x[24] + M[330] * x[25] + M[356] * x[26] + M[383] * x[27] + M[411] * x[28]);
  y[6] = (M[21] * x[0] + M[22] * x[1] + M[23] * x[2] + M[24] * x[3]) + (M[25] * x[4] + M[26] * x[5] + M[27] * x[6] + M[34] * x[7]);
  y[7] = (M[28] * x[0] + M[29] * x[1] + M[30] * x[2] + M[31] * x[3]) + (M[32] * x[4] + M[33] * x[5] + M[34] * x[6] + M[35] * x[7]);
  y[8] = (M[36] * x[0] + M[37] * x[1] + M[38] * x[2] + M[39] * x[3] + M[40] * x[4]) + (M[41] * x[5] + M[44] * x[8] + M[53] * x[9] + M[63] * x[10] + M[74] * x[11]);
  y[9] = (M[45] * x[0] + M[46] * x[1] + M[47] * x[2] + M[48] * x[3] + M[49] * x[4]) + (M[50] * x[5] + M[53] * x[8] + M[54] * x[9] + M[64] * x[10] + M[75] * x[11]);
  y[10] = (M[55] * x[0] + M[56] * x[1] + M[57] * x[2] + M[58] * x[3] + M[59] * x[4]) + (M[60] * x[5] + M[63] * x[8] + M[64] * x[9] + M[65] * x[10] + M[76] * x[11]);
  y[11] = (M[66] * x[0] + M[67] * x[1] + M[68] * x[2] + M[69] * x[3] + M[70] * x[4]) + (M[71] * x[5] + M[74] * x[8] + M[75] * x[9] + M[76] * x[10] + M[77] * x[11]);
  y[12] = (M[78] * x[0] + M[79] * x[1] + M[80] * x[2] + M[81] * x[3] + M[82] * x[4]) + (M[83] * x[5] + M[90] * x[12] + M[103] * x[13] + M[117] * x[14] + M[132] * x[15]);
  y[13] = (M[91] * x[0] + M[92] * x[1] + M[93] * x[2] + M[94] * x[3] + M[95] * x[4]) + (M[96] * x[5] + M[103] * x[12] + M[104] * x[13] + M[118] * x[14] + M[133] * x[15]);
  y[14] = (M[105] * x[0] + M[106] * x[1] + M[107] * x[2] + M[108] * x[3] + M[109] * x[4]) + (M[110] * x[5] + M[117] * x[12] + M[118] * x[13] + M[119] * x[14] + M[134] * x[15]);
  y[15] = (M[120] * x[0] + M[121] * x[1] + M[122] * x[2] + M[123] * x[3] + M[124] * x[4]) + (M[125] * x[5] + M[132] * x[12] + M[133] * x[13] + M[134] * x[14] + M[135] * x[15]);
  y[16] = (M[136] * x[0] + M[137] * x[1] + M[138] * x[2] + M[139] * x[3] + M[140] * x[4] + M[141] * x[5] + M[152] * x[16] + M[169] * x[17] + M[187] * x[18]) + (M[206] * x[19] + M[226] * x[20] + M[247] * x[21] + M[269] * x[22] + M[292] * x[23] + M[316] * x[24] + M[341] * x[25] + M[367] * x[26] + M[394] * x[27] + M[422] * x[28]);
  y[17] = (M[153] * x[0] + M[154] * x[1] + M[155] * x[2] + M[156] * x[3] + M[157] * x[4] + M[158] * x[5]) + (M[169] * x[16] + M[170] * x[17] + M[188] * x[18] + M[207] * x[19] + M[227] * x[20] + M[248] * x[21] + M[270] * x[22]);
  y[18] = (M[171] * x[0] + M[172] * x[1] + M[173] * x[2] + M[174] * x[3] + M[175] * x[4] + M[176] * x[5]) + (M[187] * x[16] + M[188] * x[17] + M[189] * x[18] + M[208] * x[19] + M[228] * x[20] + M[249] * x[21] + M[271] * x[22]);
  y[19] = (M[190] * x[0] + M[191] * x[1] + M[192] * x[2] + M[193] * x[3] + M[194] * x[4] + M[195] * x[5]) + (M[206] * x[16] + M[207] * x[17] + M[208] * x[18] + M[209] * x[19] + M[229] * x[20] + M[250] * x[21] + M[272] * x[22]);
  y[20] = (M[210] * x[0] + M[211] * x[1] + M[212] * x[2] + M[213] * x[3] + M[214] * x[4] + M[215] * x[5]) + (M[226] * x[16] + M[227] * x[17] + M[228] * x[18] + M[229] * x[19] + M[230] * x[20] + M[251] * x[21] + M[273] * x[22]);
  y[21] = (M[231] * x[0] + M[232] * x[1] + M[233] * x[2] + M[234] * x[3] + M[235] * x[4] + M[236] * x[5]) + (M[247] * x[16] + M[248] * x[17] + M[249] * x[18] + M[250] * x[19] + M[251] * x[20] + M[252] * x[21] + M[274] * x[22]);
  y[22] = (M[253] * x[0] + M[254] * x[1] + M[255] * x[2] + M[256] * x[3] + M[257] * x[4] + M[258] * x[5]) + (M[269] * x[16] + M[270] * x[17] + M[271] * x[18] + M[272] * x[19] + M[273] * x[20] + M[274] * x[21] + M[275] * x[22]);
  y[23] = (M[276] * x[0] + M[277] * x[1] + M[278] * x[2] + M[279] * x[3] + M[280] * x[4] + M[281] * x[5]) + (M[292] * x[16] + M[299] * x[23] + M[323] * x[24] + M[348] * x[25] + M[374] * x[26] + M[401] * x[27] + M[429] * x[28]);
  y[24] = (M[300] * x[0] + M[301] * x[1] + M[302] * x[2] + M[303] * x[3] + M[304] * x[4] + M[305] * x[5]) + (M[316] * x[16] + M[323] * x[23] + M[324] * x[24] + M[349] * x[25] + M[375] * x[26] + M[402] * x[27] + M[430] * x[28]);
  y[25] = (M[325] * x[0] + M[326] * x[1] + M[327] * x[2] + M[328] * x[3] + M[329] * x[4] + M[330] * x[5]) + (M[341] * x[16] + M[348] * x[23] + M[349] * x[24] + M[350] * x[25] + M[376] * x[26] + M[403] * x[27] + M[431] * x[28]);
  y[26] = (M[351] * x[0] + M[352] * x[1] + M[353] * x[2] + M[354] * x[3] + M[355] * x[4] + M[356] * x[5]) + (M[367] * x[16] + M[374] * x[23] + M[375] * x[24] + M[376] * x[25] + M[377] * x[26] + M[404] * x[27] + M[432] * x[28]);
  y[27] = (M[378] * x[0] + M[379] * x[1] + M[380] * x[2] + M[381] * x[3] + M[382] * x[4] + M[383] * x[5]) + (M[394] * x[16] + M[401] * x[23] + M[402] * x[24] + M[403] * x[25] + M[404] * x[26] + M[405] * x[27] + M[433] * x[28]);
  y[28] = (M[406] * x[0] + M[407] * x[1] + M[408] * x[2] + M[409] * x[3] + M[410] * x[4] + M[411] * x[5]) + (M[422] * x[16] + M[429] * x[23] + M[430] * x[24] + M[431] * x[25] + M[432] * x[26] + M[433] * x[27] + M[434] * x[28]);
}
inline void copy_tree_fast(const Real* __restrict a, Real* __restrict b) {
  b[0] = a[0];
  b[1] = a[1];
  b[2] = a[2];
  b[3] = a[3];
  b[4] = a[4];
  b[5] = a[5];
  b[6] = a[6];
  b[7] = a[7];
  b[8] = a[8];
  b[9] = a[9];
  b[10] = a[10];
  b[11] = a[11];
  b[12] = a[12];
  b[13] = a[13];
  b[14] = a[14];
  b[15] = a[15];
  b[16] = a[16];
  b[17] = a[17];
  b[18] = a[18];
  b[19] = a[19];
  b[20] = a[20];
  b[21] = a[21];
  b[22] = a[22];
  b[23] = a[23];
  b[24] = a[24];
  b[25] = a[25];
  b[26] = a[26];
  b[27] = a[27];
  b[28] = a[28];
  b[29] = a[29];
  b[30] = a[30];
  b[31] = a[31];
  b[32] = a[32];
  b[33] = a[33];
  b[34] = a[34];
  b[35] = a[35];
  b[36] = a[36];
  b[37] = a[37];
  b[38] = a[38];
  b[39] = a[39];
  b[40] = a[40];
  b[41] = a[41];
  b[44] = a[44];
  b[45] = a[45];
  b[46] = a[46];
  b[47] = a[47];
  b[48] = a[48];
  b[49] = a[49];
  b[50] = a[50];
  b[53] = a[53];
  b[54] = a[54];
  b[55] = a[55];
  b[56] = a[56];
  b[57] = a[57];
  b[58] = a[58];
  b[59] = a[59];
  b[60] = a[60];
  b[63] = a[63];
  b[64] = a[64];
  b[65] = a[65];
  b[66] = a[66];
  b[67] = a[67];
  b[68] = a[68];
  b[69] = a[69];
  b[70] = a[70];
  b[71] = a[71];
  b[74] = a[74];
  b[75] = a[75];
  b[76] = a[76];
  b[77] = a[77];
  b[78] = a[78];
  b[79] = a[79];
  b[80] = a[80];
  b[81] = a[81];
  b[82] = a[82];
  b[83] = a[83];
  b[90] = a[90];
  b[91] = a[91];
  b[92] = a[92];
  b[93] = a[93];
  b[94] = a[94];
  b[95] = a[95];
  b[96] = a[96];
  b[103] = a[103];
  b[104] = a[104];
  b[105] = a[105];
  b[106] = a[106];
  b[107] = a[107];
  b[108] = a[108];
  b[109] = a[109];
  b[110] = a[110];
  b[117] = a[117];
  b[118] = a[118];
  b[119] = a[119];
  b[120] = a[120];
  b[121] = a[121];
  b[122] = a[122];
  b[123] = a[123];
  b[124] = a[124];
  b[125] = a[125];
  b[132] = a[132];
  b[133] = a[133];
  b[134] = a[134];
  b[135] = a[135];
  b[136] = a[136];
  b[137] = a[137];
  b[138] = a[138];
  b[139] = a[139];
  b[140] = a[140];
  b[141] = a[141];
  b[152] = a[152];
  b[153] = a[153];
  b[154] = a[154];
  b[155] = a[155];
  b[156] = a[156];
  b[157] = a[157];
  b[158] = a[158];
  b[169] = a[169];
  b[170] = a[170];
  b[171] = a[171];
  b[172] = a[172];
  b[173] = a[173];
  b[174] = a[174];
  b[175] = a[175];
  b[176] = a[176];
  b[187] = a[187];
  b[188] = a[188];
  b[189] = a[189];
  b[190] = a[190];
  b[191] = a[191];
  b[192] = a[192];
  b[193] = a[193];
  b[194] = a[194];
  b[195] = a[195];
  b[206] = a[206];
  b[207] = a[207];
  b[208] = a[208];
  b[209] = a[209];
  b[210] = a[210];
  b[211] = a[211];
  b[212] = a[212];
  b[213] = a[213];
  b[214] = a[214];
  b[215] = a[215];
  b[226] = a[226];
  b[227] = a[227];
  b[228] = a[228];
  b[229] = a[229];
  b[230] = a[230];
  b[231] = a[231];
  b[232] = a[232];
  b[233] = a[233];
  b[234] = a[234];
  b[235] = a[235];
  b[236] = a[236];
  b[247] = a[247];
  b[248] = a[248];
  b[249] = a[249];
  b[250] = a[250];
  b[251] = a[251];
  b[252] = a[252];
  b[253] = a[253];
  b[254] = a[254];
  b[255] = a[255];
  b[256] = a[256];
  b[257] = a[257];
  b[258] = a[258];
  b[269] = a[269];
  b[270] = a[270];
  b[271] = a[271];
  b[272] = a[272];
  b[273] = a[273];
  b[274] = a[274];
  b[275] = a[275];
  b[276] = a[276];
  b[277] = a[277];
  b[278] = a[278];
  b[279] = a[279];
  b[280] = a[280];
  b[281] = a[281];
  b[292] = a[292];
  b[299] = a[299];
  b[300] = a[300];
  b[301] = a[301];
  b[302] = a[302];
  b[303] = a[303];
  b[304] = a[304];
  b[305] = a[305];
  b[316] = a[316];
  b[323] = a[323];
  b[324] = a[324];
  b[325] = a[325];
  b[326] = a[326];
  b[327] = a[327];
  b[328] = a[328];
  b[329] = a[329];
  b[330] = a[330];
  b[341] = a[341];
  b[348] = a[348];
  b[349] = a[349];
  b[350] = a[350];
  b[351] = a[351];
  b[352] = a[352];
  b[353] = a[353];
  b[354] = a[354];
  b[355] = a[355];
  b[356] = a[356];
  b[367] = a[367];
  b[374] = a[374];
  b[375] = a[375];
  b[376] = a[376];
  b[377] = a[377];
  b[378] = a[378];
  b[379] = a[379];
  b[380] = a[380];
  b[381] = a[381];
  b[382] = a[382];
  b[383] = a[383];
  b[394] = a[394];
  b[401] = a[401];
  b[402] = a[402];
  b[403] = a[403];
  b[404] = a[404];
  b[405] = a[405];
  b[406] = a[406];
  b[407] = a[407];
  b[408] = a[408];
  b[409] = a[409];
  b[410] = a[410];
  b[411] = a[411];
  b[422] = a[422];
  b[429] = a[429];
  b[430] = a[430];
  b[431] = a[431];
  b[432] = a[432];
  b[433] = a[433];
  b[434] = a[434];
}
inline void zero_fill(Real* b) {
  const Real z = splat(0);
  b[86] = z;
  b[87] = z;
  b[88] = z;
  b[89] = z;
  b[99] = z;
  b[100] = z;
  b[101] = z;
  b[102] = z;
  b[113] = z;
  b[114] = z;
  b[115] = z;
  b[116] = z;
  b[128] = z;
  b[129] = z;
  b[130] = z;
  b[131] = z;
  b[144] = z;
  b[145] = z;
  b[146] = z;
  b[147] = z;
  b[148] = z;
  b[149] = z;
  b[150] = z;
  b[151] = z;
  b[161] = z;
  b[162] = z;
  b[163] = z;
  b[164] = z;
  b[165] = z;
  b[166] = z;
  b[167] = z;
  b[168] = z;
  b[179] = z;
  b[180] = z;
  b[181] = z;
  b[182] = z;
  b[183] = z;
  b[184] = z;
  b[185] = z;
  b[186] = z;
  b[284] = z;
  b[285] = z;
  b[286] = z;
  b[287] = z;
  b[288] = z;
  b[289] = z;
  b[290] = z;
  b[291] = z;
  b[308] = z;
  b[309] = z;
  b[310] = z;
  b[311] = z;
  b[312] = z;
  b[313] = z;
  b[314] = z;
  b[315] = z;
}
