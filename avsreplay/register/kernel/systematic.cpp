// Errors of model and ranges that vary slowly over the target, estimated from the residuals of one scan.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "covariance.hpp"

namespace avs {
namespace {

constexpr double BLOCK = 4;                // patches along a side of a block
constexpr int64_t LEAST_PATCHES = 24;      // with fewer nothing is estimated
constexpr double OBSERVABLE = 1e-4;        // an amplitude whose mean squared residual per unit is less is not fitted
constexpr double SIGNIFICANT = 4.0;        // twice the log likelihood ratio: 2 % of scans without such errors exceed it
constexpr double LEAST_DETERMINED = 0.05;  // with less of the displacements of blocks left by the fit they are not estimated
constexpr int ROUNDS = 8;                  // of the maximum likelihood estimate; the last ones change nothing
constexpr int PAIRS[6][2] = {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}};  // of a strain
constexpr int JOINED = 6 + AMPLITUDES;     // pose and amplitudes
using Joined = Square<JOINED>;
using Row = std::array<double, JOINED>;

// The normal equations of pose and amplitudes, a patch at a time: N (n, n) and g (n).
struct Equations {
  int n = 6, strains = 0;  // of them the amplitudes of the strain
  double basis[AMPLITUDES][AMPLITUDES] = {};  // columns: the observable amplitudes
  std::vector<Joined> N;
  std::vector<Row> g;
};

// The observable combinations of the amplitudes, from the sums F (7, 7) and A (6, 7) over all patches.
void observable(const PatchTable& t, const Square<AMPLITUDES>& F, const Coupling& A, Equations& out) {
  const Six inverse = pseudo_inverse(total(t.normals, t.m));
  double points = 0, free[AMPLITUDES][AMPLITUDES];
  for (int64_t p = 0; p < t.m; ++p) points += (double)t.counts[p];
  for (int r = 0; r < AMPLITUDES; ++r)
    for (int c = 0; c < AMPLITUDES; ++c) {
      free[r][c] = F.v[r][c];
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) free[r][c] -= A[i][r] * inverse.v[i][j] * A[j][c];
    }
  const double least = OBSERVABLE * points, offset = free[6][6];
  Six alone, V;
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 6; ++c)
      alone.v[r][c] = 0.5 * (free[r][c] + free[c][r]) - 0.5 * (free[r][6] * free[6][c] + free[c][6] * free[6][r]) / std::max(offset, least);
  eigen(alone.v, V.v, 6, 1e-32);
  for (int k = 0; k < 6; ++k) {
    if (!(alone.v[k][k] > least)) continue;
    for (int i = 0; i < 6; ++i) out.basis[i][out.strains] = V.v[i][k];
    ++out.strains;
  }
  out.n = 6 + out.strains;
  if (offset > least) out.basis[6][out.n++ - 6] = 1;
}

Equations joined(const PatchTable& t) {
  Equations out;
  std::vector<Square<AMPLITUDES>> F((size_t)t.m);
  std::vector<Coupling> A((size_t)t.m);
  std::vector<std::array<double, AMPLITUDES>> e((size_t)t.m);
  Square<AMPLITUDES> all;
  Coupling coupling{};
  for (int64_t p = 0; p < t.m; ++p) {
    double T[3][6];
    strains(t, p, T);
    couple(t, p, T, A[p]);
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c < AMPLITUDES; ++c) F[p].v[r][c] = T[0][r] * A[p][3][c] + T[1][r] * A[p][4][c] + T[2][r] * A[p][5][c];
      F[p].v[6][r] = F[p].v[r][6];
      const double* g = t.gradients + 6 * p + 3;
      e[p][r] = T[0][r] * g[0] + T[1][r] * g[1] + T[2][r] * g[2];
    }
    F[p].v[6][6] = (double)t.counts[p], e[p][6] = t.errors[p];
    for (int r = 0; r < AMPLITUDES; ++r)
      for (int c = 0; c < AMPLITUDES; ++c) all.v[r][c] += F[p].v[r][c];
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < AMPLITUDES; ++c) coupling[i][c] += A[p][i][c];
  }
  observable(t, all, coupling, out);
  out.N.resize((size_t)t.m), out.g.resize((size_t)t.m);
  const int k = out.n - 6;
  for (int64_t p = 0; p < t.m; ++p) {
    Joined& N = out.N[p];
    double FB[AMPLITUDES][AMPLITUDES];
    for (int i = 0; i < 6; ++i) {
      out.g[p][i] = t.gradients[6 * p + i];
      for (int j = 0; j < 6; ++j) N.v[i][j] = t.normals[36 * p + 6 * i + j];
      for (int c = 0; c < k; ++c) {
        double sum = 0;
        for (int r = 0; r < AMPLITUDES; ++r) sum += A[p][i][r] * out.basis[r][c];
        N.v[i][6 + c] = N.v[6 + c][i] = sum;
      }
    }
    for (int r = 0; r < AMPLITUDES; ++r)
      for (int c = 0; c < k; ++c) {
        FB[r][c] = 0;
        for (int i = 0; i < AMPLITUDES; ++i) FB[r][c] += F[p].v[r][i] * out.basis[i][c];
      }
    for (int r = 0; r < k; ++r) {
      out.g[p][6 + r] = 0;
      for (int i = 0; i < AMPLITUDES; ++i) out.g[p][6 + r] += e[p][i] * out.basis[i][r];
      for (int c = 0; c <= r; ++c) {
        double sum = 0;
        for (int i = 0; i < AMPLITUDES; ++i) sum += out.basis[i][r] * FB[i][c];
        N.v[6 + r][6 + c] = N.v[6 + c][6 + r] = sum;
      }
    }
  }
  return out;
}

// What follows runs over all JOINED rows and columns; those from n on are zero.

// out += the covariance of the gradients of a patch: g g' enlarged by its leverage; `first` to `last`: rows.
void add_spread(const Row& g, double enlarge, int first, int last, Joined& out) {
  for (int i = first; i < last; ++i)
    for (int j = 0; j < JOINED; ++j) out.v[i][j] += g[i] * g[j] * enlarge;
}

// What the fit of pose and amplitudes adds to the sum of squares of independent gradients: K Q K' - 2 K S' of the three
// displacements, with K their rows of N N^+ and S the same rows of the covariance of the gradients. `squares`: K' K.
double fitted(const Joined& K, const Joined& S, const Joined& squares, const Joined& Q) {
  double sum = 0;
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) sum += squares.v[i][j] * Q.v[i][j];
  for (int i = 3; i < 6; ++i)
    for (int j = 0; j < JOINED; ++j) sum -= 2 * S.v[i][j] * K.v[i][j];
  return sum;
}

double squares(const Joined& N) {
  double sum = 0;
  for (int i = 3; i < 6; ++i)
    for (int j = 3; j < 6; ++j) sum += N.v[i][j] * N.v[i][j];
  return sum;
}

// out += A B' with the displacements' columns of A and B; `first` to `last`: rows.
void add_outer(const Joined& A, const Joined& B, int first, int last, Joined& out) {
  for (int i = first; i < last; ++i)
    for (int j = 0; j < JOINED; ++j)
      out.v[i][j] += A.v[i][3] * B.v[j][3] + A.v[i][4] * B.v[j][4] + A.v[i][5] * B.v[j][5];
}

// The displacements' rows of A B.
Joined rows_of_product(const Joined& A, const Joined& B) {
  Joined out;
  for (int i = 3; i < 6; ++i)
    for (int k = 0; k < JOINED; ++k)
      for (int j = 0; j < JOINED; ++j) out.v[i][j] += A.v[i][k] * B.v[k][j];
  return out;
}

// What the gradients of one scan say of displacements common to the patches of a block.
struct Moments {
  double found = 0, expected = 0, moved = 0;  // sums of squares, and what they are for a unit variance
};

void add_moments(double weight, const Joined& N, const Row& g, const Joined& S, const Joined& M, const Joined& all,
                 const Joined& of_blocks, const Joined& inverse, Moments& to) {
  const Joined K = rows_of_product(N, inverse);
  Joined both;
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) both.v[i][j] = K.v[3][i] * K.v[3][j] + K.v[4][i] * K.v[4][j] + K.v[5][i] * K.v[5][j];
  const double own = g[3] * g[3] + g[4] * g[4] + g[5] * g[5];
  to.found += weight * (own - fitted(K, S, both, all));
  to.expected += weight * (squares(N) + fitted(K, M, both, of_blocks));
}

// Variance of the displacements of blocks by the method of moments, and its effect M on the gradients. The products of
// the gradients of different patches of a block, summed, have no contribution of errors within patches. `enlarge`: see
// add_spread; the fit correlates the gradients. `all`: the covariances of all patches, summed.
double block_variance(const PatchTable& t, const Equations& q, const std::vector<double>& enlarge, const Joined& all,
                      const Joined& inverse, Joined& M) {
  std::vector<int64_t> block;
  const int64_t blocks = number_blocks(t, block);
  std::vector<Joined> whole((size_t)blocks), spread((size_t)blocks);
  std::vector<Row> g((size_t)blocks, Row{});
  std::vector<double> points((size_t)blocks, 0);
  for (int64_t p = 0; p < t.m; ++p) {
    const int64_t b = block[p];
    points[b] += (double)t.counts[p];
    for (int i = 0; i < JOINED; ++i) {
      g[b][i] += q.g[p][i];
      for (int j = 0; j < JOINED; ++j) whole[b].v[i][j] += q.N[p].v[i][j];
    }
    add_spread(q.g[p], enlarge[p], 3, 6, spread[b]);
  }
  for (int64_t b = 0; b < blocks; ++b) add_outer(whole[b], whole[b], 0, JOINED, M);
  Moments of_blocks, of_patches;
  double moved = 0;
  for (int64_t b = 0; b < blocks; ++b) {
    Joined own;
    add_outer(whole[b], whole[b], 3, 6, own);
    add_moments(1 / points[b], whole[b], g[b], spread[b], own, all, M, inverse, of_blocks);
    moved += squares(whole[b]) / points[b];
  }
  for (int64_t p = 0; p < t.m; ++p) {
    Joined own, of_patch;
    add_outer(q.N[p], whole[block[p]], 3, 6, own);
    add_spread(q.g[p], enlarge[p], 3, 6, of_patch);
    add_moments(1 / points[block[p]], q.N[p], q.g[p], of_patch, own, all, M, inverse, of_patches);
  }
  const double expected = of_blocks.expected - of_patches.expected;
  if (!(expected > LEAST_DETERMINED * moved)) return 0;
  return std::max(0.0, (of_blocks.found - of_patches.found) / expected);
}

// Variance t of the `size` values from `first` on, ~ N(0, t I + P), of greatest likelihood, by weighted moments; 0 where it
// is not significant.
double common_variance(const double* values, const Joined& P, int first, int size) {
  if (size == 0) return 0;
  Six A, V;
  for (int i = 0; i < size; ++i)
    for (int j = 0; j < size; ++j) A.v[i][j] = P.v[first + i][first + j];
  eigen(A.v, V.v, size, 1e-32);
  double square[6], variance[6], t = 0;
  for (int k = 0; k < size; ++k) {
    double along = 0;
    for (int i = 0; i < size; ++i) along += V.v[i][k] * values[first + i];
    square[k] = along * along, variance[k] = std::max(A.v[k][k], std::numeric_limits<double>::min());
    t += (square[k] - variance[k]) / size;
  }
  t = std::max(0.0, t);
  for (int round = 0; round < ROUNDS; ++round) {
    double sum = 0, weights = 0;
    for (int k = 0; k < size; ++k) {
      const double w = 1 / ((variance[k] + t) * (variance[k] + t));
      sum += w * (square[k] - variance[k]), weights += w;
    }
    t = std::max(0.0, sum / weights);
  }
  double evidence = 0;
  for (int k = 0; k < size; ++k) {
    const double ratio = variance[k] / (variance[k] + t);
    evidence += square[k] / variance[k] * (1 - ratio) + std::log(ratio);
  }
  return evidence > SIGNIFICANT ? t : 0;
}

// Takes the fit from the gradients, and returns how much the leverage of each patch enlarges their covariance.
std::vector<double> take_fit(Equations& q, const Joined& inverse, const double* fit) {
  std::vector<double> enlarge(q.N.size());
  for (size_t p = 0; p < enlarge.size(); ++p) {
    double leverage = 0;
    Row& g = q.g[p];
    for (int i = 0; i < JOINED; ++i)
      for (int j = 0; j < JOINED; ++j) g[i] -= q.N[p].v[i][j] * fit[j], leverage += q.N[p].v[i][j] * inverse.v[i][j];
    enlarge[p] = 1 / std::max(1 - leverage / q.n, 0.5);
  }
  return enlarge;
}

}  // namespace

// Displacement of the middle of a patch per amplitude of the strain.
void strains(const PatchTable& t, int64_t p, double (&T)[3][6]) {
  std::memset(T, 0, sizeof T);
  double q[3];
  for (int a = 0; a < 3; ++a) q[a] = (t.places[3 * p + a] - t.centre[a]) / t.extent;
  for (int k = 0; k < 6; ++k) {
    const int i = PAIRS[k][0], j = PAIRS[k][1];
    T[i][k] += q[j];
    if (i != j) T[j][k] += q[i];
  }
}

// Sums over a patch of J times the residual per amplitude.
void couple(const PatchTable& t, int64_t p, const double (&T)[3][6], Coupling& A) {
  const double* N = t.normals + 36 * p;
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < 6; ++k) A[i][k] = N[6 * i + 3] * T[0][k] + N[6 * i + 4] * T[1][k] + N[6 * i + 5] * T[2][k];
    A[i][6] = t.offsets[6 * p + i];
  }
}

// The number of the block of each patch, in the order of the blocks' places; returns how many there are.
int64_t number_blocks(const PatchTable& t, std::vector<int64_t>& number) {
  std::vector<std::array<double, 3>> cube((size_t)t.m);
  std::vector<int64_t> order((size_t)t.m);
  for (int64_t p = 0; p < t.m; ++p) {
    for (int a = 0; a < 3; ++a) cube[p][a] = std::floor(t.places[3 * p + a] / (BLOCK * t.side));
    order[p] = p;
  }
  std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return cube[a] < cube[b]; });
  number.resize((size_t)t.m);
  int64_t n = 0;
  for (int64_t k = 0; k < t.m; ++k) {
    if (k && cube[order[k]] != cube[order[k - 1]]) ++n;
    number[order[k]] = n;
  }
  return t.m ? n + 1 : 0;
}

Systematic systematic_errors(const PatchTable& t) {
  Systematic out;
  int64_t most = 0;
  for (int64_t p = 0; p < t.m; ++p) most = std::max(most, t.counts[p]);
  if (t.m < LEAST_PATCHES || most == 1) return out;
  Equations q = joined(t);
  const int n = q.n;
  Joined N, M, spread, P;
  double g[JOINED] = {}, fit[JOINED] = {};
  for (int64_t p = 0; p < t.m; ++p)
    for (int i = 0; i < n; ++i) {
      g[i] += q.g[p][i];
      for (int j = 0; j < n; ++j) N.v[i][j] += q.N[p].v[i][j];
    }
  const Joined inverse = pseudo_inverse(N, n);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) fit[i] += inverse.v[i][j] * g[j];
  const std::vector<double> enlarge = take_fit(q, inverse, fit);
  for (int64_t p = 0; p < t.m; ++p) add_spread(q.g[p], enlarge[p], 0, JOINED, spread);
  out.block = block_variance(t, q, enlarge, spread, inverse, M);
  Joined half;
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < n; ++k)
      for (int j = 0; j < n; ++j) half.v[i][j] += inverse.v[i][k] * (spread.v[k][j] + out.block * M.v[k][j]);
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < n; ++k)
      for (int j = 0; j < n; ++j) P.v[i][j] += half.v[i][k] * inverse.v[k][j];
  const double strain = common_variance(fit, P, 6, q.strains);
  for (int k = 0; k < 6; ++k) out.smooth[k] = strain, out.fit[k] = fit[k];
  out.smooth[6] = common_variance(fit, P, 6 + q.strains, n - 6 - q.strains);
  for (int r = 0; r < AMPLITUDES; ++r)
    for (int c = 0; c < n - 6; ++c) out.amplitudes[r] += q.basis[r][c] * fit[6 + c];
  return out;
}

}  // namespace avs
