// Gain and covariance of fixed size: plain sums in a fixed order.
#include <cmath>
#include <cstring>
#include <stdexcept>

#include "covariance.hpp"
#include "elimination.hpp"
#include "update.hpp"

namespace avs {
namespace {

// out := A B' for A (N, W), B (SEEN, W). The sums run side by side, so that none waits for the one before.
template <int N, int W>
void by_rows(const double A[N][W], const double B[SEEN][W], double out[N][SEEN]) {
  double Bt[W][SEEN];
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < W; ++c) Bt[c][r] = B[r][c];
  for (int r = 0; r < N; ++r) {
    double s[SEEN] = {};
    for (int i = 0; i < W; ++i)
      for (int c = 0; c < SEEN; ++c) s[c] += A[r][i] * Bt[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
}

// K' = S^-1 H P, from HP.
template <int W>
void gain(const double HP[SEEN][W], const double S[SEEN][SEEN], double Kt[SEEN][W]) {
  std::memcpy(Kt, HP, SEEN * W * sizeof(double));
  solve<SEEN, W>(S, Kt);
}

// P := (I - KH) P (I - KH)' + K R K', exactly symmetric: X = (I - KH) P, then X + (K R - X H') K'.
template <int W>
void joseph(double P[W][W], const double H[SEEN][W], const double HP[SEEN][W], const double Kt[SEEN][W],
            const double R[SEEN][SEEN]) {
  double K[W][SEEN], X[W][W], XH[W][SEEN], G[W][SEEN], GK[W][W];
  for (int r = 0; r < W; ++r)
    for (int c = 0; c < SEEN; ++c) K[r][c] = Kt[c][r];
  product<W, SEEN>(K, HP, X);
  for (int r = 0; r < W; ++r)
    for (int c = 0; c < W; ++c) X[r][c] = P[r][c] - X[r][c];
  by_rows<W, W>(X, H, XH);
  for (int r = 0; r < W; ++r) {
    double s[SEEN] = {};
    for (int i = 0; i < SEEN; ++i)
      for (int c = 0; c < SEEN; ++c) s[c] += K[r][i] * R[i][c];
    for (int c = 0; c < SEEN; ++c) G[r][c] = s[c] - XH[r][c];
  }
  product<W, SEEN>(G, Kt, GK);
  for (int r = 0; r < W; ++r)
    for (int c = 0; c <= r; ++c) P[r][c] = P[c][r] = 0.5 * (X[r][c] + GK[r][c] + X[c][r] + GK[c][r]);
}

// S of a pose with the noise R in place of its own.
void with_noise(const Pose& seen, const double R[SEEN][SEEN], double S[SEEN][SEEN]) {
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) S[r][c] = seen.S[r][c] + (R[r][c] - seen.R[r][c]);
}

}  // namespace

void seen_at(const double P[DIM][DIM], const Pose& pose, const double R[SEEN][SEEN], Used& out) {
  double S[SEEN][SEEN], HP[SEEN][DIM];
  with_noise(pose, R, S);
  product<SEEN, DIM>(pose.H, P, HP);
  gain<DIM>(HP, S, out.Kt);
  if (!inverse_root(pose.S, out.root)) throw std::invalid_argument("a covariance is not positive definite");
  std::memcpy(out.H, pose.H, sizeof out.H);
  std::memcpy(out.alpha, pose.alpha, sizeof out.alpha);
}

void correct(State& x, double P[DIM][DIM], const Pose& seen, const double R[SEEN][SEEN]) {
  double S[SEEN][SEEN], HP[SEEN][DIM], Kt[SEEN][DIM], d[DIM] = {};
  with_noise(seen, R, S);
  product<SEEN, DIM>(seen.H, P, HP);
  gain<DIM>(HP, S, Kt);
  for (int i = 0; i < SEEN; ++i)
    for (int r = 0; r < DIM; ++r) d[r] += Kt[i][r] * seen.alpha[i];
  joseph<DIM>(P, seen.H, HP, Kt, R);
  retract(x, P, d);
}

template <int W>
void pass(double y[W], double P[W][W], const double e[SEEN], const double H[SEEN][W], const double Q[MOTION][MOTION]) {
  double one[SEEN][SEEN] = {}, S[SEEN][SEEN], HP[SEEN][W], Kt[SEEN][W];
  for (int r = 0; r < MOTION; ++r)
    for (int c = 0; c < MOTION; ++c) P[r][c] += Q[r][c];
  product<SEEN, W>(H, P, HP);
  by_rows<SEEN, W>(HP, H, S);
  for (int r = 0; r < SEEN; ++r) {
    one[r][r] = 1;
    S[r][r] += 1;
  }
  gain<W>(HP, S, Kt);
  double off[SEEN];
  for (int r = 0; r < SEEN; ++r) {
    off[r] = e[r];
    for (int i = 0; i < W; ++i) off[r] += H[r][i] * y[i];
  }
  for (int i = 0; i < SEEN; ++i)
    for (int r = 0; r < W; ++r) y[r] -= Kt[i][r] * off[i];
  joseph<W>(P, H, HP, Kt, one);
}

template void pass<DIM>(double[DIM], double[DIM][DIM], const double[SEEN], const double[SEEN][DIM],
                        const double[MOTION][MOTION]);
template void pass<DIM + SEEN + 1>(double[DIM + SEEN + 1], double[DIM + SEEN + 1][DIM + SEEN + 1], const double[SEEN],
                                   const double[SEEN][DIM + SEEN + 1], const double[MOTION][MOTION]);

}  // namespace avs
