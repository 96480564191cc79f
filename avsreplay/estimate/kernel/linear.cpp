// Gain and covariance of fixed size: plain sums in a fixed order.
#include <cmath>
#include <cstring>

#include "update.hpp"

namespace avs {
namespace {

using Seen = double[SEEN][DIM];

// out := A B for A (N, M), B (M, DIM).
template <int N, int M>
void product(const double A[N][M], const double B[M][DIM], double out[N][DIM]) {
  for (int r = 0; r < N; ++r) {
    double s[DIM] = {};
    for (int i = 0; i < M; ++i)
      for (int c = 0; c < DIM; ++c) s[c] += A[r][i] * B[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
}

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

// S = H P H' + 1.
void seen(const double P[DIM][DIM], const double H[SEEN][DIM], double S[SEEN][SEEN]) {
  double HP[SEEN][DIM];
  product<SEEN, DIM>(H, P, HP);
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) {
      S[r][c] = r == c;
      for (int i = 0; i < DIM; ++i) S[r][c] += HP[r][i] * H[c][i];
    }
}

// K = P H' S^-1.
void gain(const double P[DIM][DIM], const double H[SEEN][DIM], const double S[SEEN][SEEN], double K[DIM][SEEN]) {
  double B[SEEN][DIM];
  product<SEEN, DIM>(H, P, B);
  solve(S, B);
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < SEEN; ++c) K[r][c] = B[c][r];
}

// P := (I - KH) P (I - KH)' + K R K', exactly symmetric: X = (I - KH) P, then X + (K R - X H') K'.
void joseph(double P[DIM][DIM], const double H[SEEN][DIM], const double K[DIM][SEEN], const double R[SEEN][SEEN]) {
  double HP[SEEN][DIM], X[DIM][DIM], Kt[SEEN][DIM];
  product<SEEN, DIM>(H, P, HP);
  product<DIM, SEEN>(K, HP, X);
  for (int r = 0; r < DIM; ++r) {
    for (int c = 0; c < DIM; ++c) X[r][c] = P[r][c] - X[r][c];
    for (int c = 0; c < SEEN; ++c) Kt[c][r] = K[r][c];
  }
  double G[DIM][SEEN];
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < SEEN; ++c) {
      double kr = 0, xh = 0;
      for (int i = 0; i < SEEN; ++i) kr += K[r][i] * R[i][c];
      for (int i = 0; i < DIM; ++i) xh += X[r][i] * H[c][i];
      G[r][c] = kr - xh;
    }
  double GK[DIM][DIM];
  product<DIM, SEEN>(G, Kt, GK);
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c <= r; ++c) P[r][c] = P[c][r] = 0.5 * (X[r][c] + GK[r][c] + X[c][r] + GK[c][r]);
}

}  // namespace

void correct(State& x, double P[DIM][DIM], const Pose& seen, const double colour[2]) {
  double R[SEEN][SEEN], S[SEEN][SEEN], K[DIM][SEEN], d[DIM] = {};
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) {
      R[r][c] = seen.R[r][c] * std::sqrt(colour[r < 3] * colour[c < 3]);
      S[r][c] = seen.S[r][c] + (R[r][c] - seen.R[r][c]);
    }
  gain(P, seen.H, S, K);
  for (int r = 0; r < DIM; ++r)
    for (int i = 0; i < SEEN; ++i) d[r] += K[r][i] * seen.alpha[i];
  joseph(P, seen.H, K, R);
  retract(x, P, d);
}

void pass(double y[DIM], double P[DIM][DIM], const double e[SEEN], const double H[SEEN][DIM], const double Q[DIM][DIM]) {
  double one[SEEN][SEEN] = {}, S[SEEN][SEEN], K[DIM][SEEN];
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < DIM; ++c) P[r][c] += Q[r][c];
  seen(P, H, S);
  gain(P, H, S, K);
  double off[SEEN];
  for (int r = 0; r < SEEN; ++r) {
    one[r][r] = 1;
    off[r] = e[r];
    for (int i = 0; i < DIM; ++i) off[r] += H[r][i] * y[i];
  }
  for (int r = 0; r < DIM; ++r)
    for (int i = 0; i < SEEN; ++i) y[r] -= K[r][i] * off[i];
  joseph(P, H, K, one);
}

}  // namespace avs
