// Vectors, rotations and scalar functions of the estimator's extension. Hyperbolic functions, logarithm and arc tangent
// are made of the four operations and roots, for the same bits everywhere.
#pragma once
#include <algorithm>
#include <cmath>

namespace avs {

constexpr double LEAST_GAP = 1e-4;
constexpr int NEXT[3] = {1, 2, 0}, LAST[3] = {2, 0, 1};

struct V3 {
  double x[3];
};
struct M3 {
  double x[3][3];
};

inline V3 vector(const double* v) { return {{v[0], v[1], v[2]}}; }
inline V3 operator+(const V3& a, const V3& b) { return {{a.x[0] + b.x[0], a.x[1] + b.x[1], a.x[2] + b.x[2]}}; }
inline V3 operator-(const V3& a, const V3& b) { return {{a.x[0] - b.x[0], a.x[1] - b.x[1], a.x[2] - b.x[2]}}; }
inline V3 operator*(double f, const V3& a) { return {{f * a.x[0], f * a.x[1], f * a.x[2]}}; }

inline V3 cross(const V3& a, const V3& b) {
  V3 out;
  for (int r = 0; r < 3; ++r) out.x[r] = a.x[NEXT[r]] * b.x[LAST[r]] - a.x[LAST[r]] * b.x[NEXT[r]];
  return out;
}

inline V3 operator*(const M3& A, const V3& v) {
  V3 out;
  for (int r = 0; r < 3; ++r) out.x[r] = A.x[r][0] * v.x[0] + A.x[r][1] * v.x[1] + A.x[r][2] * v.x[2];
  return out;
}

inline M3 transposed(const M3& A) {
  M3 out;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) out.x[r][c] = A.x[c][r];
  return out;
}

// A M A'.
inline M3 seen_by(const M3& A, const M3& M) {
  M3 out;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      out.x[r][c] = 0;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out.x[r][c] += A.x[r][i] * M.x[i][j] * A.x[c][j];
    }
  return out;
}

struct Quad {
  double x, y, z, w;
};

inline Quad operator*(const Quad& a, const Quad& b) {
  return {a.w * b.x + b.w * a.x + (a.y * b.z - a.z * b.y), a.w * b.y + b.w * a.y + (a.z * b.x - a.x * b.z),
          a.w * b.z + b.w * a.z + (a.x * b.y - a.y * b.x), a.w * b.w - (a.x * b.x + a.y * b.y + a.z * b.z)};
}

inline Quad conjugate(const Quad& q) { return {-q.x, -q.y, -q.z, q.w}; }

inline Quad scaled(const Quad& q, double f) { return {f * q.x, f * q.y, f * q.z, f * q.w}; }

inline Quad unit(const Quad& q) { return scaled(q, 1 / std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)); }

inline Quad quad(const double* q) { return {q[0], q[1], q[2], q[3]}; }

inline M3 matrix(const Quad& q) {
  return {{{1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)},
           {2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z - q.x * q.w)},
           {2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x * q.x + q.y * q.y)}}};
}

// The turn whose vector part is v; beyond a half turn the nearest one, a half turn.
inline Quad half_angle(const V3& v) {
  const double n2 = v.x[0] * v.x[0] + v.x[1] * v.x[1] + v.x[2] * v.x[2];
  if (n2 < 1) return {v.x[0], v.x[1], v.x[2], std::sqrt(1 - n2)};
  const double n = std::sqrt(n2);
  return {v.x[0] / n, v.x[1] / n, v.x[2] / n, 0};
}

// tanh(2x) = 2t / (1 + t^2), down to where six fractions do.
inline double tanh_of(double x) {
  if (std::fabs(x) > 20) return std::copysign(1.0, x);
  int doublings = 0;
  for (; std::fabs(x) > 0.25; x /= 2) ++doublings;
  const double s = x * x;
  double t = x / (1 + s / (3 + s / (5 + s / (7 + s / (9 + s / 11)))));
  for (; doublings > 0; --doublings) t = 2 * t / (1 + t * t);
  return t;
}

inline double atanh_of(double t) {
  double f = 1, s = 1.0 / 17;
  for (int k = 0; k < 64 && std::fabs(t) > 0.125; ++k, f *= 2) t /= 1 + std::sqrt((1 - t) * (1 + t));
  for (int k = 15; k > 0; k -= 2) s = s * t * t + 1.0 / k;
  return f * t * s;
}

// Indices of n values, ascending; what is not a number stays where it is.
template <int N>
void order(const double* values, int* by) {
  for (int i = 0; i < N; ++i) {
    by[i] = i;
    for (int j = i; j > 0 && values[by[j]] < values[by[j - 1]]; --j) std::swap(by[j], by[j - 1]);
  }
}

// Largest norm of M: mass moments that differ by a factor of exp(17). Beyond it sigma is 1 within rounding.
constexpr double LARGEST_M = 12;

inline void shorten(M3& M) {
  double square = 0;
  for (const auto& row : M.x)
    for (const double value : row) square += value * value;
  if (square > LARGEST_M * LARGEST_M)
    for (auto& row : M.x)
      for (double& value : row) value *= LARGEST_M / std::sqrt(square);
}

// The ratios of a body and their derivatives with respect to half the differences of the eigenvalues of M. A difference of
// successive eigenvalues below LEAST_GAP is replaced by LEAST_GAP.
struct Axes {
  double m[3], sigma[2], slope[2];
};

inline Axes axes(const double* values) {
  Axes a;
  std::copy(values, values + 3, a.m);
  int by[3];
  order<3>(values, by);
  for (int k = 1; k < 3; ++k) a.m[by[k]] = std::max(a.m[by[k]], a.m[by[k - 1]] + LEAST_GAP);
  const double half[2] = {0.5 * (a.m[2] - a.m[1]), 0.5 * (a.m[0] - a.m[2])};
  for (int k = 0; k < 2; ++k) {
    a.sigma[k] = tanh_of(half[k]);
    a.slope[k] = 0.5 * (1 - a.sigma[k]) * (1 + a.sigma[k]);
  }
  return a;
}

// The name among 24 (the turns that take axes to axes) next to p, as a quaternion: its largest part alone, its two
// largest alike, or all four alike.
inline Quad nearest_name(const Quad& p) {
  const double part[4] = {p.x, p.y, p.z, p.w};
  const double less[4] = {-std::fabs(p.x), -std::fabs(p.y), -std::fabs(p.z), -std::fabs(p.w)};
  int by[4];
  order<4>(less, by);
  const double one = -less[by[0]], pair = -(less[by[0]] + less[by[1]]) * std::sqrt(0.5);
  const double all = -0.5 * (less[0] + less[1] + less[2] + less[3]);
  const int alike = all > std::max(one, pair) ? 4 : pair > one ? 2 : 1;
  double n[4] = {0, 0, 0, 0};
  for (int k = 0; k < alike; ++k) n[by[k]] = std::copysign(1 / std::sqrt((double)alike), part[by[k]]);
  return quad(n);
}

// Jacobi's turn that takes entry (i, j) = (NEXT[k], LAST[k]) of a symmetric A to zero.
inline Quad jacobi(const M3& A, int k) {
  const int i = NEXT[k], j = LAST[k];
  const double ratio = (A.x[j][j] - A.x[i][i]) / (2 * A.x[i][j]);
  const double tan = std::copysign(1 / (std::fabs(ratio) + std::sqrt(ratio * ratio + 1)), ratio);
  const double cos = 1 / std::sqrt(tan * tan + 1), half = std::sqrt(0.5 * (1 + cos));
  double v[3] = {0, 0, 0};
  v[k] = -0.5 * tan * cos / half;
  return {v[0], v[1], v[2], half};
}

// The turn to eigenvectors of M, in the order and with the signs nearest to where they were.
inline Quad eigenvectors(const M3& M) {
  Quad p{0, 0, 0, 1};
  for (int k = 0; k < 60; ++k) {
    const M3 A = seen_by(transposed(matrix(p)), M);
    const double off[3] = {std::fabs(A.x[1][2]), std::fabs(A.x[2][0]), std::fabs(A.x[0][1])};
    const int worst = (int)(std::max_element(off, off + 3) - off);
    const double size = std::fabs(A.x[0][0]) + std::fabs(A.x[1][1]) + std::fabs(A.x[2][2]);
    if (!(off[worst] > 1e-16 * size)) break;
    p = unit(p * jacobi(A, worst));
  }
  return unit(p * conjugate(nearest_name(p)));
}

// Natural logarithm of x >= 1.
inline double log_of(double x) {
  double f = 2;
  for (; x > 2; f *= 2) x = std::sqrt(x);
  return f * atanh_of((x - 1) / (x + 1));
}

// exp(x) for |x| <= 700: 2^n times the series of the remainder.
inline double exp_of(double x) {
  if (!(x > -700)) return 0;
  const double n = std::nearbyint(x * 1.4426950408889634);
  const double r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
  double s = 1;
  for (int k = 14; k > 0; --k) s = 1 + s * r / k;
  return std::ldexp(s, (int)n);
}

// Arc tangent of x in [0, 1].
inline double atan_of(double x) {
  double f = 1, s = 1.0 / 17;
  for (; x > 0.125; f *= 2) x /= 1 + std::sqrt(1 + x * x);
  for (int k = 15; k > 0; k -= 2) s = 1.0 / k - s * x * x;
  return f * x * s;
}

// Rotation vector of a unit quaternion, of an angle up to a half turn.
inline V3 rotation_vector(Quad q) {
  if (q.w < 0) q = {-q.x, -q.y, -q.z, -q.w};
  const double norm = std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z);
  const double scale = norm < 1e-8 ? 2 : 4 * atan_of(norm / (1 + q.w)) / norm;
  return {{scale * q.x, scale * q.y, scale * q.z}};
}

// The unit quaternion of a rotation matrix, with w >= 0.
inline Quad quaternion(const M3& R) {
  const double xx = R.x[0][0], yy = R.x[1][1], zz = R.x[2][2];
  const double part[4] = {1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz};
  const int best = (int)(std::max_element(part, part + 4) - part);
  double q[4];
  if (best == 3) {
    for (int k = 0; k < 3; ++k) q[k] = R.x[LAST[k]][NEXT[k]] - R.x[NEXT[k]][LAST[k]];
    q[3] = part[3];
  } else {
    for (int k = 0; k < 3; ++k) q[k] = k == best ? part[k] : R.x[k][best] + R.x[best][k];
    q[3] = R.x[LAST[best]][NEXT[best]] - R.x[NEXT[best]][LAST[best]];
  }
  const Quad out = unit({q[0], q[1], q[2], q[3]});
  return out.w < 0 ? Quad{-out.x, -out.y, -out.z, -out.w} : out;
}

inline M3 operator*(const M3& A, const M3& B) {
  M3 out;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) out.x[r][c] = A.x[r][0] * B.x[0][c] + A.x[r][1] * B.x[1][c] + A.x[r][2] * B.x[2][c];
  return out;
}

// [v x].
inline M3 skew(const V3& v) {
  return {{{0, -v.x[2], v.x[1]}, {v.x[2], 0, -v.x[0]}, {-v.x[1], v.x[0], 0}}};
}

}  // namespace avs
