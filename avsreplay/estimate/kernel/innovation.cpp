#include "innovation.hpp"

#include <cmath>
#include <cstring>
#include <stdexcept>

#include "covariance.hpp"
#include "elimination.hpp"

namespace avs {
namespace {

constexpr int FIXTURE = 14, MISALIGNED = 17;  // error states: fixture in {B}, attitude of {C} in {B}

// Entries of geometry.matrix, for the same bits.
M3 rotation(const double q[4]) {
  const double x = q[0], y = q[1], z = q[2], w2 = 2 * q[3], square = x * x + y * y + z * z;
  const double xy = 2 * (x * y), xz = 2 * (x * z), yz = 2 * (y * z);
  return {{{1 + 2 * (x * x - square), xy - w2 * z, w2 * y + xz},
           {w2 * z + xy, 1 + 2 * (y * y - square), yz - w2 * x},
           {xz - w2 * y, w2 * x + yz, 1 + 2 * (z * z - square)}}};
}

}  // namespace

bool definite(const double A[SEEN][SEEN]) {
  double L[SEEN][SEEN];
  return cholesky<SEEN>(A, L);
}

void pose_jacobian(const State& x, double H[SEEN][DIM]) {
  const M3 A = matrix(quad(x.q_ab)), arm = A * skew(-2.0 * vector(x.c_b));
  std::memset(H, 0, SEEN * DIM * sizeof(double));
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) {
      H[r][c] = arm.x[r][c];
      H[r][FIXTURE + c] = A.x[r][c];
    }
    H[r][6 + r] = H[3 + r][r] = H[3 + r][MISALIGNED + r] = 1;
  }
}

void pose_covariance(const Square P, const double H[SEEN][DIM], double out[SEEN][SEEN]) {
  double HP[SEEN][DIM];
  product<SEEN, DIM>(H, P, HP);
  for (int r = 0; r < SEEN; ++r) {
    double s[SEEN] = {};
    for (int i = 0; i < DIM; ++i)
      for (int c = 0; c < SEEN; ++c) s[c] += HP[r][i] * H[c][i];
    std::memcpy(out[r], s, sizeof s);
  }
}

double innovation(const Square P, const double H[SEEN][DIM], const double e[SEEN], const double R[SEEN][SEEN],
                  double S[SEEN][SEEN]) {
  double C[SEEN][SEEN], x[SEEN], squared = 0;
  pose_covariance(P, H, C);
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) S[r][c] = 0.5 * ((C[r][c] + R[r][c]) + (C[c][r] + R[c][r]));
  std::memcpy(x, e, sizeof x);
  solve<SEEN>(S, x);
  for (int r = 0; r < SEEN; ++r) squared += e[r] * x[r];
  return squared;
}

double trace_of_ratio(const double part[SEEN][SEEN], const double total[SEEN][SEEN]) {
  double B[SEEN][SEEN], trace = 0;
  std::memcpy(B, part, sizeof B);
  solve<SEEN, SEEN>(total, B);
  for (int r = 0; r < SEEN; ++r) trace += B[r][r];
  return trace;
}

double squared_traces(const double part[SEEN][SEEN], const double total[SEEN][SEEN]) {
  double B[SEEN][SEEN], trace = 0, squares = 0;
  std::memcpy(B, part, sizeof B);
  solve<SEEN, SEEN>(total, B);
  for (int r = 0; r < SEEN; ++r) {
    trace += B[r][r];
    for (int c = 0; c < SEEN; ++c) squares += B[r][c] * B[c][r];
  }
  return squares + trace * trace;
}

void block_squares(const double R[SEEN][SEEN], const double e[SEEN], const double C[SEEN][SEEN], double squares[2],
                   double known[2]) {
  const auto place = [](int k) { return (k + 3) % SEEN; };  // of attitude before position
  double exchanged[SEEN][SEEN], root[SEEN][SEEN];
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) exchanged[r][c] = R[place(r)][place(c)];
  if (!inverse_root(exchanged, root)) throw std::invalid_argument("a covariance is not positive definite");
  squares[0] = squares[1] = known[0] = known[1] = 0;
  for (int r = 0; r < SEEN; ++r) {
    const int block = r < 3;
    double white = 0, variance = 0;
    for (int i = 0; i <= r; ++i) {
      white += root[r][i] * e[place(i)];
      for (int j = 0; j <= r; ++j) variance += root[r][i] * C[place(i)][place(j)] * root[r][j];
    }
    squares[block] += white * white;
    known[block] += variance;
  }
}

void shift(State& x, const double s[3]) {
  const V3 moved = rotation(x.q_bc) * vector(s);
  for (int k = 0; k < 3; ++k) x.c_b[k] += moved.x[k];
}

void shift(State& x, Square P, const double s[3]) {
  const V3 was = vector(x.c_b);
  shift(x, s);
  const M3 J = skew(2.0 * (was - vector(x.c_b)));  // A(dmu mu) = (1 + 2 [dmu x]) A(mu)
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < DIM; ++c)
      P[FIXTURE + r][c] += J.x[r][0] * P[MISALIGNED][c] + J.x[r][1] * P[MISALIGNED + 1][c] + J.x[r][2] * P[MISALIGNED + 2][c];
  for (int r = 0; r < DIM; ++r) {
    double* row = P[r];
    double by[3];
    for (int c = 0; c < 3; ++c) by[c] = row[MISALIGNED] * J.x[c][0] + row[MISALIGNED + 1] * J.x[c][1] + row[MISALIGNED + 2] * J.x[c][2];
    for (int c = 0; c < 3; ++c) row[FIXTURE + c] += by[c];
  }
}

}  // namespace avs
