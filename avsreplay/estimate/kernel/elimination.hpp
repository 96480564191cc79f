// Systems of linear equations of fixed size.
#pragma once
#include <algorithm>
#include <cmath>

namespace avs {

// Lower Cholesky factor of C (N, N), of which the lower triangle is used; false where C is not positive definite.
template <int N>
bool cholesky(const double C[N][N], double L[N][N]) {
  for (int r = 0; r < N; ++r)
    for (int c = 0; c <= r; ++c) {
      double s = C[r][c];
      for (int i = 0; i < c; ++i) s -= L[r][i] * L[c][i];
      if (c < r) L[r][c] = s / L[c][c];
      else if (s > 0 && std::isfinite(s)) L[r][r] = std::sqrt(s);
      else return false;
    }
  return true;
}

// B := A^-1 B for a symmetric positive definite A, by A = L D L'.
template <int N, int W>
void solve(const double A[N][N], double B[N][W]) {
  double L[N][N], D[N];
  for (int r = 0; r < N; ++r) {
    for (int c = 0; c <= r; ++c) {
      double s = A[r][c];
      for (int i = 0; i < c; ++i) s -= L[r][i] * D[i] * L[c][i];
      if (c < r) L[r][c] = s / D[c];
      else D[r] = s;
    }
    for (int i = 0; i < r; ++i)
      for (int c = 0; c < W; ++c) B[r][c] -= L[r][i] * B[i][c];
  }
  for (int r = N - 1; r >= 0; --r) {
    for (int c = 0; c < W; ++c) B[r][c] /= D[r];
    for (int i = r + 1; i < N; ++i)
      for (int c = 0; c < W; ++c) B[r][c] -= L[i][r] * B[i][c];
  }
}

// The same for one column.
template <int N>
void solve(const double A[N][N], double x[N]) {
  solve<N, 1>(A, reinterpret_cast<double(*)[1]>(x));
}

// By A = L U with the largest pivot of each column: the factors L U of `size` rows and columns of A from `first` on, with the rows in the order of their pivots.
template <int N>
struct Factored {
  int n, pivot[N];
  double LU[N][N];
  bool regular = true;  // else the quotients are not finite

  explicit Factored(const double A[N][N], int first = 0, int size = N) : n(size) {
    for (int r = 0; r < n; ++r) std::copy(A[first + r] + first, A[first + r] + first + n, LU[r]);
    for (int k = 0; k < n; ++k) {
      int& best = pivot[k] = k;
      for (int r = k + 1; r < n; ++r)
        if (std::fabs(LU[r][k]) > std::fabs(LU[best][k])) best = r;
      const double largest = std::fabs(LU[best][k]);
      regular = regular && largest > 0 && std::isfinite(largest);
      if (best != k) std::swap_ranges(LU[k], LU[k] + n, LU[best]);
      for (int r = k + 1; r < n; ++r) {
        const double f = LU[r][k] /= LU[k][k];
        for (int c = k + 1; c < n; ++c) LU[r][c] -= f * LU[k][c];
      }
    }
  }

  // B := A^-1 B.
  template <int M>
  void divide(double B[N][M]) const {
    for (int k = 0; k < n; ++k) {
      if (pivot[k] != k) std::swap_ranges(B[k], B[k] + M, B[pivot[k]]);
    }
    for (int k = 0; k < n; ++k)
      for (int r = k + 1; r < n; ++r)
        for (int c = 0; c < M; ++c) B[r][c] -= LU[r][k] * B[k][c];
    for (int k = n - 1; k >= 0; --k) {
      for (int i = k + 1; i < n; ++i)
        for (int c = 0; c < M; ++c) B[k][c] -= LU[k][i] * B[i][c];
      for (int c = 0; c < M; ++c) B[k][c] /= LU[k][k];
    }
  }

  // e' A^-1 e, NaN where A is singular.
  double squared(const double* e) const {
    double x[N][1], sum = 0;
    for (int k = 0; k < n; ++k) x[k][0] = e[k];
    divide<1>(x);
    for (int k = 0; k < n; ++k) sum += e[k] * x[k][0];
    return regular ? sum : NAN;
  }
};

}  // namespace avs
