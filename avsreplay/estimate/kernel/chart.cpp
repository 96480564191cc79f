#include "chart.hpp"

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

}  // namespace

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
