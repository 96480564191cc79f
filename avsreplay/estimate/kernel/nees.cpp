// Normalised estimation errors squared: the truth in the nearest order of its principal axes against an estimate.
#include <cmath>
#include <cstring>
#include <limits>

#include "covariance.hpp"
#include "elimination.hpp"

namespace avs {
namespace {

constexpr int BLOCK_START[BLOCK_COUNT] = {0, 3, 6, 9, 12, 14, 17}, BLOCK_SIZE[BLOCK_COUNT] = {3, 3, 3, 3, 2, 3, 3};

void put_half_angle(const Quad& q, double* half_angle) {
  const double sign = q.w >= 0 ? 1 : -1;
  half_angle[0] = sign * q.x, half_angle[1] = sign * q.y, half_angle[2] = sign * q.z;
}

// The error states of the truth, its principal axes turned by R_nb = R_bn', from the estimate.
void difference(const State& truth, const State& x, const M3& R_nb, const Quad& q_bn, double d[DIM]) {
  put_half_angle(conjugate(quad(x.q_ab)) * quad(truth.q_ab) * q_bn, d);
  put_half_angle(conjugate(q_bn) * (quad(truth.q_bc) * conjugate(quad(x.q_bc))), d + 17);
  const V3 w = R_nb * vector(truth.w_b), c = R_nb * vector(truth.c_b);
  const double s1 = truth.sigma[0], s2 = truth.sigma[1], ratio[3] = {s1, s2, -(s1 + s2) / (1 + s1 * s2)};
  const M3& R = R_nb;
  const double even = std::fabs(R.x[0][0] * R.x[1][1] * R.x[2][2]) + std::fabs(R.x[0][1] * R.x[1][2] * R.x[2][0]) +
                      std::fabs(R.x[0][2] * R.x[1][0] * R.x[2][1]);
  const double parity = even > 0.5 ? 1 : -1;
  for (int k = 0; k < 3; ++k) {
    d[3 + k] = w.x[k] - x.w_b[k], d[6 + k] = truth.r_a[k] - x.r_a[k], d[9 + k] = truth.v_a[k] - x.v_a[k];
    d[14 + k] = c.x[k] - x.c_b[k];
  }
  for (int k = 0; k < 2; ++k) {
    double named = 0;
    for (int axis = 0; axis < 3; ++axis) named += std::fabs(R.x[k][axis]) * ratio[axis];
    d[12 + k] = parity * named - x.sigma[k];
  }
}

}  // namespace

Errors errors_squared(const State& truth, const State& x, const Square P, const M3* R_nb, const Quad* q_bn, int count) {
  Errors out;
  const Factored<DIM> whole(P);
  double d[DIM];
  out.size = std::numeric_limits<double>::infinity();
  for (int k = 0; k < count; ++k) {
    difference(truth, x, R_nb[k], q_bn[k], d);
    double size = 0;
    if (whole.regular) size = whole.squared(d);
    else
      for (int i = 0; i < DIM; ++i) size += P[i][i] > 0 ? d[i] * d[i] / P[i][i] : 0;
    if (k == 0 || size < out.size) {
      out.best = k, out.size = size;
    }
  }
  const Chart here = chart_of(x);
  double y[DIM];
  Square T;
  minus(chart_of(truth), here, y);
  errors_of(here, T);
  for (int r = 0; r < DIM; ++r) {
    d[r] = 0;
    for (int i = 0; i < DIM; ++i) d[r] += T[r][i] * y[i];
  }
  out.chart = whole.squared(d);
  for (int b = 0; b < BLOCK_COUNT; ++b)
    out.block[b] = Factored<DIM>(P, BLOCK_START[b], BLOCK_SIZE[b]).squared(d + BLOCK_START[b]);
  return out;
}

}  // namespace avs
