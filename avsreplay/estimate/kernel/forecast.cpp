// The predicted grasp point (section 8 of the equations): its motion and its covariance, at many instants.
#include <cstring>

#include "fit.hpp"

namespace avs {
namespace {

// The derivative of the grasp point's position, velocity and half-angle attitude by (dq_v, w) at the same instant.
void turning(const M3& A, const V3& w, const V3& c, double rows[9][6]) {
  std::memset(rows, 0, 9 * 6 * sizeof(double));
  const M3 arm = A * skew(c), twist = A * skew(cross(w, c));
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k) {
      rows[r][k] = -2 * arm.x[r][k];
      rows[3 + r][k] = -2 * twist.x[r][k];
      rows[3 + r][3 + k] = -arm.x[r][k];
    }
    rows[6 + r][r] = 1;
  }
}

// That by the error states at the start.
void by_start(const double turn[9][6], const Flow& flow, const double join[3][2], const M3& A, double t, double J[9][DIM]) {
  std::memset(J, 0, 9 * DIM * sizeof(double));
  const M3 spin = A * skew(vector(flow.at.w));
  for (int r = 0; r < 9; ++r) {
    double s[9] = {};
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 9; ++c) s[c] += turn[r][i] * flow.S[i][c];
    for (int c = 0; c < 6; ++c) J[r][c] = s[c];
    for (int c = 0; c < 2; ++c) J[r][12 + c] = s[6] * join[0][c] + s[7] * join[1][c] + s[8] * join[2][c];
  }
  for (int r = 0; r < 3; ++r) {
    J[r][6 + r] = J[3 + r][9 + r] = J[6 + r][17 + r] = 1;
    J[r][9 + r] = t;
    for (int c = 0; c < 3; ++c) {
      J[r][14 + c] = A.x[r][c];
      J[3 + r][14 + c] = spin.x[r][c];
    }
  }
}

}  // namespace

void forecast(const State& x, const Square P, double force_density, double t, const Flow& flow, double variances[3]) {
  double join[3][2], turn[9][6], J[9][DIM];
  body_of(x, join);
  const M3 A = matrix(quad(flow.at.q));
  turning(A, vector(flow.at.w), vector(x.c_b), turn);
  by_start(turn, flow, join, A, t, J);
  for (int block = 0; block < 3; ++block) {
    double s = 0;
    for (int r = 3 * block; r < 3 * block + 3; ++r) {
      double JP[DIM] = {};
      for (int i = 0; i < DIM; ++i)
        for (int c = 0; c < DIM; ++c) JP[c] += J[r][i] * P[i][c];
      for (int c = 0; c < DIM; ++c) s += JP[c] * J[r][c];
      for (int i = 0; i < 6; ++i)
        for (int c = 0; c < 6; ++c) s += turn[r][i] * flow.Q[i][c] * turn[r][c];
    }
    variances[block] = s;
  }
  variances[0] += force_density * t * t * t;
  variances[1] += 3 * force_density * t;
}

}  // namespace avs
