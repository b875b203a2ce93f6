// One vector register holds the same quantity of several environments ("lanes"): eight, four or two, depending on the
// processor. Everything is lane-wise: no operation mixes lanes, so a lane's result never depends on its neighbours.
#pragma once
#include <cmath>
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

// Compiled once per instruction set; an inner namespace keeps the linker from mixing the copies.
#ifndef NAOSIM_ISA
#define NAOSIM_ISA generic
#endif
namespace naosim::NAOSIM_ISA {

#if defined(__AVX512F__) && defined(__AVX512DQ__)
constexpr int kLanes = 8;
#elif defined(__AVX2__)
constexpr int kLanes = 4;
#else
constexpr int kLanes = 2;
#endif
typedef double Real __attribute__((vector_size(8 * kLanes)));
typedef std::int64_t Mask __attribute__((vector_size(8 * kLanes)));  // -1 = true, 0 = false

inline Real splat(double x) { return Real{} + x; }

inline unsigned bits(Mask m) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  return _mm512_movepi64_mask(reinterpret_cast<__m512i>(m));
#elif defined(__AVX2__)
  return static_cast<unsigned>(_mm256_movemask_pd(reinterpret_cast<__m256d>(m)));
#elif defined(__x86_64__)
  return static_cast<unsigned>(_mm_movemask_pd(reinterpret_cast<__m128d>(m)));
#else
  unsigned r = 0;
  for (int l = 0; l < kLanes; ++l) r |= (m[l] != 0 ? 1u : 0u) << l;
  return r;
#endif
}
inline bool any(Mask m) { return bits(m) != 0; }
inline Mask from_bits(unsigned b) {
  Mask m;
  for (int l = 0; l < kLanes; ++l) m[l] = (b >> l & 1u) ? -1 : 0;
  return m;
}

inline Real select(Mask m, Real a, Real b) { return m ? a : b; }
inline Real abs(Real a) { return a < 0.0 ? -a : a; }
inline Real max(Real a, Real b) { return a > b ? a : b; }
inline Real min(Real a, Real b) { return a < b ? a : b; }
inline Real sqrt(Real a) {
#if defined(__AVX512F__) && defined(__AVX512DQ__)
  return reinterpret_cast<Real>(_mm512_maskz_sqrt_pd(0xff, reinterpret_cast<__m512d>(a)));
#elif defined(__AVX2__)
  return reinterpret_cast<Real>(_mm256_sqrt_pd(reinterpret_cast<__m256d>(a)));
#else
  Real r;
  for (int l = 0; l < kLanes; ++l) r[l] = __builtin_sqrt(a[l]);
  return r;
#endif
}
// The server hands numbers between its parts as single precision. (Converting lane by lane is not an option: GCC 12 drops the
// round trip when it vectorises it.)
inline Real to_single(Real a) {
  typedef float Single __attribute__((vector_size(4 * kLanes)));
  return __builtin_convertvector(__builtin_convertvector(a, Single), Real);
}

// atan2(s, c) for s >= 0 and (s, c) != (0, 0), result in [0, pi]; below 2 ulp.
// Argument reduction at tan(pi/8) and tan(3 pi/8), then a rational minimax approximation (S. L. Moshier, Cephes atan).
inline Real atan2_upper(Real s, Real c) {
  const Real a = abs(c);
  const Mask steep = s > 2.41421356237309504880 * a;
  const Mask middle = ~steep & (s > 0.66 * a);
  const Real num = select(steep, -a, select(middle, s - a, s));
  const Real den = select(steep, s, select(middle, s + a, a));
  const Real base = select(steep, splat(1.57079632679489661923), select(middle, splat(0.78539816339744830962), splat(0.0)));
  const Real tail = select(steep, splat(6.123233995736765886130e-17), select(middle, splat(3.0616169978683829430e-17), splat(0.0)));
  const Real x = num / den, z = x * x;
  const Real p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z -
                  1.228866684490136173410e2) * z - 6.485021904942025371773e1;
  const Real q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z +
                  4.853903996359136964868e2) * z + 1.945506571482613964425e2;
  const Real y = base + ((x * (z * p / q) + x) + tail);
  return c < 0.0 ? 3.14159265358979323846 - y : y;
}

struct Vec {
  Real x, y, z;
};
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(Real s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline Real dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Vec select(Mask m, Vec a, Vec b) { return {select(m, a.x, b.x), select(m, a.y, b.y), select(m, a.z, b.z)}; }
inline Vec to_single(Vec a) { return {to_single(a.x), to_single(a.y), to_single(a.z)}; }
inline Vec load(const Real* p) { return {p[0], p[1], p[2]}; }
inline void store(Real* p, Vec a) { p[0] = a.x, p[1] = a.y, p[2] = a.z; }

// Rotation matrix; column(k) is the k-th body axis in world coordinates.
struct Rot {
  Real m[3][3];
  Vec column(int k) const { return {m[0][k], m[1][k], m[2][k]}; }
};
inline Vec operator*(const Rot& r, Vec a) {
  return {r.m[0][0] * a.x + r.m[0][1] * a.y + r.m[0][2] * a.z, r.m[1][0] * a.x + r.m[1][1] * a.y + r.m[1][2] * a.z,
          r.m[2][0] * a.x + r.m[2][1] * a.y + r.m[2][2] * a.z};
}
inline Vec rotate(const Rot& r, const double a[3]) {
  return {r.m[0][0] * a[0] + r.m[0][1] * a[1] + r.m[0][2] * a[2], r.m[1][0] * a[0] + r.m[1][1] * a[1] + r.m[1][2] * a[2],
          r.m[2][0] * a[0] + r.m[2][1] * a[1] + r.m[2][2] * a[2]};
}
inline Vec inverse_rotate(const Rot& r, Vec a) {
  return {r.m[0][0] * a.x + r.m[1][0] * a.y + r.m[2][0] * a.z, r.m[0][1] * a.x + r.m[1][1] * a.y + r.m[2][1] * a.z,
          r.m[0][2] * a.x + r.m[1][2] * a.y + r.m[2][2] * a.z};
}
inline Rot rotation(const Real q[4]) {  // unit quaternion, w x y z
  const Real xx = 2.0 * q[1] * q[1], yy = 2.0 * q[2] * q[2], zz = 2.0 * q[3] * q[3];
  const Real xy = q[1] * q[2], xz = q[1] * q[3], yz = q[2] * q[3], wx = q[0] * q[1], wy = q[0] * q[2], wz = q[0] * q[3];
  return {{{1.0 - yy - zz, 2.0 * (xy - wz), 2.0 * (xz + wy)},
           {2.0 * (xy + wz), 1.0 - xx - zz, 2.0 * (yz - wx)},
           {2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - xx - yy}}};
}

}  // namespace naosim::NAOSIM_ISA
