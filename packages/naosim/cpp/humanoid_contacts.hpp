// Contacts of a group of humanoids with the floor and with themselves, and joint limits: which there are, their frames, and the weight
// and reference acceleration of their rows, as MuJoCo's mj_collision and mj_makeConstraint.
#pragma once
#include <algorithm>

#include "humanoid_dynamics.hpp"

namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA {

constexpr double kReach = 1.5;  // m; no part of a robot is farther from its torso

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

// The four rows of a contact with impedance rule `c`: D, and the part of -aref that stems from the violation. `speed`: the
// relative velocity along n, t, s. With -aref = B J v + K imp dist, only the normal has the violation.
inline void put_rows(const Work& w, Pyramid& p, const Impedance& c, Real dist, Real weight, Vec speed) {
  Real rest;
  const Real imp = impedance(c, dist, rest), b = c.b * w.numbers.damping, k = c.k * w.numbers.stiffness;
  p.d = select(p.exists, pyramid_weight(imp, rest, p.mu, weight), splat(0));
  p.cn = b * speed.x + k * imp * dist, p.ct = b * speed.y, p.cs = b * speed.z;
}

// The contact halfway between the floor and the lowest point r of a geom; `number`: which of the geom's points it is.
inline void put_point(const Shared& m, Work& w, int geom, int number, Vec r, Real dist, Mask exists, Real tx, Real ty) {
  Point& p = w.pt[w.npt++];
  p.row = points_before(geom) + number, p.body = kGeomBody[geom], p.exists = exists, p.mu = w.numbers.friction[geom];
  p.r = {r.x, r.y, r.z - 0.5 * dist};
  p.tx = tx, p.ty = ty;
  const Vec v = velocity_at(w.vel[p.body], p.r);
  put_rows(w, p, m.floor[geom], dist, w.numbers.weight[p.body], {v.z, tx * v.x + ty * v.y, tx * v.y - ty * v.x});
  mark_used(w, p.body);
}

// Axes of a geom that is neither sphere nor capsule.
inline Rot axes_of(const Shared& m, const Work& w, int geom) {
  const double* f = m.frame[geom];
  const Rot& r = w.rot[kGeomBody[geom]];
  return f[0] == 1.0 && f[4] == 1.0 ? r : times(r, f);
}

// A box touches with the corners below its centre: one of each of the four opposite pairs. o: its centre.
inline void box_on_floor(const Shared& m, Work& w, int geom, Vec o, Real height) {
  const double* size = m.size[geom];
  const Rot r = axes_of(m, w, geom);
  const Real zx = r.m[2][0] * size[0], zy = r.m[2][1] * size[1], zz = r.m[2][2] * size[2], one = splat(1);
  if (!any(height - (abs(zx) + abs(zy) + abs(zz)) < 0.0)) return;
  for (int p = 0; p < 4; ++p) {
    // how far the corner is above the centre; below it is the corner or its opposite
    const double sx = p & 1 ? 1 : -1, sy = p & 2 ? 1 : -1;
    const Real l = sx * zx + sy * zy - zz, dist = height - abs(l);
    const Mask exists = dist < 0.0;
    if (!any(exists)) continue;
    const double corner[3] = {sx * size[0], sy * size[1], -size[2]};
    put_point(m, w, geom, p, o + select(l > 0.0, -one, one) * rotate(r, corner), dist, exists, splat(0), one);
  }
}

// A sphere touches with its lowest point.
inline void sphere_on_floor(const Shared& m, Work& w, int geom, Vec o, Real height) {
  const double radius = m.size[geom][0];
  const Real dist = height - radius;
  const Mask exists = dist < 0.0;
  if (any(exists)) put_point(m, w, geom, 0, {o.x, o.y, o.z - radius}, dist, exists, splat(0), splat(1));
}

// A capsule touches with the lowest points of the spheres at its ends.
inline void capsule_on_floor(const Shared& m, const Group& g, Work& w, int geom, Vec o, Real height) {
  const double *size = m.size[geom], axis[3] = {m.frame[geom][2], m.frame[geom][5], m.frame[geom][8]};
  const Vec ax = rotate(w.rot[kGeomBody[geom]], axis);
  if (!any(height - abs(ax.z) * size[1] - size[0] < 0.0)) return;
  // the first tangent is the horizontal part of the axis, x where there is none
  const Real n2 = ax.x * ax.x + ax.y * ax.y, n = 1.0 / sqrt(max(n2, splat(1e-30)));
  const Mask up = n2 < 1e-28;
  const Real tx = select(up, splat(1), ax.x * n), ty = select(up, splat(0), ax.y * n);
  for (int s = 1; s >= -1; s -= 2) {
    const Vec e = o + (s * size[1]) * ax;
    const Real dist = g.qpos[2] + e.z - size[0];
    const Mask exists = dist < 0.0;
    if (any(exists)) put_point(m, w, geom, s < 0, {e.x, e.y, e.z - size[0]}, dist, exists, tx, ty);
  }
}

// Half the diagonal of the box around a geom.
inline double reach_of_hull(const Shared& m, int geom) {
  const double* h = m.hull[geom];
  return __builtin_sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2]);
}

// Lanes in which the box around a cylinder or a mesh is in the floor: there MuJoCo looks for contacts.
inline Mask hull_in_floor(const Shared& m, const Group& g, const Work& w, int geom) {
  const int b = kGeomBody[geom];
  const double* h = m.hull[geom];
  const Real centre = g.qpos[2] + w.r[b].z + rotate(w.rot[b], m.middle[geom]).z;
  if (!any(centre < reach_of_hull(m, geom))) return Mask{};
  const Rot a = axes_of(m, w, geom);
  return centre - (abs(a.m[2][0]) * h[0] + abs(a.m[2][1]) * h[1] + abs(a.m[2][2]) * h[2]) < 1e-9;
}

// Geoms against the floor.
inline void collide_floor(const Shared& m, const Group& g, Work& w) {
  for (int k = 0; k < kGeoms; ++k) {
    if (kGeomShape[k] == kCylinder || kGeomShape[k] == kMesh) {
      w.searched |= hull_in_floor(m, g, w, k);
      continue;
    }
    const int b = kGeomBody[k];
    const Vec o = w.r[b] + rotate(w.rot[b], m.offset[k]);
    const Real height = g.qpos[2] + o.z;
    if (kGeomShape[k] == kBox) box_on_floor(m, w, k, o, height);
    else if (kGeomShape[k] == kSphere) sphere_on_floor(m, w, k, o, height);
    else capsule_on_floor(m, g, w, k, o, height);
  }
}

// Rows of the joints beyond a limit: only the violated side.
inline void collide_limits(const Shared& m, const Group& g, Work& w) {
  w.nlim = 0;
  for (int j = 0; j < kJoints; ++j) {
    const Real dl = g.qpos[7 + j] - m.low[j], dh = m.high[j] - g.qpos[7 + j], dist = min(dl, dh);
    const Mask on = dist < 0.0;
    if (!any(on)) continue;
    // J is 1 at the lower limit, -1 at the upper; 1 / D = (1 - imp) / imp times the joint's inverse weight
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
constexpr bool is_above(int a, int b) {
  while (b > a) b = kParent[b];
  return a == b;
}
// The pattern that products of these speeds, in ascending order, need.
constexpr int level_of(const int* speeds, int count) {
  int level = 0;
  for (int x = 0; x < count; ++x)
    for (int y = 0; y < x; ++y) {
      const int i = speeds[x] - 5, j = speeds[y] - 5;
      if (j <= 0 || is_above(j, i)) continue;
      level = std::max(level, kHip[i] && kArm[j] ? 1 : 2);
    }
  return level;
}
constexpr Between between(int a, int b) {
  Between out;
  for (int x = 1; x < kBodies; ++x) {
    const bool ua = is_above(x, a), ub = is_above(x, b);
    if (ua != ub) out.joints[out.count] = 5 + x, out.sign[out.count++] = ua ? -1 : 1;
  }
  out.level = level_of(out.joints, out.count);
  return out;
}
struct BetweenBodies {
  Between of[kBodies][kBodies] = {};
  constexpr BetweenBodies() {
    for (int i = 0; i < kBodies; ++i)
      for (int j = 0; j < kBodies; ++j) of[i][j] = between(i, j);
  }
};
// Computed by the compiler: what runs when the library is loaded would run on processors without these instructions.
inline constexpr BetweenBodies kBetween;

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

// The point of a cylinder, or of a box, that is farthest along n, from its centre.
inline Vec farthest_along(Vec n, const Rot& axes, const double* half, bool cylinder) {
  const Vec z = axes.column(2);
  const Real zero = splat(0), along = dot(z, n);
  const auto end = [&](Vec axis, Real towards, double length) { return select(towards < 0.0, splat(-length), splat(length)) * axis; };
  if (!cylinder) return end(axes.column(0), dot(axes.column(0), n), half[0]) + end(axes.column(1), dot(axes.column(1), n), half[1]) + end(z, along, half[2]);
  const Vec across = n - along * z;
  const Real length = sqrt(dot(across, across));
  return end(z, along, half[2]) + select(length > 1e-12, half[0] / max(length, splat(1e-12)), zero) * across;
}
// Whether a plane is found between two cylinders, or a cylinder and a box: Gilbert's algorithm for the point of their difference that
// is nearest to zero.
inline Mask separated(Vec d, const Rot& A, const double* sa, bool cylinder_a, const Rot& B, const double* sb, bool cylinder_b) {
  Vec v = d;
  Mask found = Mask{};
  for (int i = 0; i < 12; ++i) {
    const Vec back = -1.0 * v, to = d + farthest_along(back, A, sa, cylinder_a) - farthest_along(v, B, sb, cylinder_b);
    found |= dot(v, to) > 1e-9;
    if (!any(~found)) break;
    const Vec e = to - v;
    v = v + clamp(-dot(v, e) / max(dot(e, e), splat(1e-30)), splat(0), splat(1)) * e;
  }
  return found;
}

// The geoms of a group: centres, half axes of capsules, axes of what is not round, and radii of the spheres around them.
struct Placed {
  Rot axes[kGeoms];
  Vec o[kGeoms], ax[kGeoms];
  double reach[kGeoms];
};
inline void place_geoms(const Shared& m, const Work& w, Placed& at) {
  for (int k = 0; k < kGeoms; ++k) {
    const int b = kGeomBody[k];
    const double* s = m.size[k];
    at.o[k] = w.r[b] + rotate(w.rot[b], is_round(k) ? m.offset[k] : m.middle[k]);
    if (!is_round(k)) at.axes[k] = axes_of(m, w, k);
    const double axis[3] = {m.frame[k][2] * s[1], m.frame[k][5] * s[1], m.frame[k][8] * s[1]};
    at.ax[k] = kGeomShape[k] == kCapsule ? rotate(w.rot[b], axis) : zero_vec();
    at.reach[k] = kGeomShape[k] == kSphere ? s[0] : kGeomShape[k] == kCapsule ? s[0] + s[1] : reach_of_hull(m, k);
  }
}

// How far a mesh extends at most in a direction, from the middle of its box. It is convex in the direction, so between the grid's
// points it is no more than what is interpolated.
inline double extent(const double (&table)[6][kCells + 1][kCells + 1], const double direction[3]) {
  int k = 0;  // the longest component, whose sign says the side
  for (int i = 1; i < 3; ++i)
    if (std::abs(direction[i]) > std::abs(direction[k])) k = i;
  const double length = std::abs(direction[k]), half = 0.5 * kCells;
  const double x = half * (direction[(k + 1) % 3] / length + 1.0), y = half * (direction[(k + 2) % 3] / length + 1.0);
  if (!(x >= 0.0 && x <= kCells && y >= 0.0 && y <= kCells)) return 1e9;  // NaN
  const int i = std::min(static_cast<int>(x), kCells - 1), j = std::min(static_cast<int>(y), kCells - 1);
  const double fx = x - i, fy = y - j;
  const auto& side = table[2 * k + (direction[k] < 0.0)];
  return length * ((1.0 - fx) * ((1.0 - fy) * side[i][j] + fy * side[i][j + 1]) + fx * ((1.0 - fy) * side[i + 1][j] + fy * side[i + 1][j + 1]));
}
// Lanes, of some, in which a mesh is clear of a side of the box around another geom. d: from the box's middle to the mesh's.
__attribute__((noinline)) inline Mask clear_of_box(const Shared& m, Mask some, int mesh, const Rot& axes, Vec d, const Rot& box, const double* half) {
  Mask clear = Mask{};
  for (int k = 0; k < 3; ++k) {
    const Vec side = box.column(k), back = inverse_rotate(axes, side);
    const Real away = dot(d, side);
    for (int l = 0; l < kLanes; ++l) {
      if (!some[l] || clear[l]) continue;
      const double sign = away[l] < 0.0 ? 1.0 : -1.0, direction[3] = {sign * back.x[l], sign * back.y[l], sign * back.z[l]};
      if (std::abs(away[l]) > half[k] + extent(m.extent[meshes_before(mesh)], direction) + 1e-9) clear[l] = -1;
    }
  }
  return clear;
}

// Lanes in which two geoms may touch, of which g2 is not round: there MuJoCo looks for contacts. d = o1 - o2.
inline Mask may_touch(const Shared& m, const Placed& at, int g1, int g2, Vec d) {
  const double *h1 = m.hull[g1], *h2 = m.hull[g2];
  if (is_round(g1)) return near_box(inverse_rotate(at.axes[g2], d), inverse_rotate(at.axes[g2], at.ax[g1]), m.size[g1][0], h2);
  Mask touch = boxes_touch(at.axes[g1], at.axes[g2], d, h1, h2);
  const bool c1 = kGeomShape[g1] == kCylinder, c2 = kGeomShape[g2] == kCylinder;
  if ((c1 || c2) && any(touch)) touch &= ~separated(d, at.axes[g1], h1, c1, at.axes[g2], h2, c2);
  if (kGeomShape[g1] == kMesh && any(touch)) touch &= ~clear_of_box(m, touch, g1, at.axes[g1], d, at.axes[g2], h2);
  if (kGeomShape[g2] == kMesh && any(touch)) touch &= ~clear_of_box(m, touch, g2, at.axes[g2], -1.0 * d, at.axes[g1], h1);
  return touch;
}

// Where two segments o + x a, x in [-1, 1], are nearest, as mjraw_CapsuleCapsule; the first may be a point. d = o1 - o2.
inline void nearest(Vec d, Vec a1, Vec a2, bool point, Real& x1, Real& x2) {
  const Real one = splat(1), ma = dot(a1, a1), mb = -dot(a1, a2), mc = dot(a2, a2), u = -dot(a1, d), v = dot(a2, d);
  x1 = splat(0);
  if (point) {
    x2 = clamp(v / mc, -one, one);
    return;
  }
  // of the two lines
  const Real det = 1.0 / (ma * mc - mb * mb);
  x1 = (mc * u - mb * v) * det, x2 = (ma * v - mb * u) * det;
  // where the first ends, the point of the second line that is nearest to its end
  Mask high = x1 > 1.0, low = x1 < -1.0;
  x2 = select(high, (v - mb) / mc, select(low, (v + mb) / mc, x2));
  x1 = select(high, one, select(low, -one, x1));
  // where the second ends, the point of the first segment that is nearest to its end
  high = x2 > 1.0, low = x2 < -1.0;
  x1 = select(high, clamp((u - mb) / ma, -one, one), select(low, clamp((u + mb) / ma, -one, one), x1));
  x2 = select(high, one, select(low, -one, x2));
}

// The contact of two spheres or capsules. `row`: where the robot's memory has it.
inline void round_contact(const Shared& m, Work& w, const Placed& at, int g1, int g2, int row, Vec d) {
  Real x1, x2;
  nearest(d, at.ax[g1], at.ax[g2], kGeomShape[g1] == kSphere, x1, x2);
  const Vec p1 = at.o[g1] + x1 * at.ax[g1], e = (at.o[g2] + x2 * at.ax[g2]) - p1;
  const Real len2 = dot(e, e);
  const double radius = m.size[g1][0], near = radius + m.size[g2][0];
  const Mask exists = len2 < near * near;
  if (!any(exists)) return;
  const int a = kGeomBody[g1], b = kGeomBody[g2];
  const Real len = sqrt(len2), dist = len - near;
  Pair& p = w.pr[w.npr++];
  p.row = row, p.a = a, p.b = b, p.exists = exists, p.level = kBetween.of[a][b].level;
  p.n = (1.0 / len) * e;
  p.r = p1 + (radius + 0.5 * dist) * p.n;
  frame_of(p.n, p.t, p.s);
  p.mu = max(w.numbers.friction[g1], w.numbers.friction[g2]);
  const Vec v = velocity_at(w.vel[b], p.r) - velocity_at(w.vel[a], p.r);
  put_rows(w, p, m.pair[g1][g2], dist, w.numbers.weight[a] + w.numbers.weight[b], {dot(p.n, v), dot(p.t, v), dot(p.s, v)});
  mark_used(w, a), mark_used(w, b);
  if (p.level > w.pattern) w.pattern = p.level;
}

// Self contacts of spheres and capsules. Where boxes, or the boxes around other shapes, are touched, MuJoCo looks for contacts.
inline void collide_self(const Shared& m, Work& w) {
  Placed at;
  place_geoms(m, w, at);
  for (int i = 0; i < kGeoms; ++i)
    for (int j = i + 1; j < kGeoms; ++j) {
      if (m.collides[i][j] == 0.0) continue;
      const bool swapped = kGeomShape[i] > kGeomShape[j];  // the simpler shape first, as in MuJoCo
      const int g1 = swapped ? j : i, g2 = swapped ? i : j;
      const Vec d = at.o[g1] - at.o[g2];
      const double apart = at.reach[g1] + at.reach[g2];
      if (!any(dot(d, d) < apart * apart)) continue;
      if (is_round(g2)) round_contact(m, w, at, g1, g2, pair_row(i, j), d);
      else w.searched |= may_touch(m, at, g1, g2, d);
    }
}

// A contact of no lane yet, at its place in the order.
inline Contact& contact_of(Work& w, long key, int a, int b, int dim) {
  const auto place = std::lower_bound(w.more.begin(), w.more.end(), key, [](const Contact& c, long k) { return c.key < k; });
  if (place != w.more.end() && place->key == key) return *place;
  Contact& c = *w.more.insert(place, Contact());
  const Vec z = zero_vec(), x = {splat(1), splat(0), splat(0)}, y = {splat(0), splat(1), splat(0)}, up = {splat(0), splat(0), splat(1)};
  c.key = key, c.a = a, c.b = b, c.dim = dim;
  c.r = c.ball = z, c.n = up, c.t = x, c.s = y, c.exists = Mask{}, c.d = splat(0);
  for (Real& mu : c.mu) mu = splat(1);
  for (Real& each : c.c) each = splat(0);
  return c;
}

// The ball's contact with the floor, in six dimensions.
inline void ball_on_floor(const Shared& m, const Group& g, Work& w) {
  const double radius = m.ball.radius;
  const Real dist = g.ball[2] - radius, z = splat(0), one = splat(1);
  const Mask exists = dist < 0.0;
  if (!any(exists)) return;
  Contact& c = contact_of(w, 0, -1, kBall, 6);
  c.exists = exists;
  c.ball = {z, z, -radius - 0.5 * dist};
  c.n = {z, z, one}, c.t = {z, one, z}, c.s = {-one, z, z};
  for (int k = 0; k < 5; ++k) c.mu[k] = splat(m.ball.friction[k]);
  const Impedance& p = m.ball.floor;
  Real rest;
  const Real imp = impedance(p, dist, rest);
  c.d = select(exists, pyramid_weight(imp, rest, c.mu[0], splat(1.0 / m.ball.mass)), z);
  const Vec spin = load(g.qvel + kSpeeds + 3), at = load(g.qvel + kSpeeds) + cross(spin, c.ball);
  c.c[0] = p.b * at.z + p.k * imp * dist;
  c.c[1] = p.b * at.y, c.c[2] = -(p.b * at.x), c.c[3] = p.b * spin.z, c.c[4] = p.b * spin.y, c.c[5] = -(p.b * spin.x);
}

// Lanes in which the ball may touch a geom.
inline Mask ball_near(const Shared& m, const Work& w, int geom) {
  const Rot& body = w.rot[kGeomBody[geom]];
  const Vec d = w.ball - w.r[kGeomBody[geom]];
  const double radius = m.ball.radius;
  if (!is_round(geom)) {
    const Vec e = d - rotate(body, m.middle[geom]);
    const double reach = reach_of_hull(m, geom) + radius;
    if (!any(dot(e, e) < reach * reach)) return Mask{};
    return near_box(inverse_rotate(axes_of(m, w, geom), e), zero_vec(), radius, m.hull[geom]);
  }
  const double length = kGeomShape[geom] == kCapsule ? m.size[geom][1] : 0.0, reach = m.size[geom][0] + length + radius;
  const Vec e = d - rotate(body, m.offset[geom]);
  if (!any(dot(e, e) < reach * reach)) return Mask{};
  const double axis[3] = {m.frame[geom][2], m.frame[geom][5], m.frame[geom][8]};
  const Vec ax = rotate(body, axis), f = e - clamp(dot(ax, e), splat(-length), splat(length)) * ax;
  const double near = m.size[geom][0] + radius + 1e-9;
  return dot(f, f) < near * near;
}

// The ball on the floor; near the robot or a goal, MuJoCo looks for contacts. So it does near goals for the robot.
inline void collide_ball(const Shared& m, const Group& g, Work& w) {
  for (Mask& part : w.touching) part = Mask{};
  ball_on_floor(m, g, w);
  if (any(dot(w.ball, w.ball) < 4.0))
    for (int k = 0; k < kGeoms; ++k) w.searched |= ball_near(m, w, k);
  for (int k = 0; k < m.goals; ++k) {
    const double* low = m.goal[k];
    const double* high = low + 3;
    const auto within = [&](Vec p, double reach) {
      return (p.x > low[0] - reach) & (p.x < high[0] + reach) & (p.y > low[1] - reach) & (p.y < high[1] + reach) & (p.z > low[2] - reach) &
             (p.z < high[2] + reach);
    };
    w.searched |= within(load(g.ball), m.ball.radius + 1e-9) | within(load(g.qpos), kReach);
  }
}

// mjContact and what of mjData has its list, of MuJoCo 3.5.0.
struct Found {
  double dist, pos[3], frame[9], margin, friction[5], solref[2], solreffriction[2], solimp[5], mu, H[36];
  int dim, geom1, geom2, geom[2], flex[2], elem[2], vert[2], exclude, address;
};
static_assert(sizeof(Found) == 576, "mjContact has another size");
constexpr std::size_t kCount = 161576, kContacts = 162432;

// The impedance rule of a contact that MuJoCo found, from its solref and solimp.
inline Impedance rule_of(const Found& f, double step) {
  Impedance p = {std::min(std::max(f.solimp[0], 1e-4), 0.9999), std::min(std::max(f.solimp[1], 1e-4), 0.9999), f.solimp[2], 0.0, 0.0};
  if (f.solref[0] > 0.0) {
    const double time = std::max(f.solref[0], 2.0 * step);
    p.k = 1.0 / (p.d1 * p.d1 * time * time * f.solref[1] * f.solref[1]), p.b = 2.0 / (p.d1 * time);
  } else {  // stiffness and damping themselves
    p.k = -f.solref[0] / (p.d1 * p.d1), p.b = -f.solref[1] / p.d1;
  }
  return p;
}

// Add a contact that MuJoCo found for one lane, of bodies a and b.
inline void put_found(const Shared& m, const Library& mujoco, const Robot& robot, const Group& g, Work& w, int lane, const Found& f, int a, int b, int same) {
  Contact& c = contact_of(w, (long(f.geom[0]) * 1024 + f.geom[1] + 1) * 64 + same, a, b, f.dim);
  c.exists[lane] = -1;
  // the point about the torso's origin and about the ball's centre, and the frame
  const auto put = [&](Vec& to, const double* from) { to.x[lane] = from[0], to.y[lane] = from[1], to.z[lane] = from[2]; };
  double r[3], ball[3];
  for (int k = 0; k < 3; ++k) r[k] = f.pos[k] - robot.qpos[k], ball[k] = robot.ball_qpos != nullptr ? f.pos[k] - robot.ball_qpos[k] : 0.0;
  put(c.r, r), put(c.ball, ball), put(c.n, f.frame), put(c.t, f.frame + 3), put(c.s, f.frame + 6);
  for (int k = 0; k < f.dim - 1; ++k) c.mu[k][lane] = f.friction[k];
  // D of its rows
  const Impedance p = rule_of(f, mujoco.step);
  Real rest;
  const Real imp = impedance(p, splat(f.dist), rest);
  const auto weight = [&](int body) { return body < 0 ? 0.0 : body == kBall ? 1.0 / m.ball.mass : w.numbers.weight[body][lane]; };
  c.d[lane] = pyramid_weight(imp, rest, splat(f.friction[0]), splat(weight(a) + weight(b)))[lane];
  // -aref = B J v + K imp dist, of the motion of b at the point relative to that of a
  const auto motion = [&](int body, Vec& v, Vec& spin) {
    v = spin = zero_vec();
    if (body == kBall) spin = load(g.qvel + kSpeeds + 3), v = load(g.qvel + kSpeeds) + cross(spin, c.ball);
    else if (body >= 0) spin = w.vel[body].w, v = velocity_at(w.vel[body], c.r);
  };
  Vec va, wa, vb, wb;
  motion(a, va, wa), motion(b, vb, wb);
  const Vec v = vb - va, spin = wb - wa;
  const Real along[6] = {dot(c.n, v), dot(c.t, v), dot(c.s, v), dot(c.n, spin), dot(c.t, spin), dot(c.s, spin)};
  for (int k = 0; k < f.dim; ++k) c.c[k][lane] = p.b * along[k][lane] + (k ? 0.0 : p.k * imp[lane] * f.dist);
}

// Let MuJoCo find the contacts that are not computed above, and add them to the lane's.
inline void search(const Shared& m, const Library& mujoco, const Robot& robot, const Group& g, Work& w, int lane) {
  mujoco.collide(mujoco.worlds, robot);
  const char* data = static_cast<const char*>(robot.data);
  const int count = *reinterpret_cast<const int*>(data + kCount);
  const Found* found = *reinterpret_cast<const Found* const*>(data + kContacts);
  // the kernel's number of a geom, kGeoms of the ball, -1 of the surroundings; and of its body
  const auto geom_of = [&](int id) { return id >= mujoco.first_geom ? id - mujoco.first_geom : id == mujoco.ball ? kGeoms : -1; };
  const auto body_of = [](int k) { return k < 0 ? -1 : k == kGeoms ? kBall : kGeomBody[k]; };
  const auto plain = [](int k) { return k >= 0 && k < kGeoms && is_round(k); };
  int same = 0;  // number of the contact among those of its two geoms
  for (int i = 0; i < count; ++i) {
    const Found& f = found[i];
    same = i && f.geom[0] == found[i - 1].geom[0] && f.geom[1] == found[i - 1].geom[1] ? same + 1 : 0;
    const int ga = geom_of(f.geom[0]), gb = geom_of(f.geom[1]);
    // those of spheres and capsules, and what of boxes and the ball touches the floor, are known
    const bool floor = f.geom[0] == 0;
    if (f.exclude || (plain(ga) && plain(gb)) || (floor && (gb == kGeoms || plain(gb) || (gb >= 0 && kGeomShape[gb] == kBox)))) continue;
    const int a = body_of(ga), b = body_of(gb);
    put_found(m, mujoco, robot, g, w, lane, f, a, b, same);
    if (a != kBall && b != kBall) continue;
    const int other = a == kBall ? b : a;
    for (int part = 0; other >= 0 && part < int(m.ball.count); ++part)
      if (int(m.ball.parts[other]) >> part & 1) w.touching[part][lane] -= 1;
  }
}

// What the contacts found need of H, and which bodies they move.
inline void prepare_contacts(Work& w) {
  w.coupled = 0;
  bool coupled[kSpeeds] = {false};
  for (Contact& c : w.more) {
    const int a = c.a, b = c.b;
    for (int body : {a, b})
      if (body >= 0 && body < kBodies) mark_used(w, body);
    if (a >= 0 && b >= 0 && a < kBodies && b < kBodies) c.level = kBetween.of[a][b].level;
    else c.level = 0;
    if (c.level > w.pattern) w.pattern = c.level;
    if ((a == kBall && b >= 0) || (b == kBall && a >= 0)) {
      for (int i = 0; i < 6; ++i) coupled[i] = true;
      for (int body = a == kBall ? b : a; body > 0; body = kParent[body]) coupled[5 + body] = true;
    }
  }
  for (int i = 0; i < kSpeeds; ++i)
    if (coupled[i]) w.columns[w.coupled++] = i;
  w.pattern = std::max(w.pattern, level_of(w.columns, w.coupled));
}

// Contacts of a group, of which the first `count` lanes have robots.
inline void collide(const Shared& m, const Library& mujoco, Robot* const* robots, int count, const Group& g, Work& w) {
  w.npt = w.npr = w.pattern = 0;
  w.flagged = w.searched = Mask{};
  w.more.clear();
  for (bool& used : w.used) used = false;
  collide_floor(m, g, w);
  collide_limits(m, g, w);
  collide_self(m, w);
  if (w.speeds == kAll) collide_ball(m, g, w);
  const unsigned lanes = bits(w.searched);
  if (lanes) {
    Real sum = splat(0);
    for (int k = 0; k < kPositions; ++k) sum += abs(g.qpos[k]);
    for (int k = 0; k < w.speeds; ++k) sum += abs(g.qvel[k]);
    const unsigned finite = bits(sum < 1e9);  // false for NaN
    for (int l = 0; l < count; ++l)
      if (lanes >> l & finite >> l & 1u) search(m, mujoco, *robots[l], g, w, l);
    w.flagged |= w.searched & ~(sum < 1e9);
  }
  prepare_contacts(w);
}

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
