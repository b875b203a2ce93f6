// MuJoCo's convex cost of the accelerations of a group of humanoids, minimised by Newton's method to the end.
//
// cost(a) = 1/2 (a - a_smooth)^T M (a - a_smooth) + sum of s(J a - aref) over the rows. It is strictly convex and piecewise
// quadratic: whichever exact method finds the minimum finds MuJoCo's.
#pragma once
#include "humanoid_contacts.hpp"

namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA {

// Velocities of the bodies that x means.
inline void twists(Work& w, const Real* x) {
  const Rot& r0 = w.rot[0];
  w.tw[0] = {{r0.m[0][0] * x[3] + r0.m[0][1] * x[4] + r0.m[0][2] * x[5], r0.m[1][0] * x[3] + r0.m[1][1] * x[4] + r0.m[1][2] * x[5],
              r0.m[2][0] * x[3] + r0.m[2][1] * x[4] + r0.m[2][2] * x[5]}, {x[0], x[1], x[2]}};
  for (int b = 1; b < kBodies; ++b)
    if (w.used[b]) {
      const Spatial& t = w.tw[kParent[b]];
      w.tw[b] = {t.w + x[5 + b] * w.ax[b], t.v + x[5 + b] * w.sv[b]};
    }
  if (w.speeds == kAll) w.tw[kBall] = {load(x + kSpeeds + 3), load(x + kSpeeds)};
}

// Spin and velocity of a body at a contact.
inline Spatial motion_at(const Work& w, int body, const Contact& c) {
  if (body < 0) return {zero_vec(), zero_vec()};
  const Spatial& t = w.tw[body];
  return {t.w, velocity_at(t, body == kBall ? c.ball : c.r)};
}

// J^T f of a contact's force and torque on one body.
inline void push(Work& w, int body, const Contact& c, Vec force, Vec torque, double sign) {
  if (body < 0) return;
  Spatial& to = w.wr[body];
  to.v = to.v + sign * force;
  to.w = to.w + sign * (cross(body == kBall ? c.ball : c.r, force) + torque);
}

// Forces along n, t1, t2 and active rows of a point.
inline void rows_point(Point& p, Real& cn, Real& c1, Real& c2, Mask& changed) {
  const Real m1 = p.mu * p.u1, m2 = p.mu * p.u2;
  const Real j0 = p.un + m1, j1 = p.un - m1, j2 = p.un + m2, j3 = p.un - m2;
  const Mask a0 = (j0 < 0.0) & p.exists, a1 = (j1 < 0.0) & p.exists, a2 = (j2 < 0.0) & p.exists, a3 = (j3 < 0.0) & p.exists;
  changed |= (a0 ^ p.active[0]) | (a1 ^ p.active[1]) | (a2 ^ p.active[2]) | (a3 ^ p.active[3]);
  p.active[0] = a0, p.active[1] = a1, p.active[2] = a2, p.active[3] = a3;
  const Real z = splat(0);
  const Real f0 = a0 ? -p.d * j0 : z, f1 = a1 ? -p.d * j1 : z, f2 = a2 ? -p.d * j2 : z, f3 = a3 ? -p.d * j3 : z;
  cn = f0 + f1 + f2 + f3, c1 = p.mu * (f0 - f1), c2 = p.mu * (f2 - f3);
}

// Forces and active rows at the current J a - aref; gradient = Ma - fs - J^T f
inline Mask rows(const Shared& m, Work& w) {
  Mask changed = Mask{};
  const Real z = splat(0);
  for (int b = 0; b < kBodies; ++b) if (w.used[b]) w.wr[b] = {{z, z, z}, {z, z, z}};
  for (int i = 0; i < w.npt; ++i) {
    Point& p = w.pt[i];
    Real fn, f1, f2;
    rows_point(p, fn, f1, f2, changed);
    const Vec F = {p.tx * f1 - p.ty * f2, p.ty * f1 + p.tx * f2, fn};
    w.wr[p.body].v = w.wr[p.body].v + F;
    w.wr[p.body].w = w.wr[p.body].w + cross(p.r, F);
  }
  for (int i = 0; i < w.speeds; ++i) w.g[i] = w.Ma[i] - w.fs[i];
  for (int i = 0; i < w.npr; ++i) {
    Pair& p = w.pr[i];
    const Real m1 = p.mu * p.u1, m2 = p.mu * p.u2;
    const Real j[4] = {p.un + m1, p.un - m1, p.un + m2, p.un - m2};
    Real f[4];
    for (int k = 0; k < 4; ++k) {
      const Mask a = (j[k] < 0.0) & p.exists;
      changed |= a ^ p.active[k];
      p.active[k] = a;
      f[k] = a ? -p.d * j[k] : z;
    }
    const Real fn = f[0] + f[1] + f[2] + f[3], f1 = p.mu * (f[0] - f[1]), f2 = p.mu * (f[2] - f[3]);
    const Vec F = fn * p.n + f1 * p.t + f2 * p.s, t = cross(p.r, F);
    w.wr[p.b].v = w.wr[p.b].v + F, w.wr[p.b].w = w.wr[p.b].w + t;
    w.wr[p.a].v = w.wr[p.a].v - F, w.wr[p.a].w = w.wr[p.a].w - t;
  }
  w.wr[kBall] = {{z, z, z}, {z, z, z}};
  for (Contact& p : w.more) {
    Real f[6] = {z, z, z, z, z, z};
    for (int k = 1; k < p.dim; ++k) {
      const Real m1 = p.mu[k - 1] * p.u[k], j[2] = {p.u[0] + m1, p.u[0] - m1};
      Real r[2];
      for (int i = 0; i < 2; ++i) {
        Mask& active = p.active[2 * k - 2 + i];
        const Mask a = (j[i] < 0.0) & p.exists;
        changed |= a ^ active;
        active = a;
        r[i] = a ? -p.d * j[i] : z;
      }
      f[0] += r[0] + r[1], f[k] = p.mu[k - 1] * (r[0] - r[1]);
    }
    const Vec force = f[0] * p.n + f[1] * p.t + f[2] * p.s, torque = f[3] * p.n + f[4] * p.t + f[5] * p.s;
    push(w, p.b, p, force, torque, 1.0), push(w, p.a, p, force, torque, -1.0);
  }
  if (w.speeds == kAll) {
    const Spatial& f = w.wr[kBall];
    Real* g = w.g + kSpeeds;
    g[0] -= f.v.x, g[1] -= f.v.y, g[2] -= f.v.z, g[3] -= f.w.x, g[4] -= f.w.y, g[5] -= f.w.z;
  }
  for (int b = kBodies - 1; b > 0.0; --b)
    if (w.used[b]) {
      const Spatial& f = w.wr[b];
      w.g[5 + b] -= dot(w.ax[b], f.w) + dot(w.sv[b], f.v);
      Spatial& q = w.wr[kParent[b]];
      q = q + f;
    }
  if (w.used[0]) {
    const Spatial& f = w.wr[0];
    const Vec t = inverse_rotate(w.rot[0], f.w);
    w.g[0] -= f.v.x, w.g[1] -= f.v.y, w.g[2] -= f.v.z, w.g[3] -= t.x, w.g[4] -= t.y, w.g[5] -= t.z;
  }
  for (int k = 0; k < w.nlim; ++k) {
    const int j = w.lim[k];
    const Real jar = w.lim_s[k] * w.a[6 + j] + w.lim_c[k];
    const Mask a = (jar < 0.0) & (w.lim_d[k] > 0.0);
    changed |= a ^ w.lim_act[k];
    w.lim_act[k] = a;
    w.g[6 + j] += a ? w.lim_d[k] * w.lim_s[k] * jar : z;
  }
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) {
    const Real jar = w.a[6 + j] + w.fc[j];
    const Mask quad = abs(jar) * w.fd[j] < m.friction_loss, up = jar > 0.0;
    changed |= (quad ^ w.zone[j][0]) | (~quad & (up ^ w.zone[j][1]));
    w.zone[j][0] = quad, w.zone[j][1] = up;
    w.g[6 + j] += quad ? w.fd[j] * jar : up ? splat(m.friction_loss) : splat(-m.friction_loss);
  }
  return changed;
}

inline void add_row(Work& w, Real* A, int b, Spatial f) {
  const int i = 5 + b;
  Real* row = A + at(i, 0);
  const Vec t = inverse_rotate(w.rot[0], f.w);
  row[0] += f.v.x, row[1] += f.v.y, row[2] += f.v.z, row[3] += t.x, row[4] += t.y, row[5] += t.z;
  for (int a = b; a > 0.0; a = kParent[a]) row[5 + a] += dot(w.ax[a], f.w) + dot(w.sv[a], f.v);
}

// Mask: 0-5 ww (xx yy zz xy xz yz), 6-14 wv row-major, 15-20 vv (xx yy zz xy xz yz)
inline Spatial stiff(const Real* k, Spatial s) {
  return {{k[0] * s.w.x + k[3] * s.w.y + k[4] * s.w.z + k[6] * s.v.x + k[7] * s.v.y + k[8] * s.v.z,
           k[3] * s.w.x + k[1] * s.w.y + k[5] * s.w.z + k[9] * s.v.x + k[10] * s.v.y + k[11] * s.v.z,
           k[4] * s.w.x + k[5] * s.w.y + k[2] * s.w.z + k[12] * s.v.x + k[13] * s.v.y + k[14] * s.v.z},
          {k[6] * s.w.x + k[9] * s.w.y + k[12] * s.w.z + k[15] * s.v.x + k[18] * s.v.y + k[19] * s.v.z,
           k[7] * s.w.x + k[10] * s.w.y + k[13] * s.w.z + k[18] * s.v.x + k[16] * s.v.y + k[20] * s.v.z,
           k[8] * s.w.x + k[11] * s.w.y + k[14] * s.w.z + k[19] * s.v.x + k[20] * s.v.y + k[17] * s.v.z}};
}

// J^T D J of a self contact, over the joints between its bodies.
inline void pair_hessian(Work& w, const Pair& p) {
  const Between& c = kBetween.of[p.a][p.b];
  const Real z = splat(0), mu = p.mu;
  const Real d0 = p.active[0] ? p.d : z, d1 = p.active[1] ? p.d : z, d2 = p.active[2] ? p.d : z, d3 = p.active[3] ? p.d : z;
  if (!any((d0 + d1 + d2 + d3) > 0.0)) return;
  const Real nn = d0 + d1 + d2 + d3, n1 = mu * (d0 - d1), n2 = mu * (d2 - d3), w1 = mu * mu * (d0 + d1), w2 = mu * mu * (d2 + d3);
  Vec col[32];  // in the contact's frame
  for (int i = 0; i < c.count; ++i) {
    const int b = c.joints[i] - 5;
    const Vec v = w.sv[b] + cross(w.ax[b], p.r);
    const Real s = splat(c.sign[i]);
    col[i] = {s * dot(p.n, v), s * dot(p.t, v), s * dot(p.s, v)};
  }
  for (int i = 0; i < c.count; ++i) {
    const Vec q = col[i], f = {nn * q.x + n1 * q.y + n2 * q.z, n1 * q.x + w1 * q.y, n2 * q.x + w2 * q.z};
    Real* row = w.H + at(c.joints[i], 0);
    for (int j = 0; j <= i; ++j) row[c.joints[j]] += dot(col[j], f);
  }
}

// The same of a contact that MuJoCo found, or of the ball: over the speeds that move either body.
inline void contact_hessian(Work& w, const Contact& p) {
  const Real z = splat(0);
  Real W[6][6], sum = z;
  for (auto& row : W)
    for (Real& entry : row) entry = z;
  for (int k = 1; k < p.dim; ++k) {
    const Real d0 = p.active[2 * k - 2] ? p.d : z, d1 = p.active[2 * k - 1] ? p.d : z, mu = p.mu[k - 1];
    sum += d0 + d1, W[0][k] = W[k][0] = mu * (d0 - d1), W[k][k] = mu * mu * (d0 + d1);
  }
  if (!any(sum > 0.0)) return;
  W[0][0] = sum;
  int speeds[kAll], count = 0;
  Real col[kAll][6];
  const auto add = [&](int speed, Vec v, Vec spin) {
    const Real all[6] = {dot(p.n, v), dot(p.t, v), dot(p.s, v), dot(p.n, spin), dot(p.t, spin), dot(p.s, spin)};
    for (int k = 0; k < p.dim; ++k) col[count][k] = all[k];
    speeds[count++] = speed;
  };
  const bool on_a = p.a >= 0 && p.a < kBodies, on_b = p.b >= 0 && p.b < kBodies;
  const Vec axes[3] = {{splat(1), z, z}, {z, splat(1), z}, {z, z, splat(1)}}, none = zero_vec();
  if (on_a != on_b) {
    const double sign = on_b ? 1.0 : -1.0;
    for (int k = 0; k < 3; ++k) add(k, sign * axes[k], none);
    for (int k = 0; k < 3; ++k) {
      const Vec spin = sign * w.rot[0].column(k);
      add(3 + k, cross(spin, p.r), spin);
    }
  }
  for (int b = 1; b < kBodies; ++b) {
    const bool ua = on_a && is_above(b, p.a), ub = on_b && is_above(b, p.b);
    if (ua == ub) continue;
    const double sign = ub ? 1.0 : -1.0;
    add(5 + b, sign * (w.sv[b] + cross(w.ax[b], p.r)), sign * w.ax[b]);
  }
  if (p.a == kBall || p.b == kBall) {
    const double sign = p.b == kBall ? 1.0 : -1.0;
    for (int k = 0; k < 3; ++k) add(kSpeeds + k, sign * axes[k], none);
    for (int k = 0; k < 3; ++k) add(kSpeeds + 3 + k, sign * cross(axes[k], p.ball), sign * axes[k]);
  }
  for (int i = 0; i < count; ++i) {
    Real f[6] = {z, z, z, z, z, z};
    for (int k = 0; k < p.dim; ++k) f[0] += W[0][k] * col[i][k];
    for (int k = 1; k < p.dim; ++k) f[k] = W[k][0] * col[i][0] + W[k][k] * col[i][k];
    Real* row = w.H + at(speeds[i], 0);
    for (int j = 0; j <= i; ++j) {
      Real s = z;
      for (int k = 0; k < p.dim; ++k) s += col[j][k] * f[k];
      row[speeds[j]] += s;
    }
  }
}

// H = M + J^T D J. The floor contacts of a body are a 6x6 stiffness about the reference point, which adds up the tree as inertias
// do, so H keeps the sparsity of M.
inline void hessian(const Shared& m, Work& w) {
  const Real z = splat(0);
  if (w.pattern == 1) zero_fill(w.H);
  else if (w.pattern == 2) for (int i = 0; i < kEntries; ++i) w.H[i] = z;
  copy_tree_fast(w.M, w.H);
  bool loaded[kBodies] = {false};
  int feeds[kBodies] = {0};  // stiffnesses that meet at a body: its own points and its children's
  for (int i = 0; i < w.npt;) {
    const int body = w.pt[i].body;
    Real k[21];
    for (int q = 0; q < 21; ++q) k[q] = z;
    for (; i < w.npt && w.pt[i].body == body; ++i) {
      const Point& p = w.pt[i];
      const Real d0 = p.active[0] ? p.d : z, d1 = p.active[1] ? p.d : z, d2 = p.active[2] ? p.d : z, d3 = p.active[3] ? p.d : z;
      const Real mu = p.mu;
      const Real nn = d0 + d1 + d2 + d3, n1 = mu * (d0 - d1), n2 = mu * (d2 - d3), w1 = mu * mu * (d0 + d1), w2 = mu * mu * (d2 + d3);
      const Real xx = w1 * p.tx * p.tx + w2 * p.ty * p.ty, yy = w1 * p.ty * p.ty + w2 * p.tx * p.tx, xy = (w1 - w2) * p.tx * p.ty;
      const Real xz = n1 * p.tx - n2 * p.ty, yz = n1 * p.ty + n2 * p.tx;
      const Vec cx = cross(p.r, {xx, xy, xz}), cy = cross(p.r, {xy, yy, yz}), cz = cross(p.r, {xz, yz, nn});  // columns of A = [r] W
      k[6] += cx.x, k[7] += cy.x, k[8] += cz.x, k[9] += cx.y, k[10] += cy.y, k[11] += cz.y, k[12] += cx.z, k[13] += cy.z, k[14] += cz.z;
      const Vec rx = cross(p.r, {cx.x, cy.x, cz.x}), ry = cross(p.r, {cx.y, cy.y, cz.y});
      k[0] += rx.x, k[1] += ry.y, k[2] += p.r.x * cy.z - p.r.y * cx.z, k[3] += rx.y, k[4] += rx.z, k[5] += ry.z;
      k[15] += xx, k[16] += yy, k[17] += nn, k[18] += xy, k[19] += xz, k[20] += yz;
    }
    for (int q = 0; q < 21; ++q) w.Kc[body][q] = k[q];
    ++feeds[body];
    for (int b = body; b > 0.0 && !loaded[b]; b = kParent[b]) { loaded[b] = true; ++feeds[kParent[b]]; }
    loaded[0] = true;
  }
  bool filled[kBodies] = {false};
  for (int i = 0; i < w.npt; ++i) filled[w.pt[i].body] = true;
  bool done[kBodies] = {false};
  for (int top = kBodies - 1; top > 0.0; --top) {
    if (!loaded[top] || done[top]) continue;  // its children's chains are done: they come later in the numbering
    Real k[21];
    for (int q = 0; q < 21; ++q) k[q] = w.Kc[top][q];
    for (int b = top; b > 0.0;) {
      add_row(w, w.H, b, stiff(k, {w.ax[b], w.sv[b]}));
      done[b] = true;
      const int p = kParent[b];
      if (feeds[p] > 1.0 || p == 0) {
        Real* q = w.Kc[p];
        if (filled[p]) for (int i = 0; i < 21; ++i) q[i] += k[i];
        else { filled[p] = true; for (int i = 0; i < 21; ++i) q[i] = k[i]; }
        break;
      }
      b = p;
    }
  }
  if (loaded[0]) {
    const Real* k = w.Kc[0];
    const Rot& r = w.rot[0];
    Real* A = w.H;
    A[at(0, 0)] += k[15], A[at(1, 1)] += k[16], A[at(2, 2)] += k[17], A[at(1, 0)] += k[18], A[at(2, 0)] += k[19], A[at(2, 1)] += k[20];
    for (int i = 0; i < 3; ++i) {
      const Spatial f = stiff(k, {r.column(i), {z, z, z}});
      A[at(3 + i, 0)] += f.v.x, A[at(3 + i, 1)] += f.v.y, A[at(3 + i, 2)] += f.v.z;
      for (int l = 0; l <= i; ++l) A[at(3 + i, 3 + l)] += dot(r.column(l), f.w);
    }
  }
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) w.H[at(6 + j, 6 + j)] += w.zone[j][0] ? w.fd[j] : z;
  for (int k = 0; k < w.nlim; ++k) w.H[at(6 + w.lim[k], 6 + w.lim[k])] += w.lim_act[k] ? w.lim_d[k] : z;
  for (int i = 0; i < w.npr; ++i) pair_hessian(w, w.pr[i]);
  if (w.speeds == kAll) {
    for (int i = at(kSpeeds, 0); i < kEntries; ++i) w.H[i] = z;
    for (int k = 0; k < 6; ++k) w.H[at(kSpeeds + k, kSpeeds + k)] = splat(k < 3 ? m.ball.mass : m.ball.inertia);
  }
  for (const Contact& c : w.more) contact_hessian(w, c);
}

inline void slope_point(Real d, Real mu, Real un, Real u1, Real u2, Real dn, Real d1, Real d2, Real al, Real& s1, Real& s2) {
  const Real z = splat(0);
  const Real m1 = mu * u1, m2 = mu * u2, e1 = mu * d1, e2 = mu * d2;
  const Real t0 = dn + e1, t1 = dn - e1, t2 = dn + e2, t3 = dn - e2;
  const Real j0 = un + m1 + al * t0, j1 = un - m1 + al * t1, j2 = un + m2 + al * t2, j3 = un - m2 + al * t3;
  const Real q0 = j0 < 0.0 ? t0 : z, q1 = j1 < 0.0 ? t1 : z, q2 = j2 < 0.0 ? t2 : z, q3 = j3 < 0.0 ? t3 : z;
  s1 += d * (q0 * j0 + q1 * j1 + q2 * j2 + q3 * j3);
  s2 += d * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3);
}
// First and second derivative of the cost at a + al p.
inline void slope(const Shared& m, const Work& w, Real al, Real g0, Real m0, Real& s1, Real& s2) {
  s1 = g0 + al * m0, s2 = m0;
  for (int i = 0; i < w.npt; ++i) {
    const Point& p = w.pt[i];
    slope_point(p.d, p.mu, p.un, p.u1, p.u2, p.dn, p.d1, p.d2, al, s1, s2);
  }
  for (int i = 0; i < w.npr; ++i) {
    const Pair& p = w.pr[i];
    slope_point(p.d, p.mu, p.un, p.u1, p.u2, p.dn, p.d1, p.d2, al, s1, s2);
  }
  for (const Contact& p : w.more)
    for (int k = 1; k < p.dim; ++k) {
      const Real m1 = p.mu[k - 1] * p.u[k], e1 = p.mu[k - 1] * p.du[k], t0 = p.du[0] + e1, t1 = p.du[0] - e1;
      const Real j0 = p.u[0] + m1 + al * t0, j1 = p.u[0] - m1 + al * t1, none = splat(0);
      const Real q0 = j0 < 0.0 ? t0 : none, q1 = j1 < 0.0 ? t1 : none;
      s1 += p.d * (q0 * j0 + q1 * j1);
      s2 += p.d * (q0 * q0 + q1 * q1);
    }
  for (int k = 0; k < w.nlim; ++k) {
    const Real dj = w.lim_s[k] * w.p[6 + w.lim[k]], j = w.lim_s[k] * w.a[6 + w.lim[k]] + w.lim_c[k] + al * dj;
    const Real q = j < 0.0 ? dj : splat(0);
    s1 += w.lim_d[k] * q * j, s2 += w.lim_d[k] * q * q;
  }
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) {
    const Real dj = w.p[6 + j], x = w.a[6 + j] + w.fc[j] + al * dj, f = x * w.fd[j];
    const Mask quad = abs(f) < m.friction_loss;
    s1 += (quad ? f : x > 0.0 ? splat(m.friction_loss) : splat(-m.friction_loss)) * dj;
    s2 += quad ? w.fd[j] * dj * dj : splat(0);
  }
}

// J x, into d; or J x - aref, into u.
inline void along(Work& w, const Real* x, bool direction) {
  twists(w, x);
  for (int i = 0; i < w.npt; ++i) {
    Point& p = w.pt[i];
    const Vec v = velocity_at(w.tw[p.body], p.r);
    const Real n = v.z, a = p.tx * v.x + p.ty * v.y, b = p.tx * v.y - p.ty * v.x;
    if (direction) p.dn = n, p.d1 = a, p.d2 = b;
    else p.un = n + p.cn, p.u1 = a + p.c1, p.u2 = b + p.c2;
  }
  for (int i = 0; i < w.npr; ++i) {
    Pair& p = w.pr[i];
    const Vec v = velocity_at(w.tw[p.b], p.r) - velocity_at(w.tw[p.a], p.r);
    const Real n = dot(p.n, v), a = dot(p.t, v), b = dot(p.s, v);
    if (direction) p.dn = n, p.d1 = a, p.d2 = b;
    else p.un = n + p.cn, p.u1 = a + p.c1, p.u2 = b + p.c2;
  }
  for (Contact& p : w.more) {
    const Spatial t = motion_at(w, p.b, p) - motion_at(w, p.a, p);
    const Real q[6] = {dot(p.n, t.v), dot(p.t, t.v), dot(p.s, t.v), dot(p.n, t.w), dot(p.t, t.w), dot(p.s, t.w)};
    for (int k = 0; k < p.dim; ++k) {
      if (direction) p.du[k] = q[k];
      else p.u[k] = q[k] + p.c[k];
    }
  }
}

constexpr int kMostIterations = 40, kFullSteps = 3, kMostEvaluations = 16;
constexpr double kTolerance = 1e-12, kSlopeTolerance = 1e-10;

// H = L^T D L. The ball's speeds are eliminated first, over the columns that any lane couples to them.
inline void factor(Work& w) {
  Real *H = w.H, *inv = w.inv;
  for (int k = w.speeds - 1; k >= kSpeeds; --k) {
    Real* row = H + at(k, 0);
    inv[k] = 1.0 / row[k];
    const int count = w.coupled + k - kSpeeds;
    const auto column = [&](int i) { return i < w.coupled ? w.columns[i] : kSpeeds + i - w.coupled; };
    for (int i = 0; i < count; ++i) {
      const Real f = row[column(i)] * inv[k];
      Real* to = H + at(column(i), 0);
      for (int j = 0; j <= i; ++j) to[column(j)] -= f * row[column(j)];
    }
    for (int i = 0; i < count; ++i) row[column(i)] *= inv[k];
  }
  w.pattern == 0 ? factor_tree(H, inv) : w.pattern == 1 ? factor_arms(H, inv) : factor_dense(H, inv);
}
inline void solve(const Work& w, Real* x) {
  const Real *H = w.H, *inv = w.inv;
  for (int k = w.speeds - 1; k >= kSpeeds; --k) {
    for (int i = 0; i < w.coupled; ++i) x[w.columns[i]] -= H[at(k, w.columns[i])] * x[k];
    for (int i = kSpeeds; i < k; ++i) x[i] -= H[at(k, i)] * x[k];
  }
  w.pattern == 0 ? solve_tree(H, inv, x) : w.pattern == 1 ? solve_arms(H, inv, x) : solve_dense(H, inv, x);
  for (int k = kSpeeds; k < w.speeds; ++k) {
    x[k] *= inv[k];
    for (int i = 0; i < w.coupled; ++i) x[k] -= H[at(k, w.columns[i])] * x[w.columns[i]];
    for (int i = kSpeeds; i < k; ++i) x[k] -= H[at(k, i)] * x[i];
  }
}

// M x, the ball included.
inline void multiply(const Shared& m, const Work& w, const Real* x, Real* y) {
  mul_tree(w.M, x, y);
  for (int k = kSpeeds; k < w.speeds; ++k) y[k] = (k < kSpeeds + 3 ? m.ball.mass : m.ball.inertia) * x[k];
}

// Newton's method from the last substep's accelerations. Full steps first, line searches after three. A lane is done when its
// gradient vanishes or a full step leaves the active rows as they were; lanes that do not get there are flagged.
inline void newton(const Shared& m, const Group& g, Work& w) {
  const Mask none = Mask{};
  for (int i = 0; i < w.speeds; ++i) w.a[i] = g.warm[i];
  multiply(m, w, w.a, w.Ma);
  along(w, w.a, false);
  for (int i = 0; i < w.npt; ++i)
    for (Mask& active : w.pt[i].active) active = none;
  for (int i = 0; i < w.npr; ++i)
    for (Mask& active : w.pr[i].active) active = none;
  for (Contact& c : w.more)
    for (Mask& active : c.active) active = none;
  for (int k = 0; k < w.nlim; ++k) w.lim_act[k] = none;
  for (int j = 0; j < kJoints; ++j) {
    w.fc[j] = m.friction_b * g.qvel[6 + j];
    w.fd[j] = m.friction_d0 / ((1.0 - m.friction_d0) * w.numbers.joint_weight[j]);
    w.zone[j][0] = w.zone[j][1] = none;
  }
  rows(m, w);
  Mask done = w.flagged;
  for (int& count : w.iterations) count = 0;
  for (int it = 0; it < kMostIterations; ++it) {
    Real gg = splat(0);
    for (int i = 0; i < w.speeds; ++i) gg += w.g[i] * w.g[i];
    done |= sqrt(gg) * w.numbers.scale < kTolerance;
    const unsigned left = bits(~done);
    if (left == 0) break;
    for (int l = 0; l < kLanes; ++l) w.iterations[l] += left >> l & 1u;
    hessian(m, w);
    factor(w);
    for (int i = 0; i < w.speeds; ++i) w.p[i] = -w.g[i];
    solve(w, w.p);
    multiply(m, w, w.p, w.Mp);
    along(w, w.p, true);
    Real g0 = splat(0), m0 = splat(0), pp = splat(0);
    for (int i = 0; i < w.speeds; ++i) g0 += w.p[i] * (w.Ma[i] - w.fs[i]), m0 += w.p[i] * w.Mp[i], pp += w.p[i] * w.p[i];
    const Real enough = kSlopeTolerance * sqrt(pp) / w.numbers.scale;
    Real al = splat(1), lo = splat(0), hi = splat(1e30);
    for (int e = 0; it >= kFullSteps && e < kMostEvaluations; ++e) {  // Newton's method on the slope, bisection where it leaves the bracket
      Real s1, s2;
      slope(m, w, al, g0, m0, s1, s2);
      const Mask ok = (abs(s1) < enough) | done;
      if (!any(~ok)) break;
      lo = select(s1 < 0.0, max(lo, al), lo);
      hi = select(s1 > 0.0, min(hi, al), hi);
      Real next = al - s1 / s2;
      next = select((next <= lo) | (next >= hi), 0.5 * (lo + min(hi, 2.0 * lo + 1.0)), next);
      al = select(ok, al, next);
    }
    const Real step = select(done, splat(0), al);
    // a lane that is done keeps its numbers, whatever its neighbours' steps are
    for (int i = 0; i < w.speeds; ++i) w.a[i] = select(done, w.a[i], w.a[i] + step * w.p[i]), w.Ma[i] = select(done, w.Ma[i], w.Ma[i] + step * w.Mp[i]);
    for (int i = 0; i < w.npt; ++i) {
      Point& p = w.pt[i];
      p.un += step * p.dn, p.u1 += step * p.d1, p.u2 += step * p.d2;
    }
    for (int i = 0; i < w.npr; ++i) {
      Pair& p = w.pr[i];
      p.un += step * p.dn, p.u1 += step * p.d1, p.u2 += step * p.d2;
    }
    for (Contact& p : w.more)
      for (int k = 0; k < p.dim; ++k) p.u[k] += step * p.du[k];
    const Mask changed = rows(m, w);
    done |= ~changed & (abs(al - 1.0) < 1e-9);
  }
  w.flagged |= ~done;
}

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
