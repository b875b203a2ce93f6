// Smooth dynamics of a group of humanoids: kinematics, bias forces, motors, air, the inertia matrix, and the step in time.
//
// Everything is in world axes about the torso's origin, so that inertias and forces of bodies add without being moved.
#pragma once
#include <cstring>
#include <vector>

#include "lanes.hpp"
#include "humanoid_model.hpp"

namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA {

using namespace naosim::NAOSIM_ISA;

// A motion (angular velocity; velocity of the reference point) or a force (torque about it; force).
struct Spatial {
  Vec w, v;
};
inline Spatial operator+(Spatial a, Spatial b) { return {a.w + b.w, a.v + b.v}; }
inline Spatial operator-(Spatial a, Spatial b) { return {a.w - b.w, a.v - b.v}; }

inline Real clamp(Real a, Real low, Real high) { return min(max(a, low), high); }
inline Vec zero_vec() { return {splat(0), splat(0), splat(0)}; }

// sin and cos: Cody-Waite reduction by pi/2, then minimax polynomials (S. L. Moshier, Cephes).
inline void sincos(Real x, Real& s, Real& c) {
  const double magic = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to the nearest integer
  Real k = x * 0.63661977236758134308 + magic;
  const Mask q = reinterpret_cast<Mask>(k);
  k = k - magic;
  const Real y = ((x - k * 1.57079632673412561417e+00) - k * 6.07710050630396597660e-11) - k * 2.02226624879595063154e-21, z = y * y;
  const Real ps = y + y * z * (-1.66666666666666307295e-1 + z * (8.33333333332211858878e-3 + z * (-1.98412698295895385996e-4 +
                  z * (2.75573136213857245213e-6 + z * (-2.50507477628578072866e-8 + z * 1.58962301576546568060e-10)))));
  const Real pc = 1.0 - 0.5 * z + z * z * (4.16666666666665929218e-2 + z * (-1.38888888888730564116e-3 + z * (2.48015872888517045348e-5 +
                  z * (-2.75573141792967388112e-7 + z * (2.08757008419747316778e-9 - z * 1.13585365213876817300e-11)))));
  const Mask odd = (q & 1) != 0, s1 = (q & 2) != 0, c1 = ((q + 1) & 2) != 0;
  const Real ss = select(odd, pc, ps), cc = select(odd, ps, pc);
  s = select(s1, -ss, ss);
  c = select(c1, -cc, cc);
}

// State of the robots of a group, and of their balls: place, orientation; speeds in world axes.
struct Group {
  Real qpos[kPositions], qvel[kAll], warm[kAll], target[kJoints];
  Real ball[7];
};

// The friction pyramid of a contact: four rows n + mu t, n - mu t, n + mu s, n - mu s with the same weight d.
struct Pyramid {
  int row;                   // where the robot's memory has it
  Mask exists, active[4];
  Mask known;                // lanes whose active rows are remembered
  Vec r;                     // the contact about the torso's origin
  Real d, mu;
  Real un, ut, us;           // J a - aref along n, t, s
  Real pn, pt, ps;           // J p
  Real cn, ct, cs;           // -aref
};

// A contact of a geom with the floor: n = z, t = (tx, ty, 0), s = n x t.
struct Point : Pyramid {
  int body;
  Real tx, ty;
};

// A contact of two geoms, normal from a to b.
struct Pair : Pyramid {
  int a, b, level;
  Vec n, t, s;
};

// A contact of any two bodies, the world (-1) and the ball among them: rows n +- mu[k - 1] q, with q the other directions of `u`:
// along t and s, about n, t and s. The ball touches in six dimensions, everything else in three.
struct Contact {
  long key;      // of geoms and number: their order in every group
  int a, b, dim, level;
  Mask exists, active[10];
  Vec r, ball;   // about the torso's origin, about the ball's centre
  Vec n, t, s;
  Real d, mu[5], u[6], du[6], c[6];
};

// What a substep computes, of one group.
struct Work {
  VariedOf<Real> numbers;
  Rot rot[kBodies];
  Vec r[kBodies], ax[kBodies], sv[kBodies];  // origin, hinge axis, r x axis
  Real mass[kBodies], I[kBodies][6];         // of the body, then of all that hangs on it
  Vec hm[kBodies];                           // mass times centre
  Spatial vel[kBodies], acc[kBodies], frc[kBodies];
  Real M[at(kSpeeds, 0)], H[kEntries], inv[kAll], fs[kAll];  // inertia, Hessian, 1 / D of its factors, qfrc_smooth
  Real a[kAll], Ma[kAll], g[kAll], p[kAll], Mp[kAll];
  Spatial tw[kBodies + 1], wr[kBodies + 1];  // the ball's about its centre
  Real Kc[kBodies][21];                      // stiffness of the contacts at a body and below
  Point pt[kPoints];
  int npt;
  Pair pr[kPairs + 1];
  int npr;
  std::vector<Contact> more;                 // by key
  int speeds;                                // kSpeeds, or kAll with a ball
  Vec ball;                                  // the ball's centre
  Rot ball_rot;
  int coupled, columns[kSpeeds];             // speeds of the robot that contacts with the ball couple to it
  int nlim, lim[kJoints];
  Real lim_d[kJoints], lim_s[kJoints], lim_c[kJoints];
  Mask lim_act[kJoints];
  Real fc[kJoints], fd[kJoints];             // friction rows: -aref and weight
  Mask zone[kJoints][2];                     // within the quadratic zone; sliding forward
  Mask zone_known[kJoints];                  // lanes whose zone is remembered
  bool used[kBodies];                        // bodies with a contact at them or below
  int pattern;                               // of H's sparsity
  Mask flagged;                              // lanes that mj_step must take
  Mask searched;                             // lanes whose other contacts MuJoCo has to find
  Mask touching[8];                          // parts of the robot that touch the ball
  int iterations[kLanes];
};

// Spatial inertia times motion: (I w + h x v, m v - h x w).
inline Spatial apply(Real m, Vec h, const Real* I, Spatial x) {
  return {{I[0] * x.w.x + I[3] * x.w.y + I[4] * x.w.z + h.y * x.v.z - h.z * x.v.y,
           I[3] * x.w.x + I[1] * x.w.y + I[5] * x.w.z + h.z * x.v.x - h.x * x.v.z,
           I[4] * x.w.x + I[5] * x.w.y + I[2] * x.w.z + h.x * x.v.y - h.y * x.v.x},
          {m * x.v.x - (h.y * x.w.z - h.z * x.w.y), m * x.v.y - (h.z * x.w.x - h.x * x.w.z), m * x.v.z - (h.x * x.w.y - h.y * x.w.x)}};
}

inline Rot times(const Rot& a, const double* b) {
  Rot out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out.m[i][j] = a.m[i][0] * b[j] + a.m[i][1] * b[3 + j] + a.m[i][2] * b[6 + j];
  return out;
}

// Rotation of a quaternion that need not be normalised.
inline Rot rotation_of(const Real* q) {
  const Real n = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const Real a = q[0] * n, b = q[1] * n, c = q[2] * n, d = q[3] * n;
  Rot r;
  r.m[0][0] = a * a + b * b - c * c - d * d, r.m[1][1] = a * a - b * b + c * c - d * d, r.m[2][2] = a * a - b * b - c * c + d * d;
  r.m[0][1] = 2.0 * (b * c - a * d), r.m[0][2] = 2.0 * (b * d + a * c), r.m[1][0] = 2.0 * (b * c + a * d);
  r.m[1][2] = 2.0 * (c * d - a * b), r.m[2][0] = 2.0 * (b * d - a * c), r.m[2][1] = 2.0 * (c * d + a * b);
  return r;
}

// Frames and hinge axes of the bodies.
inline void kinematics(const Shared& m, const Group& g, Work& w) {
  w.rot[0] = rotation_of(g.qpos + 3);
  w.r[0] = zero_vec();
  if (w.speeds == kAll) {
    w.ball_rot = rotation_of(g.ball + 3);
    w.ball = load(g.ball) - load(g.qpos);
  }
  for (int b = 1; b < kBodies; ++b) {
    const int p = kParent[b], ax = kAxis[b], a1 = (ax + 1) % 3, a2 = (ax + 2) % 3;
    w.r[b] = w.r[p] + rotate(w.rot[p], m.position[b]);
    Real s, c;
    sincos(g.qpos[6 + b], s, c);
    const bool turned = m.turn[b][0] != 1.0 || m.turn[b][4] != 1.0;
    const Rot from = turned ? times(w.rot[p], m.turn[b]) : w.rot[p];
    Rot& r = w.rot[b];
    for (int i = 0; i < 3; ++i) {  // from times the rotation about the hinge
      const Real u = from.m[i][a1], v = from.m[i][a2];
      r.m[i][ax] = from.m[i][ax];
      r.m[i][a1] = c * u + s * v;
      r.m[i][a2] = c * v - s * u;
    }
    w.ax[b] = r.column(ax);
    w.sv[b] = cross(w.r[b], w.ax[b]);
  }
}

// Spins of the bodies and velocities of what of them is at the torso's origin: v_b = v_parent + qd S_b.
inline void velocities(const Group& g, Work& w) {
  const Real* qd = g.qvel;
  w.vel[0] = {w.rot[0] * load(qd + 3), load(qd)};
  for (int b = 1; b < kBodies; ++b) w.vel[b] = w.vel[kParent[b]] + Spatial{qd[5 + b] * w.ax[b], qd[5 + b] * w.sv[b]};
}

// Inertias of the bodies about the torso's origin: I_o = R I_c R^T + m (c^2 1 - c c^T).
inline void inertias(Work& w) {
  for (int b = 0; b < kBodies; ++b) {
    const Rot& r = w.rot[b];
    const Real* I = w.numbers.inertia[b];
    Real t[3][3];
    for (int i = 0; i < 3; ++i) {
      t[i][0] = r.m[i][0] * I[0] + r.m[i][1] * I[3] + r.m[i][2] * I[4];
      t[i][1] = r.m[i][0] * I[3] + r.m[i][1] * I[1] + r.m[i][2] * I[5];
      t[i][2] = r.m[i][0] * I[4] + r.m[i][1] * I[5] + r.m[i][2] * I[2];
    }
    const auto e = [&](int i, int j) { return t[i][0] * r.m[j][0] + t[i][1] * r.m[j][1] + t[i][2] * r.m[j][2]; };
    const Vec c = w.r[b] + r * load(w.numbers.centre[b]);
    const Real mass = w.numbers.mass[b];
    const Vec h = mass * c;
    w.mass[b] = mass, w.hm[b] = h;
    Real* o = w.I[b];
    o[0] = e(0, 0) + h.y * c.y + h.z * c.z, o[1] = e(1, 1) + h.x * c.x + h.z * c.z, o[2] = e(2, 2) + h.x * c.x + h.y * c.y;
    o[3] = e(0, 1) - h.x * c.y, o[4] = e(0, 2) - h.x * c.z, o[5] = e(1, 2) - h.y * c.z;
  }
}

// The air's force on a body, MuJoCo's inertia-box model: viscous drag of a sphere as wide as the box's mean side,
// -3 pi d eta v and -pi d^3 eta w, and quadratic drag of the sides, in inertial axes at the centre of mass.
inline Spatial air(const Shared& m, const Rot& axes, const double* s, Vec c, Vec turning_speed, Vec centre_speed) {
  const Vec spin = inverse_rotate(axes, turning_speed), speed = inverse_rotate(axes, centre_speed);
  const double pi = 3.14159265358979323846, width = (s[0] + s[1] + s[2]) / 3.0;
  const double v1 = 3.0 * pi * width * m.viscosity, w1 = pi * width * width * width * m.viscosity;
  const double s4[3] = {s[0] * s[0] * s[0] * s[0], s[1] * s[1] * s[1] * s[1], s[2] * s[2] * s[2] * s[2]};
  const double area[3] = {s[1] * s[2], s[0] * s[2], s[0] * s[1]};
  const double turning[3] = {s[0] * (s4[1] + s4[2]), s[1] * (s4[0] + s4[2]), s[2] * (s4[0] + s4[1])};
  const auto drag = [&](Real x, double linear, double quadratic) { return -(linear + quadratic * abs(x)) * x; };
  const double half = 0.5 * m.density, part = m.density / 64.0;
  const Vec force = axes * Vec{drag(speed.x, v1, half * area[0]), drag(speed.y, v1, half * area[1]), drag(speed.z, v1, half * area[2])};
  const Vec torque = axes * Vec{drag(spin.x, w1, part * turning[0]), drag(spin.y, w1, part * turning[1]), drag(spin.z, w1, part * turning[2])};
  return {torque + cross(c, force), force};
}

// fs = motors + damping + air - bias; recursive Newton-Euler with the torso accelerated by (0, v x w - g).
inline void forces(const Shared& m, const Group& g, Work& w) {
  const Real* qd = g.qvel;
  const Rot& r0 = w.rot[0];
  Vec al = cross(w.vel[0].v, w.vel[0].w);
  al.z = al.z - w.numbers.gravity;
  w.acc[0] = {zero_vec(), al};
  for (int b = 1; b < kBodies; ++b) {
    const int p = kParent[b];
    const Spatial vj = {qd[5 + b] * w.ax[b], qd[5 + b] * w.sv[b]}, v = w.vel[p];
    w.acc[b] = w.acc[p] + Spatial{cross(v.w, vj.w), cross(v.w, vj.v) + cross(v.v, vj.w)};
  }
  const bool in_air = m.density > 0.0 || m.viscosity > 0.0;
  for (int b = 0; b < kBodies; ++b) {  // f = I a + v x* I v
    const Spatial l = apply(w.mass[b], w.hm[b], w.I[b], w.vel[b]), f = apply(w.mass[b], w.hm[b], w.I[b], w.acc[b]);
    w.frc[b] = {f.w + cross(w.vel[b].w, l.w) + cross(w.vel[b].v, l.v), f.v + cross(w.vel[b].w, l.v)};
    if (!in_air) continue;
    const Vec c = w.r[b] + w.rot[b] * load(w.numbers.centre[b]), spin = w.vel[b].w;
    w.frc[b] = w.frc[b] - air(m, times(w.rot[b], m.principal[b]), m.box[b], c, spin, w.vel[b].v + cross(spin, c));
  }
  if (w.speeds == kAll) {
    const double sides[3] = {m.ball.side, m.ball.side, m.ball.side};
    const Real* v = qd + kSpeeds;
    const Spatial f = in_air ? air(m, w.ball_rot, sides, zero_vec(), {v[3], v[4], v[5]}, {v[0], v[1], v[2]}) : Spatial{zero_vec(), zero_vec()};
    Real* to = w.fs + kSpeeds;
    to[0] = f.v.x, to[1] = f.v.y, to[2] = f.v.z + m.ball.mass * w.numbers.gravity, to[3] = f.w.x, to[4] = f.w.y, to[5] = f.w.z;
  }
  for (int b = kBodies - 1; b > 0; --b) {
    const int j = b - 1;
    const Real bias = dot(w.ax[b], w.frc[b].w) + dot(w.sv[b], w.frc[b].v), v = qd[5 + b];
    const Real wanted = (g.target[j] - g.qpos[6 + b]) * w.numbers.kp[j] - v * w.numbers.kd[j];
    const Real motor = clamp(wanted, splat(-m.torque[j]), splat(m.torque[j]));
    w.fs[5 + b] = motor - v * m.damping[5 + b] - bias;
    w.frc[kParent[b]] = w.frc[kParent[b]] + w.frc[b];
  }
  const Vec t = inverse_rotate(r0, w.frc[0].w);
  w.fs[0] = -w.frc[0].v.x, w.fs[1] = -w.frc[0].v.y, w.fs[2] = -w.frc[0].v.z, w.fs[3] = -t.x, w.fs[4] = -t.y, w.fs[5] = -t.z;
}

// M by composite inertias: M[b][ancestor] = S_ancestor . I_composite S_b. The free joint's speeds are linear in world axes and
// angular in the torso's.
inline void inertia(const Shared& m, Work& w) {
  for (int b = kBodies - 1; b > 0; --b) {
    const int p = kParent[b], i = 5 + b;
    const Spatial f = apply(w.mass[b], w.hm[b], w.I[b], {w.ax[b], w.sv[b]});
    Real* row = w.M + at(i, 0);
    const Vec t = inverse_rotate(w.rot[0], f.w);
    row[0] = f.v.x, row[1] = f.v.y, row[2] = f.v.z, row[3] = t.x, row[4] = t.y, row[5] = t.z;
    for (int a = b; a > 0; a = kParent[a]) row[5 + a] = dot(w.ax[a], f.w) + dot(w.sv[a], f.v);
    row[i] += m.armature[i];
    w.mass[p] += w.mass[b];
    w.hm[p] = w.hm[p] + w.hm[b];
    for (int k = 0; k < 6; ++k) w.I[p][k] += w.I[b][k];
  }
  const Real z = splat(0), ms = w.mass[0];
  const Rot& r = w.rot[0];
  Real* A = w.M;
  A[at(0, 0)] = A[at(1, 1)] = A[at(2, 2)] = ms;
  A[at(1, 0)] = A[at(2, 0)] = A[at(2, 1)] = z;
  for (int k = 0; k < 3; ++k) {
    const Spatial f = apply(ms, w.hm[0], w.I[0], {r.column(k), {z, z, z}});
    A[at(3 + k, 0)] = f.v.x, A[at(3 + k, 1)] = f.v.y, A[at(3 + k, 2)] = f.v.z;
    for (int l = 0; l <= k; ++l) A[at(3 + k, 3 + l)] = dot(r.column(l), f.w);
  }
}

#include NAOSIM_FACTOR

// The same for a matrix without zeros, in the same order of operations: H = L^T D L in place, row by row from the last.
inline void factor_dense(Real* __restrict H, Real* __restrict inv) {
  Real D[kSpeeds];
  for (int i = kSpeeds - 1; i >= 0; --i) {
    Real* hi = H + at(i, 0);
    int j = 0;
    for (; j + 7 <= i; j += 8) {  // eight columns at a time in registers
      Real a[8];
      for (int c = 0; c < 8; ++c) a[c] = hi[j + c];
      for (int k = kSpeeds - 1; k > i; --k) {
        const Real* hk = H + at(k, 0);
        const Real f = hk[i] * D[k];
        for (int c = 0; c < 8; ++c) a[c] -= f * hk[j + c];
      }
      for (int c = 0; c < 8; ++c) hi[j + c] = a[c];
    }
    for (; j <= i; ++j) {
      Real a = hi[j];
      for (int k = kSpeeds - 1; k > i; --k) {
        const Real* hk = H + at(k, 0);
        a -= hk[i] * D[k] * hk[j];
      }
      hi[j] = a;
    }
    D[i] = hi[i];
    const Real iv = 1.0 / hi[i];
    inv[i] = iv;
    for (j = 0; j < i; ++j) hi[j] *= iv;
  }
}

inline void solve_dense(const Real* H, const Real* inv, Real* x) {
  for (int i = kSpeeds - 1; i >= 0; --i) {
    // two sums by the parity of the index, as in the written code
    Real even = x[i], odd = splat(0);
    for (int k = (kSpeeds - 1) / 2 * 2; k > i; k -= 2) even -= H[at(k, i)] * x[k];
    for (int k = kSpeeds / 2 * 2 - 1; k > i; k -= 2) odd += H[at(k, i)] * x[k];
    x[i] = even - odd;
  }
  for (int i = 0; i < kSpeeds; ++i) x[i] *= inv[i];
  for (int i = 0; i < kSpeeds; ++i) {
    Real even = x[i], odd = splat(0);
    for (int k = 0; k < i; k += 2) even -= H[at(i, k)] * x[k];
    for (int k = 1; k < i; k += 2) odd += H[at(i, k)] * x[k];
    x[i] = even - odd;
  }
}

// The quaternion q, normalised, times exp(h w): w in body axes.
inline void turn(Real* q, Vec o, double step) {
  const Real n = sqrt(dot(o, o));
  Real s, c;
  sincos(n * 0.5 * step, s, c);
  const Real k = select(n > 1e-15, s / max(n, splat(1e-300)), splat(0));
  const Real nq = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const Real a0 = q[0] * nq, a1 = q[1] * nq, a2 = q[2] * nq, a3 = q[3] * nq, b1 = k * o.x, b2 = k * o.y, b3 = k * o.z;
  q[0] = a0 * c - a1 * b1 - a2 * b2 - a3 * b3;
  q[1] = a0 * b1 + a1 * c + a2 * b3 - a3 * b2;
  q[2] = a0 * b2 - a1 * b3 + a2 * c + a3 * b1;
  q[3] = a0 * b3 + a1 * b2 - a2 * b1 + a3 * c;
}

// Step in time with implicit damping: (M + h B) x = M qacc, v += h x, q += h v.
inline void integrate(const Shared& m, Group& g, Work& w) {
  Real x[kSpeeds];
  if (m.damped != 0.0) {
    copy_tree_fast(w.M, w.H);
    for (int i = 6; i < kSpeeds; ++i) w.H[at(i, i)] += m.step * m.damping[i];
    factor_tree(w.H, w.inv);
    for (int i = 0; i < kSpeeds; ++i) x[i] = w.Ma[i];
    solve_tree(w.H, w.inv, x);
  } else {
    for (int i = 0; i < kSpeeds; ++i) x[i] = w.a[i];
  }
  for (int i = 0; i < kSpeeds; ++i) g.qvel[i] += m.step * x[i], g.warm[i] = w.a[i];
  for (int i = 0; i < 3; ++i) g.qpos[i] += m.step * g.qvel[i];
  for (int j = 0; j < kJoints; ++j) g.qpos[7 + j] += m.step * g.qvel[6 + j];
  turn(g.qpos + 3, {g.qvel[3], g.qvel[4], g.qvel[5]}, m.step);
  if (w.speeds == kSpeeds) return;
  for (int i = kSpeeds; i < kAll; ++i) g.qvel[i] += m.step * w.a[i], g.warm[i] = w.a[i];
  for (int i = 0; i < 3; ++i) g.ball[i] += m.step * g.qvel[kSpeeds + i];
  turn(g.ball + 3, inverse_rotate(w.ball_rot, load(g.qvel + kSpeeds + 3)), m.step);
}

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
