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

// The normal equations of pose and amplitudes, a patch at a time: N (13, 13) and g (13).
struct Equations {
  int n = 6, strains = 0;  // dimensions of the observable part, and of them the amplitudes of the strain
  Joined basis;            // columns: the pose and the observable amplitudes
  std::vector<Joined> N;
  std::vector<Row> g;
};

// The observable combinations of the amplitudes, from the sum of N over all patches.
void observable(const PatchTable& t, const Joined& all, Equations& out) {
  const Six inverse = pseudo_inverse(total(t.normals, t.m));
  double points = 0, free[AMPLITUDES][AMPLITUDES];
  for (int64_t p = 0; p < t.m; ++p) points += (double)t.counts[p];
  for (int r = 0; r < AMPLITUDES; ++r)
    for (int c = 0; c < AMPLITUDES; ++c) {
      free[r][c] = all.v[6 + r][6 + c];
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) free[r][c] -= all.v[i][6 + r] * inverse.v[i][j] * all.v[j][6 + c];
    }
  const double least = OBSERVABLE * points, offset = free[6][6];
  Six alone, V;
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 6; ++c)
      alone.v[r][c] = 0.5 * (free[r][c] + free[c][r]) - 0.5 * (free[r][6] * free[6][c] + free[c][6] * free[6][r]) / std::max(offset, least);
  eigen(alone.v, V.v, 6, 1e-32);
  for (int k = 0; k < 6; ++k) out.basis.v[k][k] = 1;
  for (int k = 0; k < 6; ++k) {
    if (!(alone.v[k][k] > least)) continue;
    for (int i = 0; i < 6; ++i) out.basis.v[6 + i][6 + out.strains] = V.v[i][k];
    ++out.strains;
  }
  out.n = 6 + out.strains;
  if (offset > least) out.basis.v[12][out.n++] = 1;
}

void add(const Joined& A, Joined& to) {
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) to.v[i][j] += A.v[i][j];
}

Equations joined(const PatchTable& t, Joined& all) {
  Equations out;
  out.N.resize((size_t)t.m), out.g.resize((size_t)t.m);
  for (int64_t p = 0; p < t.m; ++p) {
    double T[3][6];
    Coupling A;
    strains(t, p, T);
    couple(t, p, T, A);
    Joined& N = out.N[p];
    Row& g = out.g[p];
    for (int i = 0; i < 6; ++i) {
      g[i] = t.gradients[6 * p + i];
      for (int j = 0; j < 6; ++j) N.v[i][j] = t.normals[36 * p + 6 * i + j];
      for (int c = 0; c < AMPLITUDES; ++c) N.v[i][6 + c] = N.v[6 + c][i] = A[i][c];
    }
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c < AMPLITUDES; ++c) N.v[6 + r][6 + c] = T[0][r] * A[3][c] + T[1][r] * A[4][c] + T[2][r] * A[5][c];
      N.v[12][6 + r] = N.v[6 + r][12];
      g[6 + r] = T[0][r] * g[3] + T[1][r] * g[4] + T[2][r] * g[5];
    }
    N.v[12][12] = (double)t.counts[p], g[12] = t.errors[p];
    add(N, all);
  }
  observable(t, all, out);
  return out;
}

Joined product(const Joined& A, const Joined& B) {
  Joined out;
  for (int i = 0; i < JOINED; ++i)
    for (int k = 0; k < JOINED; ++k)
      for (int j = 0; j < JOINED; ++j) out.v[i][j] += A.v[i][k] * B.v[k][j];
  return out;
}

Joined transposed(const Joined& A) {
  Joined out;
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) out.v[i][j] = A.v[j][i];
  return out;
}

// A B A'.
Joined about(const Joined& A, const Joined& B) { return product(product(A, B), transposed(A)); }

// Sum of the products of the entries.
double inner(const Joined& A, const Joined& B) {
  double sum = 0;
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) sum += A.v[i][j] * B.v[i][j];
  return sum;
}

// out += the covariance of the gradients of a patch: g g' enlarged by its leverage.
void add_spread(const Row& g, double enlarge, Joined& out) {
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) out.v[i][j] += g[i] * g[j] * enlarge;
}

double squares(const Joined& N) {
  double sum = 0;
  for (int i = 3; i < 6; ++i)
    for (int j = 3; j < 6; ++j) sum += N.v[i][j] * N.v[i][j];
  return sum;
}

// Rows of the displacements, or three columns.
using Three = std::array<Row, 3>;

// What the gradients of one scan say of displacements common to the patches of a block: sums over blocks, less those over
// patches, of the squared displacements' gradients (`found`), of their expectation for a unit variance (`expected`), and of
// what the fit of pose and amplitudes changes in both. With N the normal equations of a patch, n its displacements' rows,
// S = g g' the covariance of independent gradients and Q that of all, the fit adds K Q K' - 2 K S' to the covariance of the
// displacements' gradients, K = n N^+. The sums of n' n, n' S and n' n n_block are kept, so that the products with N^+ are
// made once.
struct Moments {
  double found = 0, expected = 0;
  Joined square, spread, moved;

  // `spread`: rows of the covariance; `own`: columns of the block's normal equations.
  void add(double weight, const Joined& N, const Row& g, const Three& rows, const Three& own) {
    found += weight * (g[3] * g[3] + g[4] * g[4] + g[5] * g[5]), expected += weight * squares(N);
    Three n = {}, through = {};  // n' n_own, as columns
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < JOINED; ++k) n[i][k] = weight * N.v[3 + i][k];
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < JOINED; ++k)
        for (int a = 0; a < 3; ++a) through[a][k] += n[i][k] * N.v[3 + i][3 + a];
    for (int k = 0; k < JOINED; ++k)
      for (int j = 0; j < JOINED; ++j) {
        square.v[k][j] += n[0][k] * N.v[3][j] + n[1][k] * N.v[4][j] + n[2][k] * N.v[5][j];
        spread.v[k][j] += n[0][k] * rows[0][j] + n[1][k] * rows[1][j] + n[2][k] * rows[2][j];
        moved.v[k][j] += through[0][k] * own[0][j] + through[1][k] * own[1][j] + through[2][k] * own[2][j];
      }
  }
};

// The displacements' columns of N.
Three columns(const Joined& N) {
  Three out;
  for (int a = 0; a < 3; ++a)
    for (int k = 0; k < JOINED; ++k) out[a][k] = N.v[k][3 + a];
  return out;
}

// Variance of the displacements of blocks by the method of moments, and its effect M on the gradients. The products of
// the gradients of different patches of a block, summed, have no contribution of errors within patches. `enlarge`: see
// add_spread; the fit correlates the gradients. `all`: the covariances of all patches, summed.
double block_variance(const PatchTable& t, const Equations& q, const std::vector<double>& enlarge, const Joined& all,
                      const Joined& inverse, Joined& M) {
  struct Block {
    Joined whole;
    Three rows{}, columns{};
    Row g{};
    double points = 0;
  };
  std::vector<int64_t> block;
  std::vector<Block> blocks((size_t)number_blocks(t, block));
  for (int64_t p = 0; p < t.m; ++p) {
    Block& b = blocks[(size_t)block[p]];
    b.points += (double)t.counts[p];
    add(q.N[p], b.whole);
    for (int i = 0; i < JOINED; ++i) b.g[i] += q.g[p][i];
    for (int a = 0; a < 3; ++a)
      for (int k = 0; k < JOINED; ++k) b.rows[a][k] += enlarge[p] * q.g[p][3 + a] * q.g[p][k];
  }
  Moments sums;
  double moved = 0;
  for (Block& b : blocks) {
    b.columns = columns(b.whole);
    for (int i = 0; i < JOINED; ++i)
      for (int j = 0; j < JOINED; ++j)
        M.v[i][j] += b.columns[0][i] * b.columns[0][j] + b.columns[1][i] * b.columns[1][j] + b.columns[2][i] * b.columns[2][j];
    sums.add(1 / b.points, b.whole, b.g, b.rows, b.columns);
    moved += squares(b.whole) / b.points;
  }
  for (int64_t p = 0; p < t.m; ++p) {
    const Block& b = blocks[(size_t)block[p]];
    Three rows;
    for (int a = 0; a < 3; ++a)
      for (int k = 0; k < JOINED; ++k) rows[a][k] = enlarge[p] * q.g[p][3 + a] * q.g[p][k];
    sums.add(-1 / b.points, q.N[p], q.g[p], rows, b.columns);
  }
  const Joined square = about(inverse, sums.square);
  const double expected = sums.expected + inner(square, M) - 2 * inner(sums.moved, inverse);
  if (!(expected > LEAST_DETERMINED * moved)) return 0;
  return std::max(0.0, (sums.found - inner(square, all) + 2 * inner(sums.spread, inverse)) / expected);
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
  Joined N, M, spread;
  Equations q = joined(t, N);
  const int n = q.n;
  Row g{};
  for (int64_t p = 0; p < t.m; ++p)
    for (int i = 0; i < JOINED; ++i) g[i] += q.g[p][i];
  const Joined back = transposed(q.basis), reduced = product(pseudo_inverse(about(back, N), n), back), inverse = product(q.basis, reduced);
  double fit[JOINED] = {}, all[JOINED] = {};  // of the observable part, and of pose and amplitudes
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) fit[i] += reduced.v[i][j] * g[j], all[i] += inverse.v[i][j] * g[j];
  const std::vector<double> enlarge = take_fit(q, inverse, all);
  for (int64_t p = 0; p < t.m; ++p) add_spread(q.g[p], enlarge[p], spread);
  out.block = block_variance(t, q, enlarge, spread, inverse, M);
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) spread.v[i][j] += out.block * M.v[i][j];
  const Joined P = about(reduced, spread);
  const double strain = common_variance(fit, P, 6, q.strains);
  for (int k = 0; k < 6; ++k) out.smooth[k] = strain, out.fit[k] = fit[k];
  out.smooth[6] = common_variance(fit, P, 6 + q.strains, n - 6 - q.strains);
  for (int r = 0; r < AMPLITUDES; ++r) out.amplitudes[r] = all[6 + r];
  return out;
}

}  // namespace avs
