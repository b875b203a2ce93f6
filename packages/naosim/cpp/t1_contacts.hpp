// Contacts of a group of T1s with the floor and with themselves, and joint limits: which there are, their frames, and the weight
// and reference acceleration of their rows, as MuJoCo's mj_collision and mj_makeConstraint.
#pragma once
#include "t1_dynamics.hpp"

namespace naosim::t1::NAOSIM_ISA {

// Impedance of a row that is violated by |dist|, and 1 - impedance. With x = |dist| / width:
// y = 2 x^2 below 0.5, 1 - 2 (1 - x)^2 above; imp = d0 + y (d1 - d0).
inline Real impedance(const Impedance& c, Real dist, Real& rest) {
  const Real x = abs(dist) * (1.0 / c.width);
  const Mask low = x <= 0.5, over = x >= 1.0;
  const Real u = 2.0 * x * x, v = 2.0 * (1.0 - x) * (1.0 - x);
  const Real y = select(low, u, 1.0 - v), z = select(low, 1.0 - u, v);  // y(x) and 1 - y(x)
  rest = select(over, splat(1.0 - c.d1), (1.0 - c.d1) + z * (c.d1 - c.d0));
  return select(over, splat(c.d1), c.d0 + y * (c.d1 - c.d0));
}

// D of a pyramid's four rows: 1 / R, R = 2 mu^2 (1 - imp) / imp (w_a + w_b) (1 + mu^2), w: translational inverse weights.
inline Real pyramid_weight(Real imp, Real rest, Real mu, Real weight) { return imp / (rest * (2.0 * mu * mu * weight * (1.0 + mu * mu))); }

inline Vec velocity_at(const Spatial& t, Vec r) { return t.v + cross(t.w, r); }

inline void mark_used(Work& w, int body) {
  for (int b = body; b >= 0; b = kParent[b]) w.used[b] = true;
}

// A contact halfway between the geom's lowest point r and the floor.
inline void put_point(const Shared& m, Work& w, int geom, Vec r, Real dist, Mask exists, Real tx, Real ty) {
  const Impedance& c = m.floor[geom];
  Point& p = w.pt[w.npt++];
  p.body = kGeomBody[geom], p.exists = exists, p.mu = w.numbers.friction[geom];
  p.r = {r.x, r.y, r.z - 0.5 * dist};
  p.tx = tx, p.ty = ty;
  Real rest;
  const Real imp = impedance(c, dist, rest);
  p.d = select(exists, pyramid_weight(imp, rest, p.mu, w.numbers.weight[p.body]), splat(0));
  const Vec v = velocity_at(w.vel[p.body], p.r);
  p.cn = c.b * v.z + c.k * imp * dist;
  p.c1 = c.b * (tx * v.x + ty * v.y);
  p.c2 = c.b * (tx * v.y - ty * v.x);
  mark_used(w, p.body);
}

// Geoms against the floor. A box touches with the corners below its centre: one of each of the four opposite pairs.
inline void collide_floor(const Shared& m, const Group& g, Work& w) {
  const Real z0 = g.qpos[2], zero = splat(0), one = splat(1);
  for (int k = 0; k < kGeoms; ++k) {
    const int b = kGeomBody[k];
    const double* size = m.size[k];
    const Rot& r = w.rot[b];
    const Vec o = w.r[b] + rotate(r, m.offset[k]);
    const Real height = z0 + o.z;
    if (kGeomShape[k] == kBox) {
      const Real zx = r.m[2][0] * size[0], zy = r.m[2][1] * size[1], zz = r.m[2][2] * size[2];
      if (!any(height - (abs(zx) + abs(zy) + abs(zz)) < 0.0)) continue;
      for (int p = 0; p < 4; ++p) {
        const double sx = p & 1 ? 1 : -1, sy = p & 2 ? 1 : -1;
        const Real l = sx * zx + sy * zy - zz, dist = height - abs(l);
        const Mask exists = dist < 0.0;
        if (!any(exists)) continue;
        const double corner[3] = {sx * size[0], sy * size[1], -size[2]};
        put_point(m, w, k, o + select(l > 0.0, -one, one) * rotate(r, corner), dist, exists, zero, one);
      }
    } else if (kGeomShape[k] == kSphere) {
      const Real dist = height - size[0];
      const Mask exists = dist < 0.0;
      if (any(exists)) put_point(m, w, k, {o.x, o.y, o.z - size[0]}, dist, exists, zero, one);
    } else {
      const double axis[3] = {m.frame[k][2], m.frame[k][5], m.frame[k][8]};
      const Vec ax = rotate(r, axis);
      if (!any(height - abs(ax.z) * size[1] - size[0] < 0.0)) continue;
      // the first tangent is the horizontal part of the capsule's axis
      const Real n2 = ax.x * ax.x + ax.y * ax.y, n = 1.0 / sqrt(max(n2, splat(1e-30)));
      const Mask up = n2 < 1e-28;
      const Real tx = select(up, one, ax.x * n), ty = select(up, zero, ax.y * n);
      for (int s = 1; s >= -1; s -= 2) {
        const Vec e = o + (s * size[1]) * ax;
        const Real dist = z0 + e.z - size[0];
        const Mask exists = dist < 0.0;
        if (any(exists)) put_point(m, w, k, {e.x, e.y, e.z - size[0]}, dist, exists, tx, ty);
      }
    }
  }
}

// Rows of the joints beyond a limit: only the violated side.
inline void collide_limits(const Shared& m, const Group& g, Work& w) {
  w.nlim = 0;
  for (int j = 0; j < kJoints; ++j) {
    const Real dl = g.qpos[7 + j] - m.low[j], dh = m.high[j] - g.qpos[7 + j], dist = min(dl, dh);
    const Mask on = dist < 0.0;
    if (!any(on)) continue;
    Real rest;
    const Real imp = impedance(m.limit, dist, rest), s = select(dl < dh, splat(1), splat(-1));
    const int k = w.nlim++;
    w.lim[k] = j;
    w.lim_s[k] = s;
    w.lim_d[k] = select(on, imp / (rest * w.numbers.joint_weight[j]), splat(0));
    w.lim_c[k] = m.limit.b * s * g.qvel[6 + j] + m.limit.k * imp * dist;
  }
}

// The sparsity that contacts of two geoms give H: 0 the tree's, 1 with arms against waist and hips, 2 dense.
// J^T D J of such a contact couples the joints between the bodies; common ancestors cancel.
struct Between {
  int count = 0, level = 0, joints[kBodies] = {};  // speeds of these joints, ascending
  double sign[kBodies] = {};                       // +1 on the second body's side
};
inline bool is_above(int a, int b) {
  while (b > a) b = kParent[b];
  return a == b;
}
inline Between between(int a, int b) {
  Between out;
  for (int x = 1; x < kBodies; ++x) {
    const bool ua = is_above(x, a), ub = is_above(x, b);
    if (ua != ub) out.joints[out.count] = 5 + x, out.sign[out.count++] = ua ? -1 : 1;
  }
  const auto waist_or_hip = [](int i) { return i == 16 || i == 17 || i == 18 || i == 23 || i == 24; };
  for (int x = 0; x < out.count; ++x)
    for (int y = 0; y < x; ++y) {
      const int i = out.joints[x], j = out.joints[y];
      if (is_above(j - 5, i - 5)) continue;
      const int level = waist_or_hip(i) && j >= 8 && j <= 15 ? 1 : 2;
      if (level > out.level) out.level = level;
    }
  return out;
}
struct BetweenGeoms {
  Between of[kGeoms][kGeoms];
  BetweenGeoms() {
    for (int i = 0; i < kGeoms; ++i)
      for (int j = 0; j < kGeoms; ++j) of[i][j] = between(kGeomBody[i], kGeomBody[j]);
  }
};
inline const BetweenGeoms kBetween;

// Tangents as mju_makeFrame chooses them.
inline void frame_of(Vec n, Vec& t, Vec& s) { 
  const Mask use_y = (n.y < 0.5) & (n.y > -0.5);
  const Real one = splat(1), z = splat(0);
  Vec y = {z, select(use_y, one, z), select(use_y, z, one)};
  const Real d = dot(n, y);
  y = y - d * n;
  const Real l = 1 / sqrt(dot(y, y));
  t = l * y;
  s = cross(n, t);
}

// Whether a capsule or sphere (half = 0) is nearer than its radius to a box: exact, by bisection along the segment.
inline Mask near_box(Vec d, Vec a, double radius, const double* size) {  // centre and half axis, box frame
  Mask apart = (abs(d.x) - abs(a.x) > size[0] + radius) | (abs(d.y) - abs(a.y) > size[1] + radius) | (abs(d.z) - abs(a.z) > size[2] + radius);
  if (!any(~apart)) return ~apart;
  Real lo = splat(-1), hi = splat(1);
  for (int i = 0; i < 24; ++i) {
    const Real t = 0.5 * (lo + hi);
    const Vec q = d + t * a;
    const Real ex = q.x - clamp(q.x, splat(-size[0]), splat(size[0])), ey = q.y - clamp(q.y, splat(-size[1]), splat(size[1])), ez = q.z - clamp(q.z, splat(-size[2]), splat(size[2]));
    const Mask up = ex * a.x + ey * a.y + ez * a.z < 0.0;
    lo = select(up, t, lo), hi = select(up, hi, t);
  }
  const Vec q = d + (0.5 * (lo + hi)) * a;
  const Real ex = q.x - clamp(q.x, splat(-size[0]), splat(size[0])), ey = q.y - clamp(q.y, splat(-size[1]), splat(size[1])), ez = q.z - clamp(q.z, splat(-size[2]), splat(size[2]));
  return ~apart & (ex * ex + ey * ey + ez * ez < ((radius + 1e-9) * (radius + 1e-9)));
}
// Whether two boxes overlap, by separating axes.
inline Mask boxes_touch(const Rot& A, const Rot& B, Vec d, const double* sa, const double* sb) {
  Mask apart = Mask{};
  Real c[3][3], q[3][3];
  const Vec da = inverse_rotate(A, d), db = inverse_rotate(B, d);
  for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) { c[i][j] = dot(A.column(i), B.column(j)); q[i][j] = abs(c[i][j]); }
  const Real ta[3] = {da.x, da.y, da.z}, tb[3] = {db.x, db.y, db.z};
  for (int i = 0; i < 3; ++i) apart |= abs(ta[i]) > sa[i] + sb[0] * q[i][0] + sb[1] * q[i][1] + sb[2] * q[i][2];
  for (int j = 0; j < 3; ++j) apart |= abs(tb[j]) > sb[j] + sa[0] * q[0][j] + sa[1] * q[1][j] + sa[2] * q[2][j];
  if (!any(~apart)) return ~apart;
  for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) {
    const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
    const Real l = abs(ta[i2] * c[i1][j] - ta[i1] * c[i2][j]);
    apart |= l > sa[i1] * q[i2][j] + sa[i2] * q[i1][j] + sb[j1] * q[i][j2] + sb[j2] * q[i][j1] + 1e-9;
  }
  return ~apart;
}

// Self contacts: spheres and capsules here; a lane that may touch itself with a box is left to mj_step.
inline void collide_self(const Shared& m, Work& w) {
  const auto reach = [&](int k) {
    const double* s = m.size[k];
    return kGeomShape[k] == kSphere ? s[0] : kGeomShape[k] == kCapsule ? s[0] + s[1] : __builtin_sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
  };
  Vec o[kGeoms], ax[kGeoms];
  double farthest[kGeoms];
  for (int k = 0; k < kGeoms; ++k) {
    const int b = kGeomBody[k];
    o[k] = w.r[b] + rotate(w.rot[b], m.offset[k]);
    const double axis[3] = {m.frame[k][2] * m.size[k][1], m.frame[k][5] * m.size[k][1], m.frame[k][8] * m.size[k][1]};
    ax[k] = kGeomShape[k] == kCapsule ? rotate(w.rot[b], axis) : zero_vec();
    farthest[k] = reach(k);
  }
  for (int i = 0; i < kGeoms; ++i)
    for (int j = i + 1; j < kGeoms; ++j) {
      if (m.collides[i][j] == 0.0) continue;
      const bool swapped = kGeomShape[i] > kGeomShape[j];  // the simpler shape first, as in MuJoCo
      const int g1 = swapped ? j : i, g2 = swapped ? i : j;
      const Vec d = o[g1] - o[g2];
      const double apart = farthest[g1] + farthest[g2];
      if (!any(dot(d, d) < apart * apart)) continue;
      const int a = kGeomBody[g1], b = kGeomBody[g2];
      const double *s1 = m.size[g1], *s2 = m.size[g2];
      if (kGeomShape[g2] == kBox) {
        if (kGeomShape[g1] == kBox) w.flagged |= boxes_touch(w.rot[a], w.rot[b], d, s1, s2);
        else w.flagged |= near_box(inverse_rotate(w.rot[b], d), inverse_rotate(w.rot[b], ax[g1]), s1[0], s2);
        continue;
      }
      // nearest points of two segments o + x ax, x in [-1, 1], as mjraw_CapsuleCapsule
      const Vec a1 = ax[g1], a2 = ax[g2];
      const Real one = splat(1), ma = dot(a1, a1), mb = -dot(a1, a2), mc = dot(a2, a2), u = -dot(a1, d), v = dot(a2, d);
      Real x1 = splat(0), x2;
      if (kGeomShape[g1] == kSphere) {
        x2 = clamp(v / mc, -one, one);
      } else {
        const Real det = 1.0 / (ma * mc - mb * mb);
        x1 = (mc * u - mb * v) * det, x2 = (ma * v - mb * u) * det;
        Mask high = x1 > 1.0, low = x1 < -1.0;
        x2 = select(high, (v - mb) / mc, select(low, (v + mb) / mc, x2));
        x1 = select(high, one, select(low, -one, x1));
        high = x2 > 1.0, low = x2 < -1.0;
        x1 = select(high, clamp((u - mb) / ma, -one, one), select(low, clamp((u + mb) / ma, -one, one), x1));
        x2 = select(high, one, select(low, -one, x2));
      }
      const Vec p1 = o[g1] + x1 * a1, e = (o[g2] + x2 * a2) - p1;
      const Real len2 = dot(e, e);
      const double near = s1[0] + s2[0];
      const Mask exists = len2 < near * near;
      if (!any(exists)) continue;
      const Real len = sqrt(len2), dist = len - near;
      const Impedance& c = m.pair[g1][g2];
      Pair& p = w.pr[w.npr++];
      p.a = a, p.b = b, p.exists = exists, p.g1 = g1, p.g2 = g2, p.level = kBetween.of[g1][g2].level;
      p.n = (1.0 / len) * e;
      p.r = p1 + (s1[0] + 0.5 * dist) * p.n;
      frame_of(p.n, p.t, p.s);
      Real rest;
      const Real imp = impedance(c, dist, rest);
      p.mu = max(w.numbers.friction[g1], w.numbers.friction[g2]);
      p.d = select(exists, pyramid_weight(imp, rest, p.mu, w.numbers.weight[a] + w.numbers.weight[b]), splat(0));
      const Vec v_ab = velocity_at(w.vel[b], p.r) - velocity_at(w.vel[a], p.r);
      p.cn = c.b * dot(p.n, v_ab) + c.k * imp * dist;
      p.c1 = c.b * dot(p.t, v_ab);
      p.c2 = c.b * dot(p.s, v_ab);
      mark_used(w, a), mark_used(w, b);
      if (p.level > w.pattern) w.pattern = p.level;
    }
}

inline void collide(const Shared& m, const Group& g, Work& w) {
  w.npt = w.npr = w.pattern = 0;
  w.flagged = Mask{};
  for (bool& used : w.used) used = false;
  collide_floor(m, g, w);
  collide_limits(m, g, w);
  collide_self(m, w);
}

}  // namespace naosim::t1::NAOSIM_ISA
