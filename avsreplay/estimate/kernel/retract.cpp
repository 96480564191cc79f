// A displacement through the chart (chart.py). The chart's step is taken along axes that move with the body and lie
// along {B} before it, where M is diagonal: so the derivatives of both ways between errors and steps are closed forms.
// Hyperbolic functions are made of the four operations and roots, for the same bits everywhere.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "update.hpp"

namespace avs {
namespace {

constexpr double LEAST_GAP = 1e-4;  // as in chart.py
constexpr int NEXT[3] = {1, 2, 0}, LAST[3] = {2, 0, 1};

struct V3 {
  double x[3];
};
struct M3 {
  double x[3][3];
};

V3 vector(const double* v) { return {{v[0], v[1], v[2]}}; }
V3 operator+(const V3& a, const V3& b) { return {{a.x[0] + b.x[0], a.x[1] + b.x[1], a.x[2] + b.x[2]}}; }
V3 operator-(const V3& a, const V3& b) { return {{a.x[0] - b.x[0], a.x[1] - b.x[1], a.x[2] - b.x[2]}}; }
V3 operator*(double f, const V3& a) { return {{f * a.x[0], f * a.x[1], f * a.x[2]}}; }

V3 cross(const V3& a, const V3& b) {
  V3 out;
  for (int r = 0; r < 3; ++r) out.x[r] = a.x[NEXT[r]] * b.x[LAST[r]] - a.x[LAST[r]] * b.x[NEXT[r]];
  return out;
}

V3 operator*(const M3& A, const V3& v) {
  V3 out;
  for (int r = 0; r < 3; ++r) out.x[r] = A.x[r][0] * v.x[0] + A.x[r][1] * v.x[1] + A.x[r][2] * v.x[2];
  return out;
}

M3 transposed(const M3& A) {
  M3 out;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) out.x[r][c] = A.x[c][r];
  return out;
}

// A M A'.
M3 seen_by(const M3& A, const M3& M) {
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

Quad operator*(const Quad& a, const Quad& b) {
  return {a.w * b.x + b.w * a.x + (a.y * b.z - a.z * b.y), a.w * b.y + b.w * a.y + (a.z * b.x - a.x * b.z),
          a.w * b.z + b.w * a.z + (a.x * b.y - a.y * b.x), a.w * b.w - (a.x * b.x + a.y * b.y + a.z * b.z)};
}

Quad conjugate(const Quad& q) { return {-q.x, -q.y, -q.z, q.w}; }

Quad scaled(const Quad& q, double f) { return {f * q.x, f * q.y, f * q.z, f * q.w}; }

Quad unit(const Quad& q) { return scaled(q, 1 / std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)); }

Quad quad(const double* q) { return {q[0], q[1], q[2], q[3]}; }

M3 matrix(const Quad& q) {
  return {{{1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)},
           {2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z - q.x * q.w)},
           {2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x * q.x + q.y * q.y)}}};
}

// The turn whose vector part is v; beyond a half turn the nearest one, a half turn.
Quad half_angle(const V3& v) {
  const double n2 = v.x[0] * v.x[0] + v.x[1] * v.x[1] + v.x[2] * v.x[2];
  if (n2 < 1) return {v.x[0], v.x[1], v.x[2], std::sqrt(1 - n2)};
  const double n = std::sqrt(n2);
  return {v.x[0] / n, v.x[1] / n, v.x[2] / n, 0};
}

// tanh(2x) = 2t / (1 + t^2), down to where six fractions do.
double tanh_of(double x) {
  if (std::fabs(x) > 20) return std::copysign(1.0, x);
  int doublings = 0;
  for (; std::fabs(x) > 0.25; x /= 2) ++doublings;
  const double s = x * x;
  double t = x / (1 + s / (3 + s / (5 + s / (7 + s / (9 + s / 11)))));
  for (; doublings > 0; --doublings) t = 2 * t / (1 + t * t);
  return t;
}

double atanh_of(double t) {
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

// A body's axes: the ratios and their slopes by half the differences of M's eigenvalues, which are kept a hair apart.
struct Axes {
  double m[3], sigma[2], slope[2];
};

Axes axes(const double* values) {
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
Quad nearest_name(const Quad& p) {
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
Quad jacobi(const M3& A, int k) {
  const int i = NEXT[k], j = LAST[k];
  const double ratio = (A.x[j][j] - A.x[i][i]) / (2 * A.x[i][j]);
  const double tan = std::copysign(1 / (std::fabs(ratio) + std::sqrt(ratio * ratio + 1)), ratio);
  const double cos = 1 / std::sqrt(tan * tan + 1), half = std::sqrt(0.5 * (1 + cos));
  double v[3] = {0, 0, 0};
  v[k] = -0.5 * tan * cos / half;
  return {v[0], v[1], v[2], half};
}

// The turn to eigenvectors of M, in the order and with the signs nearest to where they were.
Quad eigenvectors(const M3& M) {
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

// A step of the chart: half angle, rate, place and speed of the fixture, M, arm.
struct Step {
  V3 eta, rate, place, speed;
  M3 M;
  V3 arm;
};

// Where a step begins or ends: R from the step's axes to {A}, rate and arm in them, A from them to {B}.
struct Place {
  M3 R, A;
  V3 w, arm;
  Axes axes;
};

// The step of an error d, where A is 1: the inverse of `error`.
Step step(const Place& at, const double* d) {
  const V3 mu = vector(d + 17);
  Step y{vector(d) + mu, vector(d + 3) + 2 * cross(at.w, mu), {}, {}, {}, vector(d + 14) + 2 * cross(at.arm, mu)};
  const double a = d[12] / at.axes.slope[0], b = d[13] / at.axes.slope[1];
  y.M.x[0][0] = (a + 2 * b) / 3;
  y.M.x[1][1] = (-2 * a - b) / 3;
  y.M.x[2][2] = (a - b) / 3;
  for (int k = 0; k < 3; ++k) {
    const int i = NEXT[k], j = LAST[k];
    y.M.x[i][j] = y.M.x[j][i] = 2 * mu.x[k] * (at.axes.m[j] - at.axes.m[i]);
  }
  const V3 twist = cross(at.w, at.arm);
  y.place = vector(d + 6) - at.R * (2 * cross(at.arm, y.eta) - y.arm);
  y.speed = vector(d + 9) - at.R * (2 * cross(twist, y.eta) + cross(at.arm, y.rate) - cross(at.w, y.arm));
  return y;
}

// Chart.py's to_errors: the error d of a small step.
void error(const Place& at, const Step& y, double* d) {
  const M3 D = seen_by(at.A, y.M);
  V3 mu;
  for (int k = 0; k < 3; ++k) {
    const int i = NEXT[k], j = LAST[k];
    mu.x[k] = 0.5 * D.x[i][j] / (at.axes.m[j] - at.axes.m[i]);
  }
  const V3 twist = cross(at.w, at.arm);
  const V3 parts[4] = {at.A * y.eta - mu, at.A * y.rate - 2 * cross(at.A * at.w, mu),
                       y.place + at.R * (2 * cross(at.arm, y.eta) - y.arm),
                       y.speed + at.R * (2 * cross(twist, y.eta) + cross(at.arm, y.rate) - cross(at.w, y.arm))};
  std::memcpy(d, parts, sizeof parts);
  d[12] = at.axes.slope[0] * (D.x[2][2] - D.x[1][1]);
  d[13] = at.axes.slope[1] * (D.x[0][0] - D.x[2][2]);
  const V3 arm = at.A * y.arm - 2 * cross(at.A * at.arm, mu);
  std::memcpy(d + 14, arm.x, sizeof arm.x);
  std::memcpy(d + 17, mu.x, sizeof mu.x);
}

// P := F P F' for F' given: rows of Ft are columns of F.
void carry(const double Ft[DIM][DIM], double P[DIM][DIM]) {
  double FP[DIM][DIM] = {}, out[DIM][DIM] = {};
  for (int i = 0; i < DIM; ++i)
    for (int r = 0; r < DIM; ++r)
      for (int c = 0; c < DIM; ++c) FP[r][c] += Ft[i][r] * P[i][c];
  for (int r = 0; r < DIM; ++r)
    for (int i = 0; i < DIM; ++i)
      for (int c = 0; c < DIM; ++c) out[r][c] += FP[r][i] * Ft[i][c];
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c <= r; ++c) P[r][c] = P[c][r] = 0.5 * (out[r][c] + out[c][r]);
}

void put(const V3& v, double* out) { std::memcpy(out, v.x, sizeof v.x); }
void put(const Quad& q, double* out) { std::memcpy(out, &q, sizeof q); }

}  // namespace

void retract(State& x, double P[DIM][DIM], const double d[DIM]) {
  const double a = atanh_of(x.sigma[0]), b = atanh_of(x.sigma[1]);
  const double m[3] = {(a + 2 * b) * (2.0 / 3), (-2 * a - b) * (2.0 / 3), (a - b) * (2.0 / 3)};
  const M3 one = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  const Place here{matrix(quad(x.q_ab)), one, vector(x.w_b), vector(x.c_b), axes(m)};
  const Step y = step(here, d);
  const V3 place = vector(x.r_a) + here.R * here.arm + y.place;
  const V3 speed = vector(x.v_a) + here.R * cross(here.w, here.arm) + y.speed;

  M3 M = y.M;
  for (int k = 0; k < 3; ++k) M.x[k][k] += m[k];
  const Quad turned = quad(x.q_ab) * half_angle(y.eta), p = eigenvectors(M);
  const M3 A = transposed(matrix(p)), D = seen_by(A, M);
  const double values[3] = {D.x[0][0], D.x[1][1], D.x[2][2]};
  const Place there{matrix(turned), A, here.w + y.rate, here.arm + y.arm, axes(values)};

  double Ft[DIM][DIM];
  for (int k = 0; k < DIM; ++k) {
    double e[DIM] = {};
    e[k] = 1;
    error(there, step(here, e), Ft[k]);
  }
  carry(Ft, P);

  const Quad q_bc = conjugate(p) * quad(x.q_bc);
  const double sign = q_bc.w < 0 ? -1 : 1;
  put(unit(scaled(turned * p, sign)), x.q_ab);
  put(unit(scaled(q_bc, sign)), x.q_bc);
  put(A * there.w, x.w_b);
  put(A * there.arm, x.c_b);
  put(place - there.R * there.arm, x.r_a);
  put(speed - there.R * cross(there.w, there.arm), x.v_a);
  std::copy(there.axes.sigma, there.axes.sigma + 2, x.sigma);
}

}  // namespace avs
