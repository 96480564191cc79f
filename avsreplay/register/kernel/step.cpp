#include "step.hpp"

#include <cmath>
#include <cstring>

namespace avs {
namespace {

// Rotation of a unit quaternion, scalar first.
void rotation(const double* q, double* D) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  D[0] = 1 - 2 * (y * y + z * z), D[1] = 2 * (x * y - w * z), D[2] = 2 * (x * z + w * y);
  D[4] = 2 * (x * y + w * z), D[5] = 1 - 2 * (x * x + z * z), D[6] = 2 * (y * z - w * x);
  D[8] = 2 * (x * z - w * y), D[9] = 2 * (y * z + w * x), D[10] = 1 - 2 * (x * x + y * y);
}

void turn(double& u, double& v, double c, double s) {
  const double x = c * u - s * v;
  v = s * u + c * v, u = x;
}

void rotate_pair(double (&A)[4][4], double (&V)[4][4], int i, int j) {
  const double theta = (A[j][j] - A[i][i]) / (2 * A[i][j]);
  const double t = (theta < 0 ? -1 : 1) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
  const double c = 1 / std::sqrt(t * t + 1), s = t * c;
  for (int k = 0; k < 4; ++k) turn(A[k][i], A[k][j], c, s);
  for (int k = 0; k < 4; ++k) turn(A[i][k], A[j][k], c, s);
  for (int k = 0; k < 4; ++k) turn(V[k][i], V[k][j], c, s);
}

// Unit eigenvector of the largest eigenvalue of a symmetric matrix, by Jacobi's rotations.
void largest_eigenvector(double (&A)[4][4], double* q) {
  double V[4][4] = {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}};
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0, diagonal = 0;
    for (int i = 0; i < 4; ++i) {
      diagonal += A[i][i] * A[i][i];
      for (int j = i + 1; j < 4; ++j) off += A[i][j] * A[i][j];
    }
    if (off <= 1e-36 * diagonal) break;
    for (int i = 0; i < 3; ++i)
      for (int j = i + 1; j < 4; ++j)
        if (A[i][j] != 0) rotate_pair(A, V, i, j);
  }
  int best = 0;
  for (int j = 1; j < 4; ++j)
    if (A[j][j] > A[best][best]) best = j;
  double norm = 0;
  for (int j = 0; j < 4; ++j) norm += V[j][best] * V[j][best];
  for (int j = 0; j < 4; ++j) q[j] = V[j][best] / std::sqrt(norm);
}

double norm3(const double* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// t such that D takes the point `from` to the point `to`.
void place(double* D, const double* from, const double* to) {
  for (int i = 0; i < 3; ++i) D[4 * i + 3] = to[i] - (D[4 * i] * from[0] + D[4 * i + 1] * from[1] + D[4 * i + 2] * from[2]);
}

// Cholesky of the 6 x 6 normal matrix with a trace of damping, so that a free direction stays put.
bool solve6(double (&L)[6][6], double* b) {
  for (int i = 0; i < 6; ++i) L[i][i] += 1e-9 * L[i][i] + 1e-30;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      double s = L[i][j];
      for (int k = 0; k < j; ++k) s -= L[i][k] * L[j][k];
      if (i == j && !(s > 0)) return false;
      L[i][j] = i == j ? std::sqrt(s) : s / L[j][j];
    }
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < i; ++k) b[i] -= L[i][k] * b[k];
    b[i] /= L[i][i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) b[i] -= L[k][i] * b[k];
    b[i] /= L[i][i];
  }
  return true;
}

// The normal equations about c instead of the origin: p x n - c x n, that is J S with S = [I 0; [c x] I] in rows.
void shift(double (&H)[6][6], double* b, const double* c) {
  const double C[3][3] = {{0, -c[2], c[1]}, {c[2], 0, -c[0]}, {-c[1], c[0], 0}};
  double A[6][6];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) A[i][j] = i >= j ? H[i][j] : H[j][i];
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) b[i] -= C[i][k] * b[3 + k];
    for (int j = 0; j < 6; ++j)
      for (int k = 0; k < 3; ++k) A[i][j] -= C[i][k] * A[3 + k][j];
  }
  for (int j = 0; j < 3; ++j)
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 3; ++k) A[i][j] -= A[i][3 + k] * C[j][k];
  std::memcpy(H, A, sizeof A);
}

}  // namespace

Step horn_step(const Sums& sums) {
  const double* a = sums.v;
  const double n = a[0], p[3] = {a[4] / n, a[5] / n, a[6] / n}, q[3] = {a[7] / n, a[8] / n, a[9] / n};
  double N[3][3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) N[i][j] = a[10 + 3 * i + j] / n - p[i] * q[j];
  const double trace = N[0][0] + N[1][1] + N[2][2];
  double M[4][4];
  M[0][0] = trace;
  M[0][1] = M[1][0] = N[1][2] - N[2][1];
  M[0][2] = M[2][0] = N[2][0] - N[0][2];
  M[0][3] = M[3][0] = N[0][1] - N[1][0];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) M[i + 1][j + 1] = N[i][j] + N[j][i] - (i == j ? trace : 0);
  double r[4];
  largest_eigenvector(M, r);
  Step s;
  rotation(r, s.D);
  place(s.D, p, q);
  const double shift[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
  s.turn = 2 * std::atan2(norm3(r + 1), std::fabs(r[0]));
  s.move = norm3(shift);
  return s;
}

bool plane_step(const Sums& sums, Step& s) {
  const double* a = sums.v;
  const double c[3] = {a[4] / a[0], a[5] / a[0], a[6] / a[0]};
  double H[6][6], b[6];
  int k = 7;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) H[i][j] = a[k++];
  for (int i = 0; i < 6; ++i) b[i] = a[k++];
  shift(H, b, c);
  if (!solve6(H, b)) return false;
  const double angle = norm3(b), f = angle > 1e-9 ? std::sin(angle / 2) / angle : 0.5;
  const double q[4] = {std::cos(angle / 2), f * b[0], f * b[1], f * b[2]}, to[3] = {c[0] + b[3], c[1] + b[4], c[2] + b[5]};
  rotation(q, s.D);
  place(s.D, c, to);
  s.turn = angle;
  s.move = norm3(b + 3);
  return std::isfinite(s.turn) && std::isfinite(s.move);
}

void compose(const double* D, double* T) {
  double r[12];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 4; ++j)
      r[4 * i + j] = D[4 * i] * T[j] + D[4 * i + 1] * T[4 + j] + D[4 * i + 2] * T[8 + j] + (j == 3 ? D[4 * i + 3] : 0);
  std::memcpy(T, r, sizeof r);
}

}  // namespace avs
