#include "step.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "symmetric.hpp"

namespace avs {
namespace {

// Rotation of a unit quaternion, scalar first.
void rotation(const double* q, double* D) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  D[0] = 1 - 2 * (y * y + z * z), D[1] = 2 * (x * y - w * z), D[2] = 2 * (x * z + w * y);
  D[4] = 2 * (x * y + w * z), D[5] = 1 - 2 * (x * x + z * z), D[6] = 2 * (y * z - w * x);
  D[8] = 2 * (x * z - w * y), D[9] = 2 * (y * z + w * x), D[10] = 1 - 2 * (x * x + y * y);
}

// Unit eigenvector of the largest eigenvalue of a symmetric matrix, by Jacobi's rotations.
void largest_eigenvector(double (&A)[4][4], double* q) {
  double V[4][4];
  eigen(A, V, 4, 1e-36);
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

constexpr double OBSERVABLE = 1e-6;  // least eigenvalue over the largest, with turns in units of the inliers' radius

// b = H^+ b without the directions that are not observable; `radius`: turns times it are lengths.
bool solve6(double (&H)[6][6], double* b, double& radius) {
  const double turns = H[0][0] + H[1][1] + H[2][2], shifts = H[3][3] + H[4][4] + H[5][5];
  if (!(turns > 0 && shifts > 0 && std::isfinite(turns) && std::isfinite(shifts))) return false;
  radius = std::sqrt(turns / shifts);
  double A[6][6], V[6][6], c[6], x[6] = {};
  for (int i = 0; i < 6; ++i) {
    c[i] = b[i] / (i < 3 ? radius : 1);
    for (int j = 0; j < 6; ++j) A[i][j] = H[i][j] / ((i < 3 ? radius : 1) * (j < 3 ? radius : 1));
  }
  eigen(A, V, 6, 1e-32);
  double most = 0;
  for (int k = 0; k < 6; ++k) most = A[k][k] > most ? A[k][k] : most;
  for (int k = 0; k < 6; ++k) {
    if (!(A[k][k] > OBSERVABLE * most)) continue;
    double along = 0;
    for (int i = 0; i < 6; ++i) along += V[i][k] * c[i];
    for (int i = 0; i < 6; ++i) x[i] += V[i][k] * along / A[k][k];
  }
  for (int i = 0; i < 6; ++i) b[i] = x[i] / (i < 3 ? radius : 1);
  return most > 0;
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

bool plane_step(const Sums& sums, double longest, Step& s) {
  const double* a = sums.v;
  const double c[3] = {a[4] / a[0], a[5] / a[0], a[6] / a[0]};
  Motion m{{}, {c[0], c[1], c[2]}, 0, 0};
  double H[6][6];
  int k = 7;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) H[i][j] = a[k++];
  for (int i = 0; i < 6; ++i) m.d[i] = a[k++];
  shift(H, m.d, c);
  return solve6(H, m.d, m.radius) && to_step(m, longest, s);
}

bool newton_motion(const Sums& sums, Motion& m) {
  const double* a = sums.v;
  // - gradient = [sum p x foot; sum foot - p].
  m = {{a[15] - a[17], a[16] - a[12], a[11] - a[13], a[7] - a[4], a[8] - a[5], a[9] - a[6]},
       {a[4] / a[0], a[5] / a[0], a[6] / a[0]},
       0,
       0};
  double H[6][6];
  int k = 19;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) H[i][j] = a[k++];
  // The part that resists motion in every direction: [|p|^2 I - p p', [p]; [p]', I], lower triangle.
  const double w = a[40], *p = a + 41, *pp = a + 44, trace = pp[0] + pp[2] + pp[5];
  k = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j <= i; ++j) H[i][j] += (i == j ? trace : 0) - pp[k++];
  for (int i = 0; i < 3; ++i) H[3 + i][3 + i] += w;
  H[3][1] += p[2], H[3][2] -= p[1], H[4][0] -= p[2], H[4][2] += p[0], H[5][0] += p[1], H[5][1] -= p[0];
  shift(H, m.d, m.centre);
  double downhill[6];
  std::copy(m.d, m.d + 6, downhill);
  if (!solve6(H, m.d, m.radius)) return false;
  for (int i = 0; i < 6; ++i) m.slope += downhill[i] * m.d[i];
  return true;
}

bool to_step(Motion m, double longest, Step& s) {
  double *d = m.d, *c = m.centre;
  const double length = m.radius * norm3(d) + norm3(d + 3);
  if (length > longest)
    for (int i = 0; i < 6; ++i) d[i] *= longest / length;
  const double angle = norm3(d), f = angle > 1e-9 ? std::sin(angle / 2) / angle : 0.5;
  const double q[4] = {std::cos(angle / 2), f * d[0], f * d[1], f * d[2]}, to[3] = {c[0] + d[3], c[1] + d[4], c[2] + d[5]};
  rotation(q, s.D);
  place(s.D, c, to);
  s.turn = angle;
  s.move = norm3(d + 3);
  s.length = length < longest ? length : longest;
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
