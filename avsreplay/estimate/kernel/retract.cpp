// A displacement through the chart (chart.py). The chart's step is taken along axes that move with the body and lie
// along {B} before it, where M is diagonal: so the derivatives of both ways between errors and steps are closed forms.
#include <cstring>

#include "small.hpp"
#include "update.hpp"

namespace avs {
namespace {

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
  shorten(M);
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
