/** Read numpy archives in the browser: .npz (stored or deflated) and .npy, numbers and booleans only. */

const TYPES = {
  f8: Float64Array,
  f4: Float32Array,
  i8: BigInt64Array,
  i4: Int32Array,
  i2: Int16Array,
  i1: Int8Array,
  u8: BigUint64Array,
  u4: Uint32Array,
  u2: Uint16Array,
  u1: Uint8Array,
  b1: Uint8Array,
};

/**
 * Read one .npy file.
 *
 * @param {ArrayBuffer} buffer
 * @returns {{shape: number[], data: ArrayLike<number>}} C order; 64-bit integers come as numbers.
 */
function readNpy(buffer) {
  const view = new DataView(buffer);
  if (view.getUint32(0) !== 0x934e554d) throw new Error("not a numpy array file");
  const wide = view.getUint8(6) >= 2;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const start = (wide ? 12 : 10) + length;
  const header = new TextDecoder().decode(new Uint8Array(buffer, wide ? 12 : 10, length));
  const descr = /'descr':\s*'([<>|=])([a-z]\d)'/.exec(header);
  const order = /'fortran_order':\s*(True|False)/.exec(header);
  const shape = /'shape':\s*\(([^)]*)\)/.exec(header);
  const Type = TYPES[descr?.[2]];
  if (!Type || descr[1] === ">" || order?.[1] !== "False" || !shape)
    throw new Error(`cannot read a numpy array like ${header.trim()}`);
  const dims = shape[1]
    .split(",")
    .map((t) => t.trim())
    .filter(Boolean)
    .map(Number);
  const size = dims.reduce((a, b) => a * b, 1);
  if (start + size * Type.BYTES_PER_ELEMENT > buffer.byteLength) throw new Error("the numpy array is cut short");
  const raw = new Type(buffer.slice(start, start + size * Type.BYTES_PER_ELEMENT));
  return {
    shape: dims,
    data: raw instanceof BigInt64Array || raw instanceof BigUint64Array ? Float64Array.from(raw, Number) : raw,
  };
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Response(stream).arrayBuffer();
}

/**
 * Read a .npz archive.
 *
 * @param {ArrayBuffer} buffer
 * @returns {Promise<Map<string, {shape: number[], data: ArrayLike<number>}>>} arrays by name
 */
export async function readNpz(buffer) {
  const view = new DataView(buffer);
  let end = buffer.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end -= 1;
  if (end < 0) throw new Error("not a numpy archive");
  const count = view.getUint16(end + 10, true);
  let at = view.getUint32(end + 16, true);
  const arrays = new Map();
  for (let i = 0; i < count; i++) {
    const method = view.getUint16(at + 10, true);
    const packed = view.getUint32(at + 20, true);
    const nameLength = view.getUint16(at + 28, true);
    const extra = view.getUint16(at + 30, true);
    const comment = view.getUint16(at + 32, true);
    const local = view.getUint32(at + 42, true);
    const name = new TextDecoder().decode(new Uint8Array(buffer, at + 46, nameLength));
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const bytes = buffer.slice(start, start + packed);
    if (method !== 0 && method !== 8) throw new Error(`${name}: unknown compression ${method}`);
    arrays.set(name.replace(/\.npy$/, ""), readNpy(method === 8 ? await inflate(bytes) : bytes));
    at += 46 + nameLength + extra + comment;
  }
  return arrays;
}
