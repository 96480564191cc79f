// The filter's update in fixed size: gain, Joseph's form, and the displacement of a state through the chart.
#pragma once
#include <vector>

#include <cstring>

namespace avs {

constexpr int DIM = 20, SEEN = 6;  // error states, and what a pose measures
constexpr int MOTION = 12;  // attitude, rate, position and velocity: the steps that disturbances reach

// out := A B for A (N, M), B (M, W).
template <int N, int M, int W>
void product(const double A[N][M], const double B[M][W], double out[N][W]) {
  for (int r = 0; r < N; ++r) {
    double s[W] = {};
    for (int i = 0; i < M; ++i)
      for (int c = 0; c < W; ++c) s[c] += A[r][i] * B[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
}

// The mean that the error states surround (eq:x): attitude and rate of {B}, centre of mass, its velocity, ratios,
// fixture in {B}, {C} to {B}.
struct State {
  double q_ab[4], w_b[3], r_a[3], v_a[3], sigma[2], c_b[3], q_bc[4];
};

// A measured pose at a prior: Jacobian H, innovation alpha, its covariance S, and the measurement noise R in S.
struct Pose {
  double H[SEEN][DIM], alpha[SEEN], S[SEEN][SEEN], R[SEEN][SEEN];
};

// x and P once a pose has been seen with the noise R in place of its own, through the chart: measurement.py.
void correct(State& x, double P[DIM][DIM], const Pose& seen, const double R[SEEN][SEEN]);

// A scan that was used: the transition since the one before, Jacobian and innovation of its pose, the lower triangular root
// with root S root' = 1 of the innovation's covariance, and the transposed gain.
struct Used {
  double Phi[DIM][DIM], H[SEEN][DIM], alpha[SEEN], root[SEEN][SEEN], Kt[SEEN][DIM];
};

// The Used of a pose at a prior covariance P, the noise of the update being R in place of its own.
void seen_at(const double P[DIM][DIM], const Pose& pose, const double R[SEEN][SEEN], Used& out);

// Likelihood ratio of a change of rate or velocity within one of the intervals before the last scans, to none, and the
// second moments P of the estimate's error after the last of them if there was one, from the changes that the scans have
// made more likely. `one_sigma` is that of the rate and of the velocity, times each of the `sizes`; `scale` is the factor on
// the covariance of the innovations, and `share` the part of it that scans have in common. A change that the updates let
// grow beyond `most` is left out: it is not linear. The ratio is 0 without any other.
double change_ratio(const Used* scans, int count, const double one_sigma[2], const std::vector<double>& sizes, double scale,
                    double share, double most, double P[DIM][DIM]);

// y and P of W unknowns once rows e + H y of unit variance have been seen, P of the motion having grown by Q before.
template <int W>
void pass(double y[W], double P[W][W], const double e[SEEN], const double H[SEEN][W], const double Q[MOTION][MOTION]);

// x displaced by the error d through the chart, and P carried from about the one to about the other.
void retract(State& x, double P[DIM][DIM], const double d[DIM]);

}  // namespace avs
