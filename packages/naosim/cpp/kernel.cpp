// One cycle of rcssserver3d for a vector of robots: effectors, drag, contacts, ODE's dWorldStep, perceptors.
//
// dWorldStep solves   M v+ = M v + h f + J^T u,   J v+ + D u = c,   lo <= u <= hi   (D = CFM / h, u = impulses)
// for all rows together. Here the same equations are solved exactly along the tree of bodies:
//   leaves to root  eliminate each body and the six rows of its hinge, which leaves a 6x6 inertia on the parent;
//   root to leaves  substitute back;
// and around it an active-set loop settles which bounded rows (motors, stops, contact normals) sit at a bound.
// Rows are taken in world axes at the anchor, so the hinge's D is diagonal but for its axis. docs/explanation/engine.md derives it.
#include "group.hpp"
#include "lanes.hpp"

#include <limits>

namespace naosim::NAOSIM_ISA {
namespace {

using Perceptors = PerceptorsOf<Real>;
using Group = StateOf<Real, Mask>;
static_assert(sizeof(Group) == sizeof(Environment) * kLanes, "word k of lane l is word k of that environment");

// rcssserver3d's parameters pass through single precision.
constexpr double kStep = static_cast<double>(0.02f);  // s
constexpr double kRate = 1.0 / kStep;
constexpr double kGravity = static_cast<double>(-9.81f);
constexpr double kWorldErp = 0.2;
constexpr double kWorldCfm = static_cast<double>(1e-5f);
constexpr double kMotorCfm = static_cast<double>(1e-8f);  // motor and stop rows
constexpr double kStopErp = static_cast<double>(0.8f);
constexpr double kMotorTorque = 10.0;  // N m
constexpr double kFudgeFactor = static_cast<double>(1e-5f);
constexpr double kDrag = static_cast<double>(-0.01f);
constexpr double kContactErp = static_cast<double>(0.4f);
constexpr double kContactCfm = static_cast<double>(1e-4f);
constexpr double kContactSlip = static_cast<double>(5e-3f);
constexpr double kSurfaceLayer = static_cast<double>(0.001f);  // m
constexpr double kIdleLinear = 0.01 * 0.01, kIdleAngular = 0.01 * 0.01, kIdleSteps = 10;
constexpr double kPi = 3.14159265358979323846;
constexpr double kDegrees = 180.0 / kPi;

constexpr double kHingeStiffness = kStep / kWorldCfm;  // 1 / D of the five hinge rows
constexpr double kMotorStiffness = kStep / kMotorCfm;
constexpr double kNormalStiffness = kStep / kContactCfm;
constexpr double kSlipStiffness = kStep / kContactSlip;

constexpr double kCollisionTolerance = 0.04;  // m, self-collision rule
constexpr double kFrozenTime = 1.0, kThawTime = 2.0;  // s

// Impulses (N s, N m s) and velocities this close to a bound count as on it.
constexpr double kImpulseTolerance = 1e-13, kVelocityTolerance = 1e-13;
constexpr int kNewtonRounds = 60;     // rounds before single exchanges
constexpr int kMaximumRounds = 3000;  // far beyond anything seen; guards against a hang only

struct Spatial {  // 6x6 symmetric: linear-linear a, angular-linear b (row = angular), angular-angular c
  Real a[3][3], b[3][3], c[3][3];
};

// Express an inertia at the point `r` away: S^T M S with S = [1 [r]x; 0 1].
inline void shift(Spatial& m, Vec r) {
  const Real rv[3] = {r.x, r.y, r.z};
  Real k[3][3], p[3][3];
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i) {
    k[i][0] = m.a[i][1] * rv[2] - m.a[i][2] * rv[1];
    k[i][1] = m.a[i][2] * rv[0] - m.a[i][0] * rv[2];
    k[i][2] = m.a[i][0] * rv[1] - m.a[i][1] * rv[0];
    p[i][0] = m.b[i][1] * rv[2] - m.b[i][2] * rv[1];
    p[i][1] = m.b[i][2] * rv[0] - m.b[i][0] * rv[2];
    p[i][2] = m.b[i][0] * rv[1] - m.b[i][1] * rv[0];
  }
  // [r]x^T k, lower triangle
  const Real q00 = rv[2] * k[1][0] - rv[1] * k[2][0];
  const Real q10 = rv[0] * k[2][0] - rv[2] * k[0][0], q11 = rv[0] * k[2][1] - rv[2] * k[0][1];
  const Real q20 = rv[1] * k[0][0] - rv[0] * k[1][0], q21 = rv[1] * k[0][1] - rv[0] * k[1][1], q22 = rv[1] * k[0][2] - rv[0] * k[1][2];
  m.c[0][0] += p[0][0] + p[0][0] + q00;
  m.c[1][0] += p[1][0] + p[0][1] + q10;
  m.c[1][1] += p[1][1] + p[1][1] + q11;
  m.c[2][0] += p[2][0] + p[0][2] + q20;
  m.c[2][1] += p[2][1] + p[1][2] + q21;
  m.c[2][2] += p[2][2] + p[2][2] + q22;
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i)
#pragma GCC unroll 3
    for (int j = 0; j < 3; ++j) m.b[i][j] += k[j][i];
}

// Lower triangles only are kept up to date in a and c.
inline void mirror(Real m[3][3]) {
  m[0][1] = m[1][0];
  m[0][2] = m[2][0];
  m[1][2] = m[2][1];
}

// L D L^T of a symmetric 6x6 given by its lower triangle; l below the diagonal, d inverted.
inline void factor(const Real x[6][6], Real l[6][6], Real inverse_d[6]) {
  Real t[6][6];
#pragma GCC unroll 6
  for (int j = 0; j < 6; ++j) {
    Real d = x[j][j];
#pragma GCC unroll 6
    for (int k = 0; k < j; ++k) d -= l[j][k] * t[j][k];
    inverse_d[j] = 1.0 / d;
#pragma GCC unroll 6
    for (int i = j + 1; i < 6; ++i) {
      Real s = x[i][j];
#pragma GCC unroll 6
      for (int k = 0; k < j; ++k) s -= l[i][k] * t[j][k];
      t[i][j] = s;
      l[i][j] = s * inverse_d[j];
    }
  }
}

struct Contact {  // one collider's points on the ground plane
  int body, collider;
  int points;           // slots in use by any lane
  Real arm[4][3];       // point relative to the body's centre, world axes, m
  Mask corner[4];       // which corner of the collider it is: 0 to 7
  Real target[4];       // velocity the normal row asks for, m/s
  Mask exists[4];
  Mask active[4];       // normal row not at its lower bound
};

struct Joint {  // constraint data of one body's hinge, world axes
  Vec arm, parent_arm;  // anchor relative to the two centres, m
  Vec axis;
  Vec linear, angular;  // right-hand side c, m/s and rad/s
  Real low, high;       // impulse bounds of the sixth row, N m s
  Real side;            // -1 at low, 0 free, 1 at high
  // factored form, root to leaves
  Real l[6][6], inverse_d[6], z[6][6], y[6];
  Real slip;            // axis . (s - w): sixth row's D u when free
};

struct Workspace {
  Rot rot[kMaxBodies];
  Spatial inertia[kMaxBodies];        // body's own, at its centre
  Real momentum[kMaxBodies][6];       // M v + h f
  Spatial total[kMaxBodies];          // own + contacts + children
  Real load[kMaxBodies][6];
  Joint joint[kMaxBodies];
  Contact contact[kMaxColliders];
  int contacts;
  Real result[kMaxBodies][6];         // v+
  Real normal[kMaxColliders][4];      // slack of the normal rows: target - J v+
};

// Where ODE's dCollide puts up to four points of a collider on the plane z = 0.
void collide(const Body& body, int index, Vec centre, const Rot& r, Contact& out) {
  out.body = index;
  out.points = 0;
  const auto put = [&](int slot, Vec arm, Real depth, Mask exists, Mask corner) {
    store(out.arm[slot], arm);
    out.corner[slot] = corner;
    const Real pushed = depth - kSurfaceLayer;
    out.target[slot] = kRate * kContactErp * (pushed > 0.0 ? pushed : splat(0.0));
    out.exists[slot] = exists;
    out.points = slot + 1;
  };
  if (body.shape == Shape::kSphere) {
    const Real depth = body.radius - centre.z;
    const Mask touches = depth >= 0.0;
    if (any(touches)) put(0, {splat(0.0), splat(0.0), splat(-body.radius)}, depth, touches, Mask{});
    return;
  }
  if (body.shape == Shape::kCapsule) {
    const Real sign = r.m[2][2] > 0.0 ? splat(-1.0) : splat(1.0);
    const Vec end = (body.half_length * sign) * r.column(2);
    const Real depth = body.radius - (centre.z + end.z);
    const Mask touches = depth >= 0.0;
    if (!any(touches)) return;
    const Mask upper = sign > 0.0 ? Mask{} + 1 : Mask{};
    put(0, {end.x, end.y, end.z - body.radius}, depth, touches, upper);
    const Real other = body.radius - (centre.z - end.z);
    const Mask both = touches & (other >= 0.0);
    if (any(both)) put(1, {-end.x, -end.y, -end.z - body.radius}, other, both, 1 - upper);
    return;
  }
  const Real a[3] = {2.0 * body.half[0] * r.m[2][0], 2.0 * body.half[1] * r.m[2][1], 2.0 * body.half[2] * r.m[2][2]};
  const Real b[3] = {abs(a[0]), abs(a[1]), abs(a[2])};
  const Real depth = 0.5 * (b[0] + b[1] + b[2]) - centre.z;
  const Mask touches = depth >= 0.0;
  if (!any(touches)) return;
  Vec side[3];  // from the deepest corner along each edge
  Vec corner = {splat(0.0), splat(0.0), splat(0.0)};
  Mask id = Mask{};
  for (int k = 0; k < 3; ++k) {
    const Real half = a[k] > 0.0 ? splat(-body.half[k]) : splat(body.half[k]);
    const Vec axis = r.column(k);
    corner = corner + half * axis;
    id |= a[k] > 0.0 ? Mask{} : Mask{} + (1 << k);
    side[k] = (-2.0 * half) * axis;
  }
  put(0, corner, depth, touches, id);
  // the two edges with the smallest rise, ODE's order in ties
  const Mask m01 = b[0] < b[1], m20 = b[2] < b[0], m21 = b[2] < b[1], m12 = b[1] < b[2], m02 = b[0] < b[2];
  const Mask third_first = (m01 & m20) | (~m01 & m21);
  const Mask first_first = m01 & ~m20, second_first = ~m01 & ~m21;
  const Mask first_second = (third_first & m01) | (second_first & m02);
  const Mask second_second = (third_first & ~m01) | (first_first & m12);
  const Vec u = select(third_first, side[2], select(first_first, side[0], side[1]));
  const Vec w = select(first_second, side[0], select(second_second, side[1], side[2]));
  const Real depth_u = depth - select(third_first, b[2], select(first_first, b[0], b[1]));
  const Real depth_w = depth - select(first_second, b[0], select(second_second, b[1], b[2]));
  const Mask one = Mask{} + 1, two = Mask{} + 2, four = Mask{} + 4;
  const Mask id_u = id ^ (third_first ? four : (first_first ? one : two)), id_w = id ^ (first_second ? one : (second_second ? two : four));
  const Mask has_u = touches & (depth_u >= 0.0);
  if (!any(has_u)) return;
  put(1, corner + u, depth_u, has_u, id_u);
  const Mask has_w = has_u & (depth_w >= 0.0);
  if (!any(has_w)) return;
  put(2, corner + w, depth_w, has_w, id_w);
  const Real depth_4 = depth_u + depth_w - depth;
  const Mask has_4 = has_w & (depth_4 > 0.0);
  if (any(has_4)) put(3, corner + u + w, depth_4, has_4, id ^ id_u ^ id_w);
}

// Hinge angle from the relative rotation of the two bodies, in (-pi, pi], rad.
Real hinge_angle(const Real q[4], const Real parent[4], const double axis[3]) {
  const Real w = q[0] * parent[0] + q[1] * parent[1] + q[2] * parent[2] + q[3] * parent[3];
  const Real x = q[0] * parent[1] - q[1] * parent[0] - q[2] * parent[3] + q[3] * parent[2];
  const Real y = q[0] * parent[2] + q[1] * parent[3] - q[2] * parent[0] - q[3] * parent[1];
  const Real z = q[0] * parent[3] - q[1] * parent[2] + q[2] * parent[1] - q[3] * parent[0];
  const Real sine = sqrt(x * x + y * y + z * z);
  const Mask along = axis[0] * x + axis[1] * y + axis[2] * z >= 0.0;
  const Real angle = 2.0 * atan2_upper(sine, along ? w : -w);
  return -(angle > kPi ? angle - 2.0 * kPi : angle);
}

// ODE's implicit gyroscopic step (Lacoursiere 2006): momentum I w' with (I - h [L]x) w' = L, body axes.
Vec gyroscopic(const double inertia[3], Vec spin) {
  const Vec l = {inertia[0] * spin.x, inertia[1] * spin.y, inertia[2] * spin.z};
  const Vec k = kStep * l;
  const Vec c0 = {splat(inertia[0]), -k.z, k.y}, c1 = {k.z, splat(inertia[1]), -k.x}, c2 = {-k.y, k.x, splat(inertia[2])};
  const Vec n0 = cross(c1, c2), n1 = cross(c2, c0), n2 = cross(c0, c1);
  const Real scale = 1.0 / dot(c0, n0);
  return {inertia[0] * (scale * dot(n0, l)), inertia[1] * (scale * dot(n1, l)), inertia[2] * (scale * dot(n2, l))};
}

void prepare(const Model& model, Group& g, Workspace& w, Mask awake) {
  const int bodies = model.body_count();
  for (int i = 0; i < bodies; ++i) {
    const Body& body = model.bodies[i];
    w.rot[i] = rotation(g.quaternion[i]);
    const Rot& r = w.rot[i];
    Spatial& m = w.inertia[i];
    for (int p = 0; p < 3; ++p)
      for (int q = 0; q < 3; ++q) {
        m.a[p][q] = splat(p == q ? body.mass : 0.0);
        m.b[p][q] = splat(0.0);
        if (body.isotropic)
          m.c[p][q] = splat(p == q ? body.inertia[0] : 0.0);
        else if (q <= p)
          m.c[p][q] = r.m[p][0] * body.inertia[0] * r.m[q][0] + r.m[p][1] * body.inertia[1] * r.m[q][1] +
                      r.m[p][2] * body.inertia[2] * r.m[q][2];
      }
    const Vec spin = load(g.spin[i]);
    const Vec angular = body.isotropic ? body.inertia[0] * spin : r * gyroscopic(body.inertia, inverse_rotate(r, spin));
    const Vec velocity = load(g.velocity[i]), force = load(g.force[i]), torque = load(g.torque[i]);
    w.momentum[i][0] = body.mass * velocity.x + kStep * force.x;
    w.momentum[i][1] = body.mass * velocity.y + kStep * force.y;
    w.momentum[i][2] = body.mass * velocity.z + kStep * (force.z + body.mass * kGravity);
    w.momentum[i][3] = angular.x + kStep * torque.x;
    w.momentum[i][4] = angular.y + kStep * torque.y;
    w.momentum[i][5] = angular.z + kStep * torque.z;
  }
  w.contacts = 0;
  for (int i = 0, collider = 0; i < bodies; ++i) {
    const Body& body = model.bodies[i];
    if (body.shape == Shape::kNone) continue;
    Contact& contact = w.contact[w.contacts];
    contact.collider = collider++;
    collide(body, i, load(g.position[i]), w.rot[i], contact);
    if (contact.points == 0) continue;
    // a corner that was touching but lifting in the last step probably still is
    const Mask lifted = g.lifted[contact.collider];
    for (int k = 0; k < contact.points; ++k) contact.active[k] = contact.exists[k] & (((lifted >> contact.corner[k]) & 1) == 0);
    ++w.contacts;
  }
  for (int i = 1; i < bodies; ++i) {
    const Body& body = model.bodies[i];
    const int p = body.parent;
    Joint& j = w.joint[i];
    j.arm = rotate(w.rot[i], body.anchor);
    j.parent_arm = rotate(w.rot[p], body.parent_anchor);
    const Vec gap = (j.parent_arm + load(g.position[p])) - (j.arm + load(g.position[i]));
    j.linear = (kRate * kWorldErp) * gap;
    j.axis = rotate(w.rot[i], body.axis);
    const Vec bend = cross(j.axis, rotate(w.rot[p], body.axis));
    const Real angle = g.angle[i], speed = g.motor_speed[i];
    const Mask low = angle <= body.low, high = ~low & (angle >= body.high), stopped = low | high;
    const Real limit = low ? splat(-1.0) : (high ? splat(1.0) : splat(0.0));
    Real rate = speed;  // what the sixth row asks for
    j.low = splat(-kMotorTorque * kStep);
    j.high = splat(kMotorTorque * kStep);
    if (any(stopped)) {
      const Real error = angle - (low ? splat(body.low) : splat(body.high));
      Real stop_rate = -(kRate * kStopErp) * error;
      // stops bounce fully: an incoming speed is mirrored if that asks for more than the ERP does
      const Real incoming = dot(load(g.spin[i]), j.axis) - dot(load(g.spin[p]), j.axis);
      stop_rate = (low & (incoming < 0.0) & (-incoming > stop_rate)) | (high & (incoming > 0.0) & (-incoming < stop_rate)) ? -incoming
                                                                                                                       : stop_rate;
      rate = stopped ? stop_rate : rate;
      j.low = stopped ? (low ? splat(0.0) : splat(-std::numeric_limits<double>::infinity())) : j.low;
      j.high = stopped ? (high ? splat(0.0) : splat(std::numeric_limits<double>::infinity())) : j.high;
      // The motor of a stopped joint becomes an external torque: full into the stop, a trace away from it.
      Real torque = (speed > 0.0) | ((speed == 0.0) & high) ? splat(-kMotorTorque) : splat(kMotorTorque);
      torque = (low & (speed > 0.0)) | (high & (speed < 0.0)) ? kFudgeFactor * torque : torque;
      const Vec impulse = (kStep * torque) * j.axis;
      for (int c = 0; c < 3; ++c) {
        const Real part = c == 0 ? impulse.x : c == 1 ? impulse.y : impulse.z;
        w.momentum[i][3 + c] = stopped ? w.momentum[i][3 + c] - part : w.momentum[i][3 + c];
        w.momentum[p][3 + c] = stopped ? w.momentum[p][3 + c] + part : w.momentum[p][3 + c];
      }
    }
    j.angular = (kRate * kWorldErp) * bend + rate * j.axis;
    // last step's active set is a good guess while the row is of the same kind
    j.side = (g.limit[i] == limit) & ~stopped ? g.row_side[i] : splat(0.0);
    g.limit[i] = awake ? limit : g.limit[i];
  }
}

// Solve for the velocities with the present active set.
void solve(const Model& model, Workspace& w) {
  const int bodies = model.body_count();
  for (int i = 0; i < bodies; ++i) {
    w.total[i] = w.inertia[i];
    for (int c = 0; c < 6; ++c) w.load[i][c] = w.momentum[i][c];
  }
  // A contact row touches one body only, so it simply adds J^T D^-1 J to that body.
  for (int n = 0; n < w.contacts; ++n) {
    const Contact& contact = w.contact[n];
    Spatial& m = w.total[contact.body];
    Real* load = w.load[contact.body];
    for (int k = 0; k < contact.points; ++k) {
      const Mask exists = contact.exists[k];
      const Real kt = exists ? splat(kSlipStiffness) : splat(0.0);
      const Real kn = contact.active[k] ? splat(kNormalStiffness) : splat(0.0);
      const Real rx = contact.arm[k][0], ry = contact.arm[k][1], rz = contact.arm[k][2];
      m.a[0][0] += kt;
      m.a[1][1] += kt;
      m.a[2][2] += kn;
      const Real tx = kt * rx, ty = kt * ry, tz = kt * rz, nx = kn * rx, ny = kn * ry;
      m.b[0][1] -= tz;
      m.b[0][2] += ny;
      m.b[1][0] += tz;
      m.b[1][2] -= nx;
      m.b[2][0] -= ty;
      m.b[2][1] += tx;
      m.c[0][0] += tz * rz + ny * ry;
      m.c[1][0] -= ny * rx;
      m.c[1][1] += tz * rz + nx * rx;
      m.c[2][0] -= tx * rz;
      m.c[2][1] -= ty * rz;
      m.c[2][2] += ty * ry + tx * rx;
      const Real push = kn * contact.target[k];
      load[2] += push;
      load[3] += ry * push;
      load[4] -= rx * push;
    }
  }
  for (int i = bodies - 1; i >= 1; --i) {
    Joint& j = w.joint[i];
    const int p = model.bodies[i].parent;
    Spatial& m = w.total[i];
    Real* g = w.load[i];
    const Mask clamped = j.side != 0.0;
    const Real impulse = j.side > 0.0 ? j.high : j.low;
    const Real held = clamped ? impulse : splat(0.0);  // axis impulse of a row at its bound
    g[3] += held * j.axis.x;
    g[4] += held * j.axis.y;
    g[5] += held * j.axis.z;
    // to the anchor: N = S^T M S, n = S^T g
    mirror(m.a);
    shift(m, j.arm);
    Real n[6] = {g[0], g[1], g[2], g[3] - (j.arm.y * g[2] - j.arm.z * g[1]), g[4] - (j.arm.z * g[0] - j.arm.x * g[2]),
                 g[5] - (j.arm.x * g[1] - j.arm.y * g[0])};
    // X = N + D^-1
    Real full[6][6], x[6][6];
#pragma GCC unroll 3
    for (int r = 0; r < 3; ++r)
#pragma GCC unroll 3
      for (int c = 0; c < 3; ++c) {
        full[r][c] = r >= c ? m.a[r][c] : m.a[c][r];
        full[3 + r][c] = m.b[r][c];
        full[c][3 + r] = m.b[r][c];
        full[3 + r][3 + c] = r >= c ? m.c[r][c] : m.c[c][r];
      }
#pragma GCC unroll 6
    for (int r = 0; r < 6; ++r)
#pragma GCC unroll 6
      for (int c = 0; c <= r; ++c) x[r][c] = full[r][c];
#pragma GCC unroll 6
    for (int r = 0; r < 6; ++r) x[r][r] += kHingeStiffness;
    const Real extra = clamped ? splat(-kHingeStiffness) : splat(kMotorStiffness - kHingeStiffness);
    const Real ex = extra * j.axis.x, ey = extra * j.axis.y, ez = extra * j.axis.z;
    x[3][3] += ex * j.axis.x;
    x[4][3] += ey * j.axis.x;
    x[4][4] += ey * j.axis.y;
    x[5][3] += ez * j.axis.x;
    x[5][4] += ez * j.axis.y;
    x[5][5] += ez * j.axis.z;
    factor(x, j.l, j.inverse_d);
    // Z = L^-1 N, y = L^-1 n
#pragma GCC unroll 6
    for (int r = 0; r < 6; ++r) {
      Real yr = n[r];
#pragma GCC unroll 6
      for (int k = 0; k < r; ++k) yr -= j.l[r][k] * j.y[k];
      j.y[r] = yr;
#pragma GCC unroll 6
      for (int c = 0; c < 6; ++c) {
        Real t = full[r][c];
#pragma GCC unroll 6
        for (int k = 0; k < r; ++k) t -= j.l[r][k] * j.z[k][c];
        j.z[r][c] = t;
      }
    }
    // A = N - Z^T D^-1 Z,  a = n - Z^T D^-1 y - A c
    Real scaled[6][6];
#pragma GCC unroll 6
    for (int k = 0; k < 6; ++k)
#pragma GCC unroll 6
      for (int c = 0; c < 6; ++c) scaled[k][c] = j.z[k][c] * j.inverse_d[k];
    Real reduced[6][6];
#pragma GCC unroll 6
    for (int r = 0; r < 6; ++r)
#pragma GCC unroll 6
      for (int c = 0; c <= r; ++c) {
        Real t = full[r][c];
#pragma GCC unroll 6
        for (int k = 0; k < 6; ++k) t -= j.z[k][r] * scaled[k][c];
        reduced[r][c] = t;
      }
    const Real rhs[6] = {j.linear.x, j.linear.y, j.linear.z, j.angular.x, j.angular.y, j.angular.z};
    Real carry[6];
#pragma GCC unroll 6
    for (int r = 0; r < 6; ++r) {
      Real t = n[r];
#pragma GCC unroll 6
      for (int k = 0; k < 6; ++k) t -= scaled[k][r] * j.y[k];
#pragma GCC unroll 6
      for (int c = 0; c < 6; ++c) t -= (r >= c ? reduced[r][c] : reduced[c][r]) * rhs[c];
      carry[r] = t;
    }
    // onto the parent: T^T A T with T = [1 -[r]x; 0 1]
    Spatial up;
#pragma GCC unroll 3
    for (int r = 0; r < 3; ++r)
#pragma GCC unroll 3
      for (int c = 0; c < 3; ++c) {
        up.a[r][c] = r >= c ? reduced[r][c] : reduced[c][r];
        up.b[r][c] = reduced[3 + r][c];
        if (r >= c) up.c[r][c] = reduced[3 + r][3 + c];
      }
    const Vec back = {-j.parent_arm.x, -j.parent_arm.y, -j.parent_arm.z};
    shift(up, back);
    Spatial& parent = w.total[p];
#pragma GCC unroll 3
    for (int r = 0; r < 3; ++r)
#pragma GCC unroll 3
      for (int c = 0; c < 3; ++c) {
        if (r >= c) parent.a[r][c] += up.a[r][c], parent.c[r][c] += up.c[r][c];
        parent.b[r][c] += up.b[r][c];
      }
    // A row at its bound acts on the parent as -held.
    Real* pg = w.load[p];
    pg[0] += carry[0];
    pg[1] += carry[1];
    pg[2] += carry[2];
    pg[3] += carry[3] + (j.parent_arm.y * carry[2] - j.parent_arm.z * carry[1]) - held * j.axis.x;
    pg[4] += carry[4] + (j.parent_arm.z * carry[0] - j.parent_arm.x * carry[2]) - held * j.axis.y;
    pg[5] += carry[5] + (j.parent_arm.x * carry[1] - j.parent_arm.y * carry[0]) - held * j.axis.z;
  }
  {
    Spatial& m = w.total[0];
    Real x[6][6], l[6][6], inverse_d[6], t[6];
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        if (r >= c) x[r][c] = m.a[r][c], x[3 + r][3 + c] = m.c[r][c];
        x[3 + r][c] = m.b[r][c];
      }
    factor(x, l, inverse_d);
    for (int r = 0; r < 6; ++r) {
      t[r] = w.load[0][r];
      for (int k = 0; k < r; ++k) t[r] -= l[r][k] * t[k];
    }
    for (int r = 5; r >= 0; --r) {
      t[r] *= inverse_d[r];
      for (int k = r + 1; k < 6; ++k) t[r] -= l[k][r] * t[k];
      w.result[0][r] = t[r];
    }
  }
  for (int i = 1; i < bodies; ++i) {
    Joint& j = w.joint[i];
    const Real* v = w.result[model.bodies[i].parent];
    const Vec r = j.parent_arm;
    const Real s[6] = {v[0] + (v[4] * r.z - v[5] * r.y) + j.linear.x,
                       v[1] + (v[5] * r.x - v[3] * r.z) + j.linear.y,
                       v[2] + (v[3] * r.y - v[4] * r.x) + j.linear.z,
                       v[3] + j.angular.x,
                       v[4] + j.angular.y,
                       v[5] + j.angular.z};
    Real d[6];
#pragma GCC unroll 6
    for (int k = 0; k < 6; ++k) {
      Real t = -j.y[k];
#pragma GCC unroll 6
      for (int c = 0; c < 6; ++c) t += j.z[k][c] * s[c];
      d[k] = t * j.inverse_d[k];
    }
#pragma GCC unroll 6
    for (int k = 5; k >= 0; --k)
#pragma GCC unroll 6
      for (int c = k + 1; c < 6; ++c) d[k] -= j.l[c][k] * d[c];
    j.slip = j.axis.x * d[3] + j.axis.y * d[4] + j.axis.z * d[5];
    Real* out = w.result[i];
    const Real wx = s[3] - d[3], wy = s[4] - d[4], wz = s[5] - d[5];
    out[0] = (s[0] - d[0]) + (j.arm.y * wz - j.arm.z * wy);
    out[1] = (s[1] - d[1]) + (j.arm.z * wx - j.arm.x * wz);
    out[2] = (s[2] - d[2]) + (j.arm.x * wy - j.arm.y * wx);
    out[3] = wx;
    out[4] = wy;
    out[5] = wz;
  }
  for (int n = 0; n < w.contacts; ++n) {
    const Contact& contact = w.contact[n];
    const Real* v = w.result[contact.body];
    for (int k = 0; k < contact.points; ++k)
      w.normal[n][k] = contact.target[k] - (v[2] + (v[3] * contact.arm[k][1] - v[4] * contact.arm[k][0]));
  }
}

// Residuals c - J v of the bounded rows, and the velocities they belong to: a point of the search below.
struct Point {
  Real joint[kMaxBodies];
  Real contact[kMaxColliders][4];
  Real velocity[kMaxBodies][6];
};

// Curvature d^T H d of the active quadratic along d = to - from.
Real curvature(const Model& model, const Workspace& w, const Point& from, const Point& to) {
  Real d[kMaxBodies][6];
  Real sum = splat(0.0);
  for (int i = 0; i < model.body_count(); ++i) {
    for (int c = 0; c < 6; ++c) d[i][c] = to.velocity[i][c] - from.velocity[i][c];
    const Real(*m)[3] = w.inertia[i].c;
    const Vec v = load(d[i]), s = load(d[i] + 3);
    sum += model.bodies[i].mass * dot(v, v) + m[0][0] * s.x * s.x + m[1][1] * s.y * s.y + m[2][2] * s.z * s.z +
           2.0 * (m[1][0] * s.x * s.y + m[2][0] * s.x * s.z + m[2][1] * s.y * s.z);
    if (i == 0) continue;
    const Joint& j = w.joint[i];
    const Real* p = d[model.bodies[i].parent];
    const Vec slide = (v + cross(s, j.arm)) - (load(p) + cross(load(p + 3), j.parent_arm));
    const Vec turn = s - load(p + 3);
    const Real about = dot(turn, j.axis);
    const Real change = to.joint[i] - from.joint[i];
    sum += kHingeStiffness * (dot(slide, slide) + dot(turn, turn) - about * about);
    sum += j.side == 0.0 ? kMotorStiffness * change * change : splat(0.0);
  }
  for (int n = 0; n < w.contacts; ++n) {
    const Contact& contact = w.contact[n];
    const Real* v = d[contact.body];
    for (int k = 0; k < contact.points; ++k) {
      const Vec slip = load(v) + cross(load(v + 3), load(contact.arm[k]));
      const Real change = to.contact[n][k] - from.contact[n][k];
      sum += contact.exists[k] ? kSlipStiffness * (slip.x * slip.x + slip.y * slip.y) : splat(0.0);
      sum += contact.active[k] ? kNormalStiffness * change * change : splat(0.0);
    }
  }
  return sum;
}

// A bounded row that meets one of its bounds between two points: its impulse is k times its residual, within [low, high].
struct Bend {
  Real gap, change, stiffness, low, high;
  Real inside;  // 1 where the active quadratic counts the row as free
  Real at[2];   // where along the line it meets its bounds
};

// The exact minimum of the true function on the line from `from` (t = 0) to `to` (t = 1), at most 1.
// Its derivative rises piecewise linearly: that of the active quadratic, corrected by every row that meets a bound.
// Lanes not in `motors` keep their joint rows as they are.
Real search_line(const Model& model, const Workspace& w, const Point& from, const Point& to, Mask lanes, Mask motors) {
  Bend bends[kMaxBodies + 4 * kMaxColliders];
  int count = 0;
  const auto consider = [&](Real gap, Real end, double stiffness, Real low, Real high, Mask inside, Mask counts) {
    const Real p0 = stiffness * gap, p1 = stiffness * end;
    const Mask straight = ((p0 <= low) & (p1 <= low)) | ((p0 >= high) & (p1 >= high)) | ((p0 >= low) & (p0 <= high) & (p1 >= low) & (p1 <= high));
    const Mask bent = lanes & counts & ~straight;
    if (!any(bent)) return;
    const Real change = end - gap;
    const Real none = splat(2.0);
    Bend& b = bends[count++];
    b = {gap, change, bent ? splat(stiffness) : splat(0.0), low, high, inside ? splat(1.0) : splat(0.0), {}};
    b.at[0] = bent ? (low / stiffness - gap) / change : none;
    b.at[1] = bent ? (high / stiffness - gap) / change : none;
  };
  for (int i = 1; i < model.body_count(); ++i) {
    const Joint& j = w.joint[i];
    consider(from.joint[i], to.joint[i], kMotorStiffness, j.low, j.high, j.side == 0.0, motors);
  }
  for (int n = 0; n < w.contacts; ++n)
    for (int k = 0; k < w.contact[n].points; ++k)
      consider(from.contact[n][k], to.contact[n][k], kNormalStiffness, splat(0.0), splat(std::numeric_limits<double>::infinity()),
               w.contact[n].active[k], w.contact[n].exists[k]);
  if (count == 0) return splat(1.0);
  const Real curve = curvature(model, w, from, to);
  const auto slope = [&](Real t) {
    Real sum = curve * (t - 1.0);
    for (int r = 0; r < count; ++r) {
      const Bend& b = bends[r];
      const Real p0 = b.stiffness * b.gap, move = b.stiffness * b.change * t;
      sum += b.change * (min(max(p0 + move, b.low), b.high) - min(max(p0, b.low), b.high) - b.inside * move);
    }
    return sum;
  };
  Real low = splat(0.0), high = splat(1.0), slope_low = -curve, slope_high = slope(high);
  Mask open = lanes & (slope_high > 0.0);
  for (int trial = 0; trial < 2 * count + 1 && any(open); ++trial) {
    const Real guess = low - slope_low * ((high - low) / (slope_high - slope_low));
    Real nearest = guess, distance = splat(3.0);
    Mask bent = Mask{};
    for (int r = 0; r < count; ++r)
      for (const Real at : bends[r].at) {
        const Mask better = (at > low) & (at < high) & (abs(at - guess) < distance);
        nearest = better ? at : nearest;
        distance = better ? abs(at - guess) : distance;
        bent |= better;
      }
    // without a bound in between the derivative is a straight line: the guess is its root
    high = open & ~bent ? guess : high;
    open &= bent;
    const Real value = slope(nearest);
    const Mask below = open & (value <= 0.0), above = open & ~below;
    low = below ? nearest : low;
    slope_low = below ? value : slope_low;
    high = above ? nearest : high;
    slope_high = above ? value : slope_high;
  }
  return high;
}

// Settle the active set. Eliminating the impulses turns the step into the minimum of a strictly convex, piecewise quadratic function
// of the velocities; a solve with a fixed set is a Newton step on it, and with a line search such steps reach the minimum in finitely many.
// A set is accepted only if every row satisfies its complementarity condition. Should rounding ever make the search stall, single exchanges
// of the first violated row take over, which end for certain because the problem has a unique solution (Murty's least-index rule, a P-matrix).
unsigned settle(const Model& model, Workspace& w, Mask awake, Statistics& statistics) {
  const int bodies = model.body_count();
  static thread_local Point now, next;
  Mask open = awake;
  // A wrong set of contacts overloads many motors, so contacts settle first, with the motors as they were.
  Mask motors = Mask{};
  for (int round = 0; round < kMaximumRounds; ++round) {
    solve(model, w);
    ++statistics.solves;
    Mask wrong = Mask{}, violated[kMaxBodies], violated_contact[kMaxColliders][4];
    for (int i = 1; i < bodies; ++i) {
      const Joint& j = w.joint[i];
      next.joint[i] = j.slip;
      const Real impulse = kMotorStiffness * j.slip;
      const Real held = j.side > 0.0 ? j.high : j.low;
      const Real rate = (kMotorCfm * kRate) * held - j.slip;  // J v + D u - c of a row at its bound
      violated[i] = open & (((j.side == 0.0) & ((impulse > j.high + kImpulseTolerance) | (impulse < j.low - kImpulseTolerance))) |
                            ((j.side > 0.0) & (rate > kVelocityTolerance)) | ((j.side < 0.0) & (rate < -kVelocityTolerance)));
      wrong |= violated[i];
    }
    for (int n = 0; n < w.contacts; ++n) {
      const Contact& contact = w.contact[n];
      for (int k = 0; k < contact.points; ++k) {
        const Real gap = next.contact[n][k] = w.normal[n][k];
        violated_contact[n][k] = open & contact.exists[k] & (contact.active[k] ? gap < -kVelocityTolerance : gap > kVelocityTolerance);
      }
    }
    Mask wrong_contact = Mask{};
    for (int n = 0; n < w.contacts; ++n)
      for (int k = 0; k < w.contact[n].points; ++k) wrong_contact |= violated_contact[n][k];
    open &= wrong | wrong_contact;
    if (!any(open)) return 0;
    if (round >= kNewtonRounds) {
      ++statistics.fallback;
      Mask allowed = open;
      for (int i = 1; i < bodies; ++i) {
        Joint& j = w.joint[i];
        const Mask change = violated[i] & allowed;
        const Real to = j.side != 0.0 ? splat(0.0) : (kMotorStiffness * j.slip > j.high ? splat(1.0) : splat(-1.0));
        j.side = change ? to : j.side;
        allowed &= ~change;
      }
      for (int n = 0; n < w.contacts; ++n)
        for (int k = 0; k < w.contact[n].points; ++k) {
          const Mask change = violated_contact[n][k] & allowed;
          w.contact[n].active[k] ^= change;
          allowed &= ~change;
        }
      continue;
    }
    for (int i = 0; i < bodies; ++i)
      for (int c = 0; c < 6; ++c) next.velocity[i][c] = w.result[i][c];
    Real t = splat(1.0);
    if (round > 0) t = search_line(model, w, now, next, open, motors);
    const Mask begins = open & ~motors & ~wrong_contact;  // with this point; its contacts have settled
    t = begins ? splat(1.0) : t;
    motors |= begins;
    const Mask whole = t == 1.0;
    for (int i = 0; i < bodies; ++i)
      for (int c = 0; c < 6; ++c)
        now.velocity[i][c] = whole ? next.velocity[i][c] : now.velocity[i][c] + t * (next.velocity[i][c] - now.velocity[i][c]);
    for (int i = 1; i < bodies; ++i) {
      Joint& j = w.joint[i];
      now.joint[i] = whole ? next.joint[i] : now.joint[i] + t * (next.joint[i] - now.joint[i]);
      const Real impulse = kMotorStiffness * now.joint[i];
      j.side = open & motors ? (impulse > j.high ? splat(1.0) : (impulse < j.low ? splat(-1.0) : splat(0.0))) : j.side;
    }
    for (int n = 0; n < w.contacts; ++n) {
      Contact& contact = w.contact[n];
      for (int k = 0; k < contact.points; ++k) {
        Real& gap = now.contact[n][k];
        gap = whole ? next.contact[n][k] : gap + t * (next.contact[n][k] - gap);
        contact.active[k] = open ? contact.exists[k] & (gap > 0.0) : contact.active[k];
      }
    }
  }
  return bits(open);
}

void integrate(const Model& model, Group& g, const Workspace& w, Mask awake) {
  for (int i = 0; i < model.body_count(); ++i) {
    const Real* v = w.result[i];
    Real q[4];
    const Real* o = g.quaternion[i];
    const Real k = splat(0.5 * kStep);
    q[0] = o[0] + k * (-v[3] * o[1] - v[4] * o[2] - v[5] * o[3]);
    q[1] = o[1] + k * (v[3] * o[0] + v[4] * o[3] - v[5] * o[2]);
    q[2] = o[2] + k * (-v[3] * o[3] + v[4] * o[0] + v[5] * o[1]);
    q[3] = o[3] + k * (v[3] * o[2] - v[4] * o[1] + v[5] * o[0]);
    const Real scale = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int c = 0; c < 4; ++c) g.quaternion[i][c] = awake ? q[c] * scale : o[c];
    for (int c = 0; c < 3; ++c) {
      g.position[i][c] = awake ? g.position[i][c] + kStep * v[c] : g.position[i][c];
      g.velocity[i][c] = awake ? v[c] : g.velocity[i][c];
      g.spin[i][c] = awake ? v[3 + c] : g.spin[i][c];
      g.force[i][c] = awake ? splat(0.0) : g.force[i][c];
      g.torque[i][c] = awake ? splat(0.0) : g.torque[i][c];
    }
    g.enabled[i] |= awake;
    if (i > 0) g.row_side[i] = awake ? w.joint[i].side : g.row_side[i];
  }
  for (Mask& lifted : g.lifted) lifted = awake ? Mask{} : lifted;
  for (int n = 0; n < w.contacts; ++n) {
    const Contact& contact = w.contact[n];
    for (int k = 0; k < contact.points; ++k)
      g.lifted[contact.collider] |= awake & contact.exists[k] & ~contact.active[k] ? (Mask{} + 1) << contact.corner[k] : Mask{};
  }
}

void measure_angles(const Model& model, Group& g, Mask lanes) {
  for (int i = 1; i < model.body_count(); ++i) {
    const Body& body = model.bodies[i];
    const Real angle = hinge_angle(g.quaternion[i], g.quaternion[body.parent], body.axis);
    g.angle[i] = lanes ? angle : g.angle[i];
    Real& out = g.perceptors.joint_angle[body.joint];
    out = lanes ? angle * kDegrees : out;
  }
}

void measure_gyro(Group& g, Mask lanes) {
  const Vec rate = kDegrees * inverse_rotate(rotation(g.quaternion[0]), load(g.spin[0]));
  store(g.perceptors.gyro, select(lanes, rate, load(g.perceptors.gyro)));
}

// Force resistance perceptors: this step's contact forces, in the foot's frame after the step. A sleeping robot keeps the last.
void measure_touch(const Model& model, Group& g, const Workspace& w, Mask awake) {
  for (int sensor = 0; sensor < kTouchSensors; ++sensor) {
    const int body = model.touch_body[sensor];
    if (body < 0) continue;
    Vec force = {splat(0.0), splat(0.0), splat(0.0)}, moment = force;
    Real weight = splat(0.0);
    for (int n = 0; n < w.contacts; ++n) {
      const Contact& contact = w.contact[n];
      if (contact.body != body) continue;
      const Real* v = w.result[body];
      // The contact points lie in the pose before the step; arms are relative to that centre.
      const Vec before = load(g.position[body]) - kStep * Vec{v[0], v[1], v[2]};
      for (int k = 0; k < contact.points; ++k) {
        const Vec arm = load(contact.arm[k]);
        const Vec slip = Vec{v[0], v[1], v[2]} + cross(Vec{v[3], v[4], v[5]}, arm);
        const Real up = contact.active[k] ? kNormalStiffness * w.normal[n][k] : splat(0.0);
        const Vec f = kRate * Vec{-kSlipStiffness * slip.x, -kSlipStiffness * slip.y, up};
        const Vec at = before + arm;
        const Real size = sqrt(dot(f, f));
        const Mask exists = contact.exists[k];
        force = select(exists, force + f, force);
        moment = select(exists, moment + size * at, moment);
        weight = exists ? weight + size : weight;
      }
    }
    const Mask touched = weight > 0.0;
    const Rot r = rotation(g.quaternion[body]);
    const Vec point = inverse_rotate(r, (1.0 / weight) * moment - load(g.position[body]));
    const Vec local = inverse_rotate(r, force);
    const Real none = splat(std::numeric_limits<double>::quiet_NaN());
    const Real value[6] = {point.x, point.y, point.z, local.x, local.y, local.z};
    for (int c = 0; c < 6; ++c) {
      Real& out = g.perceptors.touch[sensor][c];
      out = awake ? (touched ? value[c] : none) : out;
    }
  }
}

// Separating-axis test of the self-collision rule: true where the boxes overlap by more than the tolerance on all 15 axes.
// Cross products are not normalised, as in the server, so boxes with two nearly parallel axes count as apart.
Mask overlap(const Body& a, const Body& b, Vec gap, const Rot& ra, const Rot& rb, Mask lanes) {
  const double reach_a = std::sqrt(a.half[0] * a.half[0] + a.half[1] * a.half[1] + a.half[2] * a.half[2]);
  const double reach_b = std::sqrt(b.half[0] * b.half[0] + b.half[1] * b.half[1] + b.half[2] * b.half[2]);
  const double reach = reach_a + reach_b;
  Mask hit = lanes & (dot(gap, gap) < reach * reach);
  if (!any(hit)) return hit;
  const Vec axes[6] = {ra.column(0), ra.column(1), ra.column(2), rb.column(0), rb.column(1), rb.column(2)};
  const double half[6] = {a.half[0], a.half[1], a.half[2], b.half[0], b.half[1], b.half[2]};
  const auto test = [&](Vec axis) {
    Real sum = half[0] * abs(dot(axes[0], axis));
    for (int k = 1; k < 6; ++k) sum += half[k] * abs(dot(axes[k], axis));
    hit &= ~(abs(dot(gap, axis)) + kCollisionTolerance > sum);
    return any(hit);
  };
  for (int k = 0; k < 6; ++k)
    if (!test(axes[k])) return hit;
  for (int p = 0; p < 3; ++p)
    for (int q = 3; q < 6; ++q)
      if (!test(cross(axes[p], axes[q]))) return hit;
  return hit;
}

// Overlapping limbs freeze their effectors for one second and are then immune for two more. The clock adds up 0.02 s in single
// precision, so a freeze lasts 50 or 51 cycles, depending on when it starts, as on the server.
void apply_self_collision_rule(const Model& model, Group& g, Mask lanes) {
  Rot rot[kMaxBodies];
  Vec centre[kMaxBodies];
  for (int i = 0; i < model.body_count(); ++i)
    if (model.bodies[i].shape == Shape::kBox) rot[i] = rotation(g.quaternion[i]), centre[i] = load(g.position[i]);
  for (const auto& [i, k] : model.collision_pairs) {
    const Body &a = model.bodies[i], &b = model.bodies[k];
    const Mask hit = overlap(a, b, centre[k] - centre[i], rot[i], rot[k], lanes);
    if (!any(hit)) continue;
    for (const int limb : {a.limb, b.limb}) {
      if (limb < 0) continue;
      const Mask starts = hit & (to_single(g.game_time - g.frozen_at[limb]) > kFrozenTime + kThawTime);
      g.frozen_at[limb] = starts ? g.game_time : g.frozen_at[limb];
      g.frozen[limb] |= starts;
    }
  }
  for (int limb = 0; limb < kLimbs; ++limb) {
    const Real since = to_single(g.game_time - g.frozen_at[limb]);
    g.frozen[limb] &= ~(lanes & (since >= kFrozenTime));
    g.frozen_at[limb] = lanes & (since >= kFrozenTime + kThawTime) ? splat(kNeverFrozen) : g.frozen_at[limb];
  }
}

// Hinge effectors: a command holds until the next one and is ignored while the joint is outside its stops.
void command_motors(const Model& model, Group& g, const Real* command, Mask lanes) {
  for (int i = 1; i < model.body_count(); ++i) {
    const Body& body = model.bodies[i];
    const Real asked = to_single(command[body.joint]);
    Real speed = min(max(asked, splat(-body.max_speed)), splat(body.max_speed));
    if (body.limb >= 0) speed = g.frozen[body.limb] ? splat(0.0) : speed;
    const Mask inside = (g.angle[i] < body.high) & (g.angle[i] > body.low);
    g.motor_speed[i] = lanes & inside ? speed : g.motor_speed[i];
    const Mask wakes = lanes & (asked != 0.0) & ~g.enabled[i];
    g.enabled[i] |= wakes;
    g.idle_left[i] = wakes ? splat(kIdleSteps) : g.idle_left[i];
  }
}

// ODE's auto-disable: a body quiet for ten steps stops; the robot sleeps once all its bodies do. Returns who is awake.
Mask fall_asleep(const Model& model, Group& g, Mask lanes) {
  Mask awake = Mask{};
  for (int i = 0; i < model.body_count(); ++i) {
    const Mask considered = lanes & g.enabled[i];
    const Vec v = load(g.velocity[i]), s = load(g.spin[i]);
    const Mask idle = ~((dot(v, v) > kIdleLinear) | (dot(s, s) > kIdleAngular));
    g.idle_left[i] = considered ? (idle ? g.idle_left[i] - 1.0 : splat(kIdleSteps)) : g.idle_left[i];
    const Mask sleeps = considered & (g.idle_left[i] <= 0.0);
    g.enabled[i] &= ~sleeps;
    const Vec zero = {splat(0.0), splat(0.0), splat(0.0)};
    store(g.velocity[i], select(sleeps, zero, v));
    store(g.spin[i], select(sleeps, zero, s));
    awake |= lanes & g.enabled[i];
  }
  return awake;
}

void add_drag(const Model& model, Group& g, Mask lanes) {
  for (int i = 0; i < model.body_count(); ++i)
    for (int c = 0; c < 3; ++c) {
      g.force[i][c] = lanes ? g.force[i][c] + to_single(kDrag * to_single(g.velocity[i][c])) : g.force[i][c];
      g.torque[i][c] = lanes ? g.torque[i][c] + to_single(kDrag * to_single(g.spin[i][c])) : g.torque[i][c];
    }
}

// The accelerometer samples before the step, so its value is one cycle older than the other perceptors'.
void sample_accelerometer(Group& g, Mask lanes) {
  const Vec v = load(g.velocity[0]), previous = load(g.previous_velocity);
  const Vec proper = kRate * (v - previous) - Vec{splat(0.0), splat(0.0), splat(kGravity)};
  const Vec local = inverse_rotate(rotation(g.quaternion[0]), proper);
  store(g.perceptors.accel, select(lanes, local, load(g.perceptors.accel)));
  store(g.previous_velocity, select(lanes, v, previous));
}

void deliver(Group& g, Mask lanes) {
  const Real* from = reinterpret_cast<const Real*>(&g.perceptors);
  Real* to = reinterpret_cast<Real*>(&g.sent_perceptors);
  for (std::size_t k = 0; k < sizeof(Perceptors) / sizeof(Real); ++k) to[k] = lanes ? from[k] : to[k];
}

unsigned step(const Model& model, void* group, const double* speeds, unsigned lane_bits, bool self_collision, Statistics& statistics) {
  Group& g = *static_cast<Group*>(group);
  const Real* command = reinterpret_cast<const Real*>(speeds);
  const Mask lanes = from_bits(lane_bits);
  ++statistics.steps;
  deliver(g, lanes);
  command_motors(model, g, command, lanes);
  add_drag(model, g, lanes);
  sample_accelerometer(g, lanes);
  const Mask awake = fall_asleep(model, g, lanes);
  unsigned failed = 0;
  if (any(awake)) {
    static thread_local Workspace w;
    prepare(model, g, w, awake);
    failed = settle(model, w, awake, statistics);
    integrate(model, g, w, awake);
    measure_angles(model, g, awake);
    measure_gyro(g, awake);
    measure_touch(model, g, w, awake);
  }
  // zero velocities of a robot that has just fallen asleep
  measure_gyro(g, lanes & ~awake);
  g.cycle = lanes ? g.cycle + 1.0 : g.cycle;
  g.game_time = lanes ? to_single(g.game_time + kStep) : g.game_time;
  g.perceptors.time = lanes ? g.cycle * 0.02 : g.perceptors.time;
  if (self_collision) apply_self_collision_rule(model, g, lanes);
  return failed;
}

void refresh(const Model& model, void* group, unsigned lane_bits) {
  Group& g = *static_cast<Group*>(group);
  const Mask lanes = from_bits(lane_bits);
  measure_angles(model, g, lanes);
  measure_gyro(g, lanes);
}

}  // namespace

#define NAOSIM_STRING_(x) #x
#define NAOSIM_STRING(x) NAOSIM_STRING_(x)
extern const Kernel kernel;
const Kernel kernel = {NAOSIM_STRING(NAOSIM_ISA), kLanes, step, refresh};

}  // namespace naosim::NAOSIM_ISA
