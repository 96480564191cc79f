// Products of vectors in space, and eigenvalues of small symmetric matrices by Jacobi's rotations.
#pragma once
#include <algorithm>
#include <cmath>

namespace avs {

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void turn(double& u, double& v, double c, double s) {
  const double x = c * u - s * v;
  v = s * u + c * v, u = x;
}

// The rotation of axes i and j after which A[i][j] is 0; A is turned by it, and the columns of V with it.
template <int N>
void rotate_pair(double (&A)[N][N], double (&V)[N][N], int n, int i, int j) {
  const double theta = (A[j][j] - A[i][i]) / (2 * A[i][j]);
  const double t = (theta < 0 ? -1 : 1) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
  const double c = 1 / std::sqrt(t * t + 1), s = t * c;
  for (int k = 0; k < n; ++k) turn(A[k][i], A[k][j], c, s);
  for (int k = 0; k < n; ++k) turn(A[i][k], A[j][k], c, s);
  for (int k = 0; k < n; ++k) turn(V[k][i], V[k][j], c, s);
}

// Eigenvalues (the diagonal that remains of A) and eigenvectors (columns of V) of the symmetric matrix in the first n rows
// and columns, until the squares beside the diagonal are below `share` of those on it.
template <int N>
void eigen(double (&A)[N][N], double (&V)[N][N], int n, double share) {
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) V[i][j] = i == j ? 1 : 0;
  for (int sweep = 0; sweep < 40; ++sweep) {
    double off = 0, diagonal = 0;
    for (int i = 0; i < n; ++i) {
      diagonal += A[i][i] * A[i][i];
      for (int j = i + 1; j < n; ++j) off += A[i][j] * A[i][j];
    }
    if (!(off > share * diagonal)) break;
    for (int i = 0; i < n - 1; ++i)
      for (int j = i + 1; j < n; ++j)
        if (A[i][j] != 0) rotate_pair(A, V, n, i, j);
  }
}

template <int N>
struct Square {
  double v[N][N] = {};
};
// Pseudo-inverse of the positive semidefinite matrix of these eigenvalues (the diagonal of A) and eigenvectors.
template <int N>
Square<N> pseudo_inverse(const Square<N>& A, const Square<N>& V, int n = N) {
  Square<N> out;
  double most = 0;
  for (int k = 0; k < n; ++k) most = std::max(most, A.v[k][k]);
  for (int k = 0; k < n; ++k) {
    if (!(A.v[k][k] > n * 2.3e-16 * most)) continue;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) out.v[i][j] += V.v[i][k] * V.v[j][k] / A.v[k][k];
  }
  return out;
}

// Pseudo-inverse of the symmetric positive semidefinite matrix in the first n rows and columns.
template <int N>
Square<N> pseudo_inverse(Square<N> A, int n = N) {
  Square<N> V;
  eigen(A.v, V.v, n, 1e-32);
  return pseudo_inverse(A, V, n);
}

}  // namespace avs
