// MuJoCo's convex cost of the accelerations of a group of humanoids, minimised by Newton's method to the end.
//
//     cost(a) = 1/2 (a - a_smooth)^T M (a - a_smooth) + sum over the rows of s(J a - aref)
//
// with M a_smooth = fs. A row of a contact or a limit is one-sided, s(x) = 1/2 D min(x, 0)^2: it is active where x < 0. A row of
// joint friction is s(x) = 1/2 D x^2 up to the friction loss f and linear with slope f beyond. The cost is strictly convex and
// piecewise quadratic, so every exact method ends at MuJoCo's minimum.
#pragma once
#include "humanoid_contacts.hpp"

namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA {

// --- products with J: the motion of bodies that speeds x mean, and the speeds' forces that forces on bodies mean ----------------------

// Twists of the bodies with contacts, for the generalised speeds x.
inline void twists(Work& w, const Real* x) {
  w.tw[0] = {w.rot[0] * load(x + 3), load(x)};
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

// J x of a point on the floor, of a pair: n, t, s.
inline Vec relative(const Work& w, const Point& p) {
  const Vec v = velocity_at(w.tw[p.body], p.r);
  return {v.z, p.tx * v.x + p.ty * v.y, p.tx * v.y - p.ty * v.x};
}
inline Vec relative(const Work& w, const Pair& p) {
  const Vec v = velocity_at(w.tw[p.b], p.r) - velocity_at(w.tw[p.a], p.r);
  return {dot(p.n, v), dot(p.t, v), dot(p.s, v)};
}
// J x of a contact in six dimensions: along n, t, s and about them.
inline void relative(const Work& w, const Contact& c, Real* q) {
  const Spatial x = motion_at(w, c.b, c) - motion_at(w, c.a, c);
  q[0] = dot(c.n, x.v), q[1] = dot(c.t, x.v), q[2] = dot(c.s, x.v), q[3] = dot(c.n, x.w), q[4] = dot(c.t, x.w), q[5] = dot(c.s, x.w);
}

// J a - aref of all contacts, for the accelerations a.
inline void residuals(Work& w, const Real* a) {
  twists(w, a);
  const auto pyramid = [&](auto& p) {
    const Vec q = relative(w, p);
    p.un = q.x + p.cn, p.ut = q.y + p.ct, p.us = q.z + p.cs;
  };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (Contact& c : w.more) {
    Real q[6];
    relative(w, c, q);
    for (int k = 0; k < c.dim; ++k) c.u[k] = q[k] + c.c[k];
  }
}

// J p of all contacts, for the direction p.
inline void directions(Work& w, const Real* direction) {
  twists(w, direction);
  const auto pyramid = [&](auto& p) {
    const Vec q = relative(w, p);
    p.pn = q.x, p.pt = q.y, p.ps = q.z;
  };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (Contact& c : w.more) {
    Real q[6];
    relative(w, c, q);
    for (int k = 0; k < c.dim; ++k) c.du[k] = q[k];
  }
}

// Add a contact's force and torque to what acts on one of its bodies.
inline void push(Work& w, int body, const Contact& c, Vec force, Vec torque, double sign) {
  if (body < 0) return;
  Spatial& to = w.wr[body];
  to.v = to.v + sign * force;
  to.w = to.w + sign * (cross(body == kBall ? c.ball : c.r, force) + torque);
}

// g -= J^T f: forces on bodies, summed from the leaves to the root, projected onto the axes.
inline void subtract_forces(Work& w) {
  if (w.speeds == kAll) {
    const Spatial& f = w.wr[kBall];
    Real* g = w.g + kSpeeds;
    g[0] -= f.v.x, g[1] -= f.v.y, g[2] -= f.v.z, g[3] -= f.w.x, g[4] -= f.w.y, g[5] -= f.w.z;
  }
  for (int b = kBodies - 1; b > 0; --b)
    if (w.used[b]) {
      const Spatial& f = w.wr[b];
      w.g[5 + b] -= dot(w.ax[b], f.w) + dot(w.sv[b], f.v);
      Spatial& parent = w.wr[kParent[b]];
      parent = parent + f;
    }
  if (w.used[0]) {
    const Spatial& f = w.wr[0];
    const Vec t = inverse_rotate(w.rot[0], f.w);
    w.g[0] -= f.v.x, w.g[1] -= f.v.y, w.g[2] -= f.v.z, w.g[3] -= t.x, w.g[4] -= t.y, w.g[5] -= t.z;
  }
}

// --- rows: which are active, their forces, the gradient -------------------------------------------------------------------------------

// Active rows of a pyramid, J a - aref < 0, or at the first look those remembered; and their forces -D (J a - aref) along n, t, s.
inline Vec pyramid_force(Pyramid& p, bool first, Mask& changed) {
  const Real mt = p.mu * p.ut, ms = p.mu * p.us, zero = splat(0);
  const Real x[4] = {p.un + mt, p.un - mt, p.un + ms, p.un - ms};
  Real f[4];
  for (int k = 0; k < 4; ++k) {
    Mask active = (x[k] < 0.0) & p.exists;
    if (first) active = (p.known & p.active[k]) | (~p.known & active);
    changed |= active ^ p.active[k];
    p.active[k] = active;
    f[k] = active ? -p.d * x[k] : zero;
  }
  return {f[0] + f[1] + f[2] + f[3], p.mu * (f[0] - f[1]), p.mu * (f[2] - f[3])};
}

// The same of a contact of 3 or 6 dimensions: its force along n, t, s and its torque about them.
inline void contact_force(Contact& c, Mask& changed, Real* f) {
  const Real zero = splat(0);
  for (int k = 0; k < 6; ++k) f[k] = zero;
  for (int k = 1; k < c.dim; ++k) {
    const Real side = c.mu[k - 1] * c.u[k], x[2] = {c.u[0] + side, c.u[0] - side};
    Real r[2];
    for (int i = 0; i < 2; ++i) {
      const Mask active = (x[i] < 0.0) & c.exists;
      changed |= active ^ c.active[2 * k - 2 + i];
      c.active[2 * k - 2 + i] = active;
      r[i] = active ? -c.d * x[i] : zero;
    }
    f[0] += r[0] + r[1], f[k] = c.mu[k - 1] * (r[0] - r[1]);
  }
}

// Active rows of all contacts, and their forces on the bodies.
inline void contact_forces(Work& w, bool first, Mask& changed) {
  for (int b = 0; b < kBodies; ++b)
    if (w.used[b]) w.wr[b] = {zero_vec(), zero_vec()};
  w.wr[kBall] = {zero_vec(), zero_vec()};
  for (int i = 0; i < w.npt; ++i) {  // points on the floor
    Point& p = w.pt[i];
    const Vec f = pyramid_force(p, first, changed), force = {p.tx * f.y - p.ty * f.z, p.ty * f.y + p.tx * f.z, f.x};
    Spatial& on = w.wr[p.body];
    on.v = on.v + force, on.w = on.w + cross(p.r, force);
  }
  for (int i = 0; i < w.npr; ++i) {  // pairs of geoms: equal and opposite
    Pair& p = w.pr[i];
    const Vec f = pyramid_force(p, first, changed), force = f.x * p.n + f.y * p.t + f.z * p.s, torque = cross(p.r, force);
    Spatial &on_a = w.wr[p.a], &on_b = w.wr[p.b];
    on_b.v = on_b.v + force, on_b.w = on_b.w + torque;
    on_a.v = on_a.v - force, on_a.w = on_a.w - torque;
  }
  for (Contact& c : w.more) {  // contacts that MuJoCo found, and the ball's
    Real f[6];
    contact_force(c, changed, f);
    const Vec force = f[0] * c.n + f[1] * c.t + f[2] * c.s, torque = f[3] * c.n + f[4] * c.t + f[5] * c.s;
    push(w, c.b, c, force, torque, 1.0), push(w, c.a, c, force, torque, -1.0);
  }
}

// Active joint limits, which push back: g -= J f with f = -D x, x = J a - aref < 0.
inline void limit_forces(Work& w, Mask& changed) {
  for (int k = 0; k < w.nlim; ++k) {
    const int j = w.lim[k];
    const Real x = w.lim_s[k] * w.a[6 + j] + w.lim_c[k];
    const Mask active = (x < 0.0) & (w.lim_d[k] > 0.0);
    changed |= active ^ w.lim_act[k];
    w.lim_act[k] = active;
    w.g[6 + j] += active ? w.lim_d[k] * w.lim_s[k] * x : splat(0);
  }
}

// Zones of the joints' friction: |D x| below the friction loss, or sliding forward or backward; and their forces.
inline void friction_forces(const Shared& m, Work& w, bool first, Mask& changed) {
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) {
    const Real x = w.a[6 + j] + w.fc[j];
    Mask quadratic = abs(x) * w.fd[j] < m.friction_loss, forward = x > 0.0;
    if (first) {
      quadratic = (w.zone_known[j] & w.zone[j][0]) | (~w.zone_known[j] & quadratic);
      forward = (w.zone_known[j] & w.zone[j][1]) | (~w.zone_known[j] & forward);
    }
    changed |= (quadratic ^ w.zone[j][0]) | (~quadratic & (forward ^ w.zone[j][1]));
    w.zone[j][0] = quadratic, w.zone[j][1] = forward;
    w.g[6 + j] += quadratic ? w.fd[j] * x : forward ? splat(m.friction_loss) : splat(-m.friction_loss);
  }
}

// The gradient M a - fs - J^T f at the current J a - aref, and the lanes whose active rows have changed. At the first look, rows
// that the robot remembers are active as in its last substep: the next step of Newton's method then ends at the minimum of that set.
inline Mask gradient(const Shared& m, Work& w, bool first) {
  Mask changed = Mask{};
  for (int i = 0; i < w.speeds; ++i) w.g[i] = w.Ma[i] - w.fs[i];
  contact_forces(w, first, changed);
  subtract_forces(w);
  limit_forces(w, changed);
  friction_forces(m, w, first, changed);
  return changed;
}

// --- H = M + J^T D J over the active rows ---------------------------------------------------------------------------------------------

// What a pyramid's active rows add up to in the contact's frame, a symmetric 3x3 matrix without an entry between t and s.
struct Stiffness {
  Real nn, nt, ns, tt, ss;
};
inline Stiffness stiffness_of(const Pyramid& p) {
  const Real zero = splat(0), mu = p.mu;
  const Real d0 = p.active[0] ? p.d : zero, d1 = p.active[1] ? p.d : zero, d2 = p.active[2] ? p.d : zero, d3 = p.active[3] ? p.d : zero;
  return {d0 + d1 + d2 + d3, mu * (d0 - d1), mu * (d2 - d3), mu * mu * (d0 + d1), mu * mu * (d2 + d3)};
}

// Add the row of a body's hinge to H: the projections of a force onto its axis and those of its ancestors.
inline void add_row(Work& w, int b, Spatial f) {
  Real* row = w.H + at(5 + b, 0);
  const Vec t = inverse_rotate(w.rot[0], f.w);
  row[0] += f.v.x, row[1] += f.v.y, row[2] += f.v.z, row[3] += t.x, row[4] += t.y, row[5] += t.z;
  for (int a = b; a > 0; a = kParent[a]) row[5 + a] += dot(w.ax[a], f.w) + dot(w.sv[a], f.v);
}

// A 6x6 stiffness times a twist. Entries 0-5: torque by rotation (xx yy zz xy xz yz); 6-14: torque by translation, row by row; 15-20:
// force by translation (xx yy zz xy xz yz).
inline Spatial times(const Real* k, Spatial s) {
  return {{k[0] * s.w.x + k[3] * s.w.y + k[4] * s.w.z + k[6] * s.v.x + k[7] * s.v.y + k[8] * s.v.z,
           k[3] * s.w.x + k[1] * s.w.y + k[5] * s.w.z + k[9] * s.v.x + k[10] * s.v.y + k[11] * s.v.z,
           k[4] * s.w.x + k[5] * s.w.y + k[2] * s.w.z + k[12] * s.v.x + k[13] * s.v.y + k[14] * s.v.z},
          {k[6] * s.w.x + k[9] * s.w.y + k[12] * s.w.z + k[15] * s.v.x + k[18] * s.v.y + k[19] * s.v.z,
           k[7] * s.w.x + k[10] * s.w.y + k[13] * s.w.z + k[18] * s.v.x + k[16] * s.v.y + k[20] * s.v.z,
           k[8] * s.w.x + k[11] * s.w.y + k[14] * s.w.z + k[19] * s.v.x + k[20] * s.v.y + k[17] * s.v.z}};
}

// Add J^T D J of a self contact to H, over the joints between its bodies.
inline void add_pair(Work& w, const Pair& p) {
  const Between& c = kBetween.of[p.a][p.b];
  const Stiffness k = stiffness_of(p);
  if (!any(k.nn > 0.0)) return;
  Vec column[kBodies];  // of J, in the contact's frame
  for (int i = 0; i < c.count; ++i) {
    const int b = c.joints[i] - 5;
    const Vec v = w.sv[b] + cross(w.ax[b], p.r);
    const Real s = splat(c.sign[i]);
    column[i] = {s * dot(p.n, v), s * dot(p.t, v), s * dot(p.s, v)};
  }
  for (int i = 0; i < c.count; ++i) {
    const Vec q = column[i], f = {k.nn * q.x + k.nt * q.y + k.ns * q.z, k.nt * q.x + k.tt * q.y, k.ns * q.x + k.ss * q.z};
    Real* row = w.H + at(c.joints[i], 0);
    for (int j = 0; j <= i; ++j) row[c.joints[j]] += dot(column[j], f);
  }
}

// The same of a contact that MuJoCo found, or of the ball, over all speeds that move either body.
inline void add_contact(Work& w, const Contact& p) {
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

// Add a point's stiffness to that of its body, about the torso's origin: with A the active rows' 3x3 matrix in world axes, A,
// [r] A and [r] A [r]^T.
inline void add_point(const Point& p, Real* k) {
  const Stiffness a = stiffness_of(p);
  const Real xx = a.tt * p.tx * p.tx + a.ss * p.ty * p.ty, yy = a.tt * p.ty * p.ty + a.ss * p.tx * p.tx, xy = (a.tt - a.ss) * p.tx * p.ty;
  const Real xz = a.nt * p.tx - a.ns * p.ty, yz = a.nt * p.ty + a.ns * p.tx;
  const Vec cx = cross(p.r, {xx, xy, xz}), cy = cross(p.r, {xy, yy, yz}), cz = cross(p.r, {xz, yz, a.nn});  // columns of [r] A
  const Vec rx = cross(p.r, {cx.x, cy.x, cz.x}), ry = cross(p.r, {cx.y, cy.y, cz.y});
  k[0] += rx.x, k[1] += ry.y, k[2] += p.r.x * cy.z - p.r.y * cx.z, k[3] += rx.y, k[4] += rx.z, k[5] += ry.z;
  k[6] += cx.x, k[7] += cy.x, k[8] += cz.x, k[9] += cx.y, k[10] += cy.y, k[11] += cz.y, k[12] += cx.z, k[13] += cy.z, k[14] += cz.z;
  k[15] += xx, k[16] += yy, k[17] += a.nn, k[18] += xy, k[19] += xz, k[20] += yz;
}

// Add J^T D J of the points on the floor to H. The points of a body are one 6x6 stiffness, and stiffnesses add up the tree as
// inertias do, so H keeps the zeros of M.
inline void add_floor(Work& w) {
  const auto bit = [](int body) { return 1u << body; };
  unsigned loaded = 0, filled = 0, done = 0;  // bodies with a point at them or below; whose stiffness is begun; that are in H
  int feeds[kBodies] = {};                    // stiffnesses that meet at a body: its own points' and its children's
  for (int i = 0; i < w.npt;) {
    const int body = w.pt[i].body;
    Real* k = w.Kc[body];
    for (int q = 0; q < 21; ++q) k[q] = splat(0);
    for (; i < w.npt && w.pt[i].body == body; ++i) add_point(w.pt[i], k);
    filled |= bit(body);
    ++feeds[body];
    for (int b = body; b > 0 && !(loaded & bit(b)); b = kParent[b]) loaded |= bit(b), ++feeds[kParent[b]];
    loaded |= bit(0);
  }
  for (int top = kBodies - 1; top > 0; --top) {
    if (!(loaded & ~done & bit(top))) continue;  // the chains of its children are done: they have higher numbers
    const Real* k = w.Kc[top];
    for (int b = top;;) {  // up to where another stiffness joins
      add_row(w, b, times(k, {w.ax[b], w.sv[b]}));
      done |= bit(b);
      b = kParent[b];
      if (feeds[b] < 2 && b > 0) continue;
      Real* sum = w.Kc[b];
      const bool begun = filled & bit(b);
      for (int q = 0; q < 21; ++q) sum[q] = begun ? sum[q] + k[q] : k[q];
      filled |= bit(b);
      break;
    }
  }
  if (!loaded) return;
  const Real *k = w.Kc[0], zero = splat(0);
  Real* H = w.H;
  H[at(0, 0)] += k[15], H[at(1, 1)] += k[16], H[at(2, 2)] += k[17], H[at(1, 0)] += k[18], H[at(2, 0)] += k[19], H[at(2, 1)] += k[20];
  for (int i = 0; i < 3; ++i) {  // the free joint turns about the torso's axes
    const Spatial f = times(k, {w.rot[0].column(i), {zero, zero, zero}});
    H[at(3 + i, 0)] += f.v.x, H[at(3 + i, 1)] += f.v.y, H[at(3 + i, 2)] += f.v.z;
    for (int l = 0; l <= i; ++l) H[at(3 + i, 3 + l)] += dot(w.rot[0].column(l), f.w);
  }
}

// H = M + J^T D J.
inline void hessian(const Shared& m, Work& w) {
  const Real zero = splat(0);
  // M, and zeros where contacts fill in
  if (w.pattern == 1) zero_fill(w.H);
  else if (w.pattern == 2) for (int i = 0; i < at(kSpeeds, 0); ++i) w.H[i] = zero;
  copy_tree_fast(w.M, w.H);
  // J^T D J of the floor; of friction within its quadratic zone and of limits, which touch the diagonal only; of self contacts
  add_floor(w);
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) w.H[at(6 + j, 6 + j)] += w.zone[j][0] ? w.fd[j] : zero;
  for (int k = 0; k < w.nlim; ++k) w.H[at(6 + w.lim[k], 6 + w.lim[k])] += w.lim_act[k] ? w.lim_d[k] : zero;
  for (int i = 0; i < w.npr; ++i) add_pair(w, w.pr[i]);
  // the ball's rows, and what MuJoCo found
  if (w.speeds == kAll) {
    for (int i = at(kSpeeds, 0); i < kEntries; ++i) w.H[i] = zero;
    for (int k = 0; k < 6; ++k) w.H[at(kSpeeds + k, kSpeeds + k)] = splat(k < 3 ? m.ball.mass : m.ball.inertia);
  }
  for (const Contact& c : w.more) add_contact(w, c);
}

// --- H = L^T D L ----------------------------------------------------------------------------------------------------------------------

// Factorise H in place. The ball's speeds are eliminated first, over the columns that any lane couples to them.
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

// x = H^-1 x.
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

// y = M x, the ball included.
inline void multiply(const Shared& m, const Work& w, const Real* x, Real* y) {
  mul_tree(w.M, x, y);
  for (int k = kSpeeds; k < w.speeds; ++k) y[k] = (k < kSpeeds + 3 ? m.ball.mass : m.ball.inertia) * x[k];
}

// --- the exact line search ------------------------------------------------------------------------------------------------------------

// First and second derivative of the cost along a + step p: Newton's own terms, then those of the rows that are active there.
inline void slope(const Shared& m, const Work& w, Real step, Real g0, Real m0, Real& first, Real& second) {
  const Real zero = splat(0);
  first = g0 + step * m0, second = m0;
  const auto row = [&](Real d, Real x, Real dx) {
    const Real active = x < 0.0 ? dx : zero;
    first += d * (active * x), second += d * (active * active);
  };
  const auto pyramid = [&](const Pyramid& p) {
    const Real mt = p.mu * p.ut, ms = p.mu * p.us, et = p.mu * p.pt, es = p.mu * p.ps;
    const Real d[4] = {p.pn + et, p.pn - et, p.pn + es, p.pn - es};
    row(p.d, p.un + mt + step * d[0], d[0]), row(p.d, p.un - mt + step * d[1], d[1]);
    row(p.d, p.un + ms + step * d[2], d[2]), row(p.d, p.un - ms + step * d[3], d[3]);
  };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (const Contact& c : w.more)
    for (int k = 1; k < c.dim; ++k) {
      const Real side = c.mu[k - 1] * c.u[k], dside = c.mu[k - 1] * c.du[k], d0 = c.du[0] + dside, d1 = c.du[0] - dside;
      row(c.d, c.u[0] + side + step * d0, d0), row(c.d, c.u[0] - side + step * d1, d1);
    }
  for (int k = 0; k < w.nlim; ++k) {
    const Real dx = w.lim_s[k] * w.p[6 + w.lim[k]];
    row(w.lim_d[k], w.lim_s[k] * w.a[6 + w.lim[k]] + w.lim_c[k] + step * dx, dx);
  }
  for (int j = 0; m.friction_loss > 0.0 && j < kJoints; ++j) {
    const Real dx = w.p[6 + j], x = w.a[6 + j] + w.fc[j] + step * dx, force = x * w.fd[j];
    const Mask quadratic = abs(force) < m.friction_loss;
    first += (quadratic ? force : x > 0.0 ? splat(m.friction_loss) : splat(-m.friction_loss)) * dx;
    second += quadratic ? w.fd[j] * dx * dx : zero;
  }
}

constexpr int kMostIterations = 40, kFullSteps = 2, kMostEvaluations = 16;
constexpr double kTolerance = 1e-12, kSlopeTolerance = 1e-10;

// The step along p to where the slope vanishes: Newton's method on the piecewise linear slope, bisection where it leaves the bracket.
inline Real line_search(const Shared& m, const Work& w, Mask done) {
  Real g0 = splat(0), m0 = splat(0), pp = splat(0);
  for (int i = 0; i < w.speeds; ++i) g0 += w.p[i] * (w.Ma[i] - w.fs[i]), m0 += w.p[i] * w.Mp[i], pp += w.p[i] * w.p[i];
  const Real enough = kSlopeTolerance * sqrt(pp) / w.numbers.scale;
  Real step = splat(1), low = splat(0), high = splat(1e30);
  for (int e = 0; e < kMostEvaluations; ++e) {
    Real first, second;
    slope(m, w, step, g0, m0, first, second);
    const Mask found = (abs(first) < enough) | done;
    if (!any(~found)) break;
    low = select(first < 0.0, max(low, step), low);
    high = select(first > 0.0, min(high, step), high);
    Real next = step - first / second;
    next = select((next <= low) | (next >= high), 0.5 * (low + min(high, 2.0 * low + 1.0)), next);
    step = select(found, step, next);
  }
  return step;
}

// --- Newton's method ------------------------------------------------------------------------------------------------------------------

// a += step p, and what depends on it linearly; a lane that is done keeps its numbers, whatever its neighbours' steps are.
inline void move(Work& w, Real full, Mask done) {
  const Real step = select(done, splat(0), full);
  for (int i = 0; i < w.speeds; ++i) {
    w.a[i] = select(done, w.a[i], w.a[i] + step * w.p[i]);
    w.Ma[i] = select(done, w.Ma[i], w.Ma[i] + step * w.Mp[i]);
  }
  const auto pyramid = [&](Pyramid& p) { p.un += step * p.pn, p.ut += step * p.pt, p.us += step * p.ps; };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (Contact& c : w.more)
    for (int k = 0; k < c.dim; ++k) c.u[k] += step * c.du[k];
}

// Lanes whose gradient vanishes, in MuJoCo's unit.
inline Mask flat(const Work& w) {
  Real gg = splat(0);
  for (int i = 0; i < w.speeds; ++i) gg += w.g[i] * w.g[i];
  return sqrt(gg) * w.numbers.scale < kTolerance;
}

// Minimise the cost from the last substep's accelerations and active rows. Each step solves H p = -g and moves to a + p, from the third
// on to the minimum along p. A lane is done when its gradient vanishes, or when a full step leaves the active rows as they were: then
// a + p is the minimum. Lanes that do not get there are flagged.
inline void newton(const Shared& m, const Group& g, Work& w) {
  // the start: M a and J a - aref at the last substep's accelerations, and the rows of joint friction
  for (int i = 0; i < w.speeds; ++i) w.a[i] = g.warm[i];
  multiply(m, w, w.a, w.Ma);
  residuals(w, w.a);
  for (int j = 0; j < kJoints; ++j) {
    w.fc[j] = m.friction_b * g.qvel[6 + j];
    w.fd[j] = m.friction_d0 / ((1.0 - m.friction_d0) * w.numbers.joint_weight[j]);
  }
  gradient(m, w, true);
  Mask done = w.flagged;
  for (int& count : w.iterations) count = 0;
  for (int iteration = 0; iteration < kMostIterations; ++iteration) {
    if (iteration) done |= flat(w);  // the first gradient is that of the remembered rows
    const unsigned left = bits(~done);
    if (left == 0) break;
    for (int l = 0; l < kLanes; ++l) w.iterations[l] += left >> l & 1u;
    // the direction p = -H^-1 g
    hessian(m, w);
    factor(w);
    for (int i = 0; i < w.speeds; ++i) w.p[i] = -w.g[i];
    solve(w, w.p);
    // M p and J p, of which the line search and the move are made
    multiply(m, w, w.p, w.Mp);
    directions(w, w.p);
    const Real full = iteration < kFullSteps ? splat(1) : line_search(m, w, done);
    move(w, full, done);
    // the same active rows after a full step: the minimum of their quadratic function is that of the cost
    const Mask changed = gradient(m, w, false);
    done |= ~changed & (abs(full - 1.0) < 1e-9);
  }
  w.flagged |= ~done;
}

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
