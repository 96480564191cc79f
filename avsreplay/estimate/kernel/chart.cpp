#include "chart.hpp"
#include "elimination.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace avs {
namespace {

constexpr int ETA = 0, RATE = 3, POSITION = 6, VELOCITY = 9, INERTIA = 12, ARM = 17;

// Orthonormal traceless symmetric matrices.
const double H2 = std::sqrt(0.5), H6 = 1 / std::sqrt(6.0);
const M3 BASIS[5] = {{{{H2, 0, 0}, {0, -H2, 0}, {0, 0, 0}}},
                     {{{H6, 0, 0}, {0, H6, 0}, {0, 0, -2 * H6}}},
                     {{{0, 0, 0}, {0, 0, H2}, {0, H2, 0}}},
                     {{{0, 0, H2}, {0, 0, 0}, {H2, 0, 0}}},
                     {{{0, H2, 0}, {H2, 0, 0}, {0, 0, 0}}}};

Axes axes_of(const Chart& c) {
  const M3 D = seen_by(transposed(c.R_cb), c.M);
  const double values[3] = {D.x[0][0], D.x[1][1], D.x[2][2]};
  return axes(values);
}

void put(const M3& A, double f, int row, int column, double T[DIM][DIM]) {
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) T[row + r][column + c] = f * A.x[r][c];
}

// Inertia tensor over its trace and its ascending eigenvalues, from the logarithm M of the mass moments.
void inertia(const M3& M, double tensor[3][3], double moments[3]) {
  const M3 V = matrix(eigenvectors(M)), D = seen_by(transposed(V), M);
  const double largest = std::max({D.x[0][0], D.x[1][1], D.x[2][2]});
  double mass[3], sum = 0;
  for (int k = 0; k < 3; ++k) sum += mass[k] = exp_of(D.x[k][k] - largest);
  for (int k = 0; k < 3; ++k) moments[k] = 0.5 * (sum - mass[k]) / sum;  // the trace of the inertia is twice that of the mass
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      tensor[i][j] = 0;
      for (int k = 0; k < 3; ++k) tensor[i][j] += V.x[i][k] * moments[k] * V.x[j][k];
    }
  std::sort(moments, moments + 3);
}

// Eigenvalues, on the diagonal of a symmetric S, and eigenvectors, the columns of V: cyclic Jacobi rotations.
template <int N>
void eigen(double S[N][N], double V[N][N]) {
  for (int r = 0; r < N; ++r)
    for (int c = 0; c < N; ++c) V[r][c] = r == c;
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0, size = 0;
    for (int r = 0; r < N; ++r)
      for (int c = 0; c < N; ++c) (r == c ? size : off) += S[r][c] * S[r][c];
    if (!(off > 1e-32 * size)) return;
    for (int i = 0; i < N; ++i)
      for (int j = i + 1; j < N; ++j) {
        if (S[i][j] == 0) continue;
        const double ratio = (S[j][j] - S[i][i]) / (2 * S[i][j]);
        const double tan = std::copysign(1 / (std::fabs(ratio) + std::sqrt(ratio * ratio + 1)), ratio);
        const double cos = 1 / std::sqrt(tan * tan + 1), sin = tan * cos;
        for (int k = 0; k < N; ++k) {
          const double a = S[k][i], b = S[k][j];
          S[k][i] = cos * a - sin * b, S[k][j] = sin * a + cos * b;
        }
        for (int k = 0; k < N; ++k) {
          const double a = S[i][k], b = S[j][k], u = V[k][i], w = V[k][j];
          S[i][k] = cos * a - sin * b, S[j][k] = sin * a + cos * b;
          V[k][i] = cos * u - sin * w, V[k][j] = sin * u + cos * w;
        }
        S[i][j] = S[j][i] = 0;
      }
  }
}

// out := variances and covariances of chart coordinates `first` to `first + N`, where `inverse` is that of errors_of.
template <int N>
void block(const double inverse[DIM][DIM], const double P[DIM][DIM], int first, double out[N][N]) {
  double XP[N][DIM];
  product<N, DIM>(*reinterpret_cast<const double(*)[N][DIM]>(inverse[first]), P, XP);
  for (int r = 0; r < N; ++r)
    for (int c = 0; c < N; ++c) {
      out[r][c] = 0;
      for (int i = 0; i < DIM; ++i) out[r][c] += XP[r][i] * inverse[first + c][i];
    }
}

double trace(const double A[3][3]) { return A[0][0] + A[1][1] + A[2][2]; }

}  // namespace

BodyNumbers numbers_of(const Chart& c, const double P[DIM][DIM], double largest) {
  BodyNumbers out;
  double T[DIM][DIM], inverse[DIM][DIM] = {}, small[3][3], S[5][5], V[5][5];
  errors_of(c, T);
  for (int k = 0; k < DIM; ++k) inverse[k][k] = 1;
  Factored<DIM>(T).divide<DIM>(inverse);
  block<3>(inverse, P, ARM, small);
  out.arm_variance = trace(small);
  block<3>(inverse, P, RATE, small);
  out.rate_variance = trace(small);
  block<5>(inverse, P, INERTIA, S);
  for (int r = 0; r < 5; ++r)
    for (int k = 0; k < r; ++k) S[r][k] = S[k][r] = 0.5 * (S[r][k] + S[k][r]);
  eigen<5>(S, V);
  inertia(c.M, out.inertia, out.moments);
  std::memset(out.inertia_1s, 0, sizeof out.inertia_1s);
  std::memset(out.moments_1s, 0, sizeof out.moments_1s);
  for (int k = 0; k < 5; ++k)
    for (int side = -1; side <= 1; side += 2) {
      const double length = side * std::sqrt(5.0) * std::min(std::sqrt(std::max(S[k][k], 0.0)), largest);
      double tensor[3][3], moments[3];
      M3 M = c.M;
      for (int n = 0; n < 5; ++n)
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) M.x[i][j] += length * V[n][k] * BASIS[n].x[i][j];
      inertia(M, tensor, moments);
      for (int i = 0; i < 3; ++i) {
        out.moments_1s[i] += (moments[i] - out.moments[i]) * (moments[i] - out.moments[i]) / 10;
        for (int j = 0; j < 3; ++j)
          out.inertia_1s[i][j] += (tensor[i][j] - out.inertia[i][j]) * (tensor[i][j] - out.inertia[i][j]) / 10;
      }
    }
  for (int i = 0; i < 3; ++i) {
    out.moments_1s[i] = std::sqrt(out.moments_1s[i]);
    for (double& one : out.inertia_1s[i]) one = std::sqrt(one);
  }
  return out;
}

Chart moved(const Chart& c, const double y[DIM]) {
  Chart out = c;
  out.q = c.q * half_angle(vector(y + ETA));
  out.w = c.w + vector(y + RATE);
  out.t = c.t + vector(y + POSITION);
  out.u = c.u + vector(y + VELOCITY);
  out.arm = c.arm + vector(y + ARM);
  for (int k = 0; k < 5; ++k)
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) out.M.x[i][j] += y[INERTIA + k] * BASIS[k].x[i][j];
  shorten(out.M);
  out.R_cb = c.R_cb * matrix(eigenvectors(seen_by(transposed(c.R_cb), out.M)));
  return out;
}

void minus(const Chart& c, const Chart& from, double y[DIM]) {
  const Quad turn = conjugate(from.q) * c.q;
  const double sign = (turn.w < 0 ? -1 : 1) / std::sqrt(turn.x * turn.x + turn.y * turn.y + turn.z * turn.z + turn.w * turn.w);
  const V3 parts[4] = {{{sign * turn.x, sign * turn.y, sign * turn.z}}, c.w - from.w, c.t - from.t, c.u - from.u};
  std::memcpy(y, parts, sizeof parts);
  for (int k = 0; k < 5; ++k) {
    y[INERTIA + k] = 0;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) y[INERTIA + k] += BASIS[k].x[i][j] * (c.M.x[i][j] - from.M.x[i][j]);
  }
  const V3 arm = c.arm - from.arm;
  std::memcpy(y + ARM, arm.x, sizeof arm.x);
}

Chart chart_of(const State& x) {
  const double a = atanh_of(x.sigma[0]), b = atanh_of(x.sigma[1]);
  const double m[3] = {(a + 2 * b) * (2.0 / 3), (-2 * a - b) * (2.0 / 3), (a - b) * (2.0 / 3)};
  Chart c;
  c.q = quad(x.q_ab) * quad(x.q_bc);
  c.R_cb = transposed(matrix(quad(x.q_bc)));
  c.w = c.R_cb * vector(x.w_b);
  c.arm = c.R_cb * vector(x.c_b);
  const M3 R_ab = matrix(quad(x.q_ab));
  c.t = vector(x.r_a) + R_ab * vector(x.c_b);
  c.u = vector(x.v_a) + R_ab * cross(vector(x.w_b), vector(x.c_b));
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      c.M.x[i][j] = 0;
      for (int k = 0; k < 3; ++k) c.M.x[i][j] += c.R_cb.x[i][k] * m[k] * c.R_cb.x[j][k];
    }
  return c;
}

State state_of(const Chart& c) {
  const M3 R_ac = matrix(c.q), A = transposed(c.R_cb);
  const Quad q_bc = quaternion(A), q_ab = c.q * conjugate(q_bc);
  const Axes body = axes_of(c);
  const V3 w = A * c.w, arm = A * c.arm, r = c.t - R_ac * c.arm, v = c.u - R_ac * cross(c.w, c.arm);
  State x;
  std::memcpy(x.q_ab, &q_ab, sizeof x.q_ab);
  std::memcpy(x.w_b, w.x, sizeof x.w_b);
  std::memcpy(x.r_a, r.x, sizeof x.r_a);
  std::memcpy(x.v_a, v.x, sizeof x.v_a);
  std::memcpy(x.sigma, body.sigma, sizeof x.sigma);
  std::memcpy(x.c_b, arm.x, sizeof x.c_b);
  std::memcpy(x.q_bc, &q_bc, sizeof x.q_bc);
  return x;
}

double least_gap(const Chart& c) {
  const M3 D = seen_by(transposed(c.R_cb), c.M);
  double least = INFINITY;
  for (int i = 0; i < 3; ++i) least = std::min(least, std::fabs(D.x[i][i] - D.x[NEXT[i]][NEXT[i]]));
  return least;
}

void errors_of(const Chart& c, double T[DIM][DIM]) {
  const M3 A = transposed(c.R_cb), R_ac = matrix(c.q), one = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  const Axes body = axes_of(c);
  const V3 w = A * c.w, arm = A * c.arm;
  std::memset(T, 0, sizeof(double) * DIM * DIM);
  for (int k = 0; k < 5; ++k) {
    const M3 D = seen_by(A, BASIS[k]);
    V3 mu;
    for (int axis = 0; axis < 3; ++axis) {
      const int i = NEXT[axis], j = LAST[axis];
      mu.x[axis] = 0.5 * D.x[i][j] / (body.m[j] - body.m[i]);
    }
    const V3 rate = cross(w, mu), shift = cross(arm, mu);
    for (int r = 0; r < 3; ++r) {
      T[r][INERTIA + k] = -mu.x[r];
      T[3 + r][INERTIA + k] = -2 * rate.x[r];
      T[14 + r][INERTIA + k] = -2 * shift.x[r];
      T[17 + r][INERTIA + k] = mu.x[r];
    }
    T[12][INERTIA + k] = body.slope[0] * (D.x[2][2] - D.x[1][1]);
    T[13][INERTIA + k] = body.slope[1] * (D.x[0][0] - D.x[2][2]);
  }
  put(A, 1, 0, ETA, T);
  put(A, 1, 3, RATE, T);
  put(one, 1, 6, POSITION, T);
  put(one, 1, 9, VELOCITY, T);
  put(R_ac * skew(c.arm), 2, 6, ETA, T);
  put(R_ac, -1, 6, ARM, T);
  put(R_ac * skew(cross(c.w, c.arm)), 2, 9, ETA, T);
  put(R_ac * skew(c.arm), 1, 9, RATE, T);
  put(R_ac * skew(c.w), -1, 9, ARM, T);
  put(A, 1, 14, ARM, T);
}

}  // namespace avs
