// Gain and covariance of fixed size: plain sums in a fixed order.
#include <cmath>
#include <cstring>

#include "update.hpp"

namespace avs {
namespace {

using Seen = double[SEEN][DIM];

// B := S^-1 B, by S = L D L'.
void solve(const double S[SEEN][SEEN], Seen B) {
  double L[SEEN][SEEN], D[SEEN];
  for (int r = 0; r < SEEN; ++r) {
    for (int c = 0; c <= r; ++c) {
      double s = S[r][c];
      for (int i = 0; i < c; ++i) s -= L[r][i] * D[i] * L[c][i];
      if (c < r) L[r][c] = s / D[c];
      else D[r] = s;
    }
    for (int i = 0; i < r; ++i)
      for (int c = 0; c < DIM; ++c) B[r][c] -= L[r][i] * B[i][c];
  }
  for (int r = SEEN - 1; r >= 0; --r) {
    for (int c = 0; c < DIM; ++c) B[r][c] /= D[r];
    for (int i = r + 1; i < SEEN; ++i)
      for (int c = 0; c < DIM; ++c) B[r][c] -= L[i][r] * B[i][c];
  }
}

// out := A B' for A (N, DIM), B (SEEN, DIM). The sums run side by side, so that none waits for the one before.
template <int N>
void by_rows(const double A[N][DIM], const double B[SEEN][DIM], double out[N][SEEN]) {
  double Bt[DIM][SEEN];
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < DIM; ++c) Bt[c][r] = B[r][c];
  for (int r = 0; r < N; ++r) {
    double s[SEEN] = {};
    for (int i = 0; i < DIM; ++i)
      for (int c = 0; c < SEEN; ++c) s[c] += A[r][i] * Bt[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
}

// K' = S^-1 H P, from HP.
void gain(const double HP[SEEN][DIM], const double S[SEEN][SEEN], double Kt[SEEN][DIM]) {
  std::memcpy(Kt, HP, SEEN * DIM * sizeof(double));
  solve(S, Kt);
}

// P := (I - KH) P (I - KH)' + K R K', exactly symmetric: X = (I - KH) P, then X + (K R - X H') K'.
void joseph(double P[DIM][DIM], const double H[SEEN][DIM], const double HP[SEEN][DIM], const double Kt[SEEN][DIM],
            const double R[SEEN][SEEN]) {
  double K[DIM][SEEN], X[DIM][DIM], XH[DIM][SEEN], G[DIM][SEEN], GK[DIM][DIM];
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < SEEN; ++c) K[r][c] = Kt[c][r];
  product<DIM, SEEN>(K, HP, X);
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < DIM; ++c) X[r][c] = P[r][c] - X[r][c];
  by_rows<DIM>(X, H, XH);
  for (int r = 0; r < DIM; ++r) {
    double s[SEEN] = {};
    for (int i = 0; i < SEEN; ++i)
      for (int c = 0; c < SEEN; ++c) s[c] += K[r][i] * R[i][c];
    for (int c = 0; c < SEEN; ++c) G[r][c] = s[c] - XH[r][c];
  }
  product<DIM, SEEN>(G, Kt, GK);
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c <= r; ++c) P[r][c] = P[c][r] = 0.5 * (X[r][c] + GK[r][c] + X[c][r] + GK[c][r]);
}

// R and S of a pose whose noise is widened by `colour`.
void widened(const Pose& seen, const double colour[2], double R[SEEN][SEEN], double S[SEEN][SEEN]) {
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) {
      R[r][c] = seen.R[r][c] * std::sqrt(colour[r < 3] * colour[c < 3]);
      S[r][c] = seen.S[r][c] + (R[r][c] - seen.R[r][c]);
    }
}

}  // namespace

void seen_at(const double P[DIM][DIM], const Pose& pose, const double colour[2], Used& out) {
  double R[SEEN][SEEN], S[SEEN][SEEN], HP[SEEN][DIM], one[SEEN][DIM] = {};
  widened(pose, colour, R, S);
  product<SEEN, DIM>(pose.H, P, HP);
  gain(HP, S, out.Kt);
  for (int r = 0; r < SEEN; ++r) one[r][r] = 1;
  solve(pose.S, one);
  for (int r = 0; r < SEEN; ++r) std::memcpy(out.info[r], one[r], sizeof out.info[r]);
  std::memcpy(out.H, pose.H, sizeof out.H);
  std::memcpy(out.alpha, pose.alpha, sizeof out.alpha);
}

void correct(State& x, double P[DIM][DIM], const Pose& seen, const double colour[2]) {
  double R[SEEN][SEEN], S[SEEN][SEEN], HP[SEEN][DIM], Kt[SEEN][DIM], d[DIM] = {};
  widened(seen, colour, R, S);
  product<SEEN, DIM>(seen.H, P, HP);
  gain(HP, S, Kt);
  for (int i = 0; i < SEEN; ++i)
    for (int r = 0; r < DIM; ++r) d[r] += Kt[i][r] * seen.alpha[i];
  joseph(P, seen.H, HP, Kt, R);
  retract(x, P, d);
}

void pass(double y[DIM], double P[DIM][DIM], const double e[SEEN], const double H[SEEN][DIM],
          const double Q[MOTION][MOTION]) {
  double one[SEEN][SEEN] = {}, S[SEEN][SEEN], HP[SEEN][DIM], Kt[SEEN][DIM];
  for (int r = 0; r < MOTION; ++r)
    for (int c = 0; c < MOTION; ++c) P[r][c] += Q[r][c];
  product<SEEN, DIM>(H, P, HP);
  by_rows<SEEN>(HP, H, S);
  for (int r = 0; r < SEEN; ++r) {
    one[r][r] = 1;
    S[r][r] += 1;
  }
  gain(HP, S, Kt);
  double off[SEEN];
  for (int r = 0; r < SEEN; ++r) {
    off[r] = e[r];
    for (int i = 0; i < DIM; ++i) off[r] += H[r][i] * y[i];
  }
  for (int i = 0; i < SEEN; ++i)
    for (int r = 0; r < DIM; ++r) y[r] -= Kt[i][r] * off[i];
  joseph(P, H, HP, Kt, one);
}

}  // namespace avs
