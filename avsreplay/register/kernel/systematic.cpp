// Errors of model and ranges that vary slowly over the target, estimated from the residuals of one scan.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <iterator>
#include <limits>

#include "covariance.hpp"

namespace avs {
namespace {

constexpr double BLOCK = 4;                // patches along a side of a block
constexpr int64_t LEAST_PATCHES = 24;      // with fewer nothing is estimated
constexpr double OBSERVABLE_MODE = 1e-4;        // an amplitude whose mean squared residual per unit is less is not fitted
constexpr double SIGNIFICANT = 4.0;        // twice the log likelihood ratio: 2 % of scans without such errors exceed it
constexpr double LEAST_UNEXPLAINED = 0.05;  // with less of the displacements of blocks left by the fit they are not estimated
constexpr int ROUNDS = 8;                  // of the maximum likelihood estimate; the last ones change nothing
constexpr int PAIRS[6][2] = {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}};  // of a strain
constexpr int JOINED = 6 + SURFACE;        // pose and amplitudes of the surface
// Over the rms radius of the image: the lengths over which an error of the ranges may vary, as likely before the scan, and
// that of the modes. A length of 0.7 radii makes the error too small whose constant and linear terms no residual shows.
constexpr double MODES = 1.4142135623730951, LENGTHS[3] = {1, MODES, 2};
constexpr double OBSERVABLE_RANGES = 3e-4;  // as OBSERVABLE_MODE, for the modes of the ranges
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
  const Six& inverse = t.total.inverse;
  double points = 0, free[SURFACE][SURFACE];
  for (int64_t p = 0; p < t.m; ++p) points += (double)t.counts[p];
  for (int r = 0; r < SURFACE; ++r)
    for (int c = 0; c < SURFACE; ++c) {
      free[r][c] = all.v[6 + r][6 + c];
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) free[r][c] -= all.v[i][6 + r] * inverse.v[i][j] * all.v[j][6 + c];
    }
  const double least = OBSERVABLE_MODE * points, offset = free[6][6];
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
    strains(t, p, T);
    const Coupling& A = t.coupling[(size_t)p];
    Joined& N = out.N[p];
    Row& g = out.g[p];
    for (int i = 0; i < 6; ++i) {
      g[i] = t.gradients[6 * p + i];
      for (int j = 0; j < 6; ++j) N.v[i][j] = t.normals[36 * p + 6 * i + j];
      for (int c = 0; c < SURFACE; ++c) N.v[i][6 + c] = N.v[6 + c][i] = A[i][c];
    }
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c < SURFACE; ++c) N.v[6 + r][6 + c] = T[0][r] * A[3][c] + T[1][r] * A[4][c] + T[2][r] * A[5][c];
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

// The displacements' rows of a symmetric matrix.
using Three = std::array<Row, 3>;

Three displacements(const Joined& N) {
  Three out;
  for (int a = 0; a < 3; ++a)
    for (int k = 0; k < JOINED; ++k) out[a][k] = N.v[3 + a][k];
  return out;
}

// Sum of the entries, in their order.
double sum(const Row& x) {
  double all = 0;
  for (const double value : x) all += value;
  return all;
}

// out += a b'.
void add_outer(double factor, const Row& a, const Row& b, Joined& out) {
  for (int i = 0; i < JOINED; ++i) {
    const double f = factor * a[i];
    for (int j = 0; j < JOINED; ++j) out.v[i][j] += f * b[j];
  }
}

double squares(const Three& n) {
  double sum = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = 3; j < 6; ++j) sum += n[i][j] * n[i][j];
  return sum;
}

// What the gradients of one scan say of displacements common to the patches of a block: sums over blocks, less those over
// patches, of the squared displacements' gradients (`found`), of their expectation for a unit variance (`expected`), and of
// what the fit of pose and amplitudes changes in both. With N the normal equations of a patch, n its displacements' rows,
// S = g g' the covariance of independent gradients and Q that of all, the fit adds K Q K' - 2 K S' to the covariance of the
// displacements' gradients, K = n N^+. The sums of n' n, n' S and n' n (N^+ n_block) are kept, so that the products with N^+
// are made once.
struct Moments {
  double found = 0, expected = 0;
  Joined square, spread;
  Row moved{};

  // `own`: N^+ times the displacements' columns of the block.
  void add(double weight, const Three& n, const Row& g, const Three& own) {
    found += weight * (g[3] * g[3] + g[4] * g[4] + g[5] * g[5]), expected += weight * squares(n);
    for (int k = 0; k < JOINED; ++k) {
      const double x = weight * n[0][k], y = weight * n[1][k], z = weight * n[2][k];
      for (int j = 0; j < JOINED; ++j) square.v[k][j] += x * n[0][j] + y * n[1][j] + z * n[2][j];
    }
    for (int a = 0; a < 3; ++a) {
      const double x = weight * n[0][3 + a], y = weight * n[1][3 + a], z = weight * n[2][3 + a];
      for (int k = 0; k < JOINED; ++k) moved[k] += (x * n[0][k] + y * n[1][k] + z * n[2][k]) * own[a][k];
    }
  }
};

// Variance of the displacements of blocks by the method of moments, and its effect M on the gradients. The products of
// the gradients of different patches of a block, summed, have no contribution of errors within patches. `enlarge`: see
// take_fit; the fit correlates the gradients. `all`: the covariances of all patches, summed.
double block_variance(const PatchTable& t, const Equations& q, const std::vector<double>& enlarge, const Joined& all,
                      const Joined& inverse, Joined& M) {
  struct Block {
    Three n{}, own{}, spread{};
    Row g{};
    double points = 0;
  };
  std::vector<Block> blocks((size_t)t.blocks);
  for (int64_t p = 0; p < t.m; ++p) {
    Block& b = blocks[(size_t)t.block[p]];
    b.points += (double)t.counts[p];
    const Row& g = q.g[p];
    for (int a = 0; a < 3; ++a) {
      const double f = enlarge[p] * g[3 + a];
      for (int k = 0; k < JOINED; ++k) b.n[a][k] += q.N[p].v[3 + a][k], b.spread[a][k] += f * g[k];
    }
    for (int i = 0; i < JOINED; ++i) b.g[i] += g[i];
  }
  Moments sums;
  double moved = 0;
  for (Block& b : blocks) {
    for (int a = 0; a < 3; ++a) {
      add_outer(1, b.n[a], b.n[a], M), add_outer(1 / b.points, b.n[a], b.spread[a], sums.spread);
      for (int i = 0; i < JOINED; ++i)
        for (int j = 0; j < JOINED; ++j) b.own[a][j] += inverse.v[i][j] * b.n[a][i];
    }
    sums.add(1 / b.points, b.n, b.g, b.own);
    moved += squares(b.n) / b.points;
  }
  for (int64_t p = 0; p < t.m; ++p) {
    const Block& b = blocks[(size_t)t.block[p]];
    const Three n = displacements(q.N[p]);
    const Row& g = q.g[p];
    Row along;
    for (int k = 0; k < JOINED; ++k) along[k] = g[3] * n[0][k] + g[4] * n[1][k] + g[5] * n[2][k];
    add_outer(-enlarge[p] / b.points, along, g, sums.spread);
    sums.add(-1 / b.points, n, g, b.own);
  }
  const Joined square = about(inverse, sums.square);
  const double expected = sums.expected + inner(square, M) - 2 * sum(sums.moved);
  if (!(expected > LEAST_UNEXPLAINED * moved)) return 0;
  return std::max(0.0, (sums.found - inner(square, all) + 2 * inner(sums.spread, inverse)) / expected);
}

// A variance of greatest likelihood, and twice the logarithm of its likelihood over that of none.
struct Likely {
  double variance = 0, gain = 0;
};

// The variance t of the `size` values from `first` on, ~ N(0, t I + P), by weighted moments.
template <int N>
Likely likely_variance(const double* values, const Square<N>& P, int first, int size) {
  if (size == 0) return {};
  Square<N> A, V;
  for (int i = 0; i < size; ++i)
    for (int j = 0; j < size; ++j) A.v[i][j] = P.v[first + i][first + j];
  eigen(A.v, V.v, size, 1e-32);
  double square[N], variance[N], t = 0;
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
  return {t, evidence};
}

// The same, 0 where it is not significant.
template <int N>
double common_variance(const double* values, const Square<N>& P, int first, int size) {
  const Likely found = likely_variance(values, P, first, size);
  return found.gain > SIGNIFICANT ? found.variance : 0;
}


// Takes the fit from the gradients, and returns how much the leverage of each patch enlarges their covariance.
std::vector<double> take_fit(Equations& q, const Joined& inverse, const double* fit) {
  std::vector<double> enlarge(q.N.size());
  for (size_t p = 0; p < enlarge.size(); ++p) {
    Row& g = q.g[p];
    Row leverage{};
    for (int i = 0; i < JOINED; ++i)
      for (int j = 0; j < JOINED; ++j) g[j] -= q.N[p].v[i][j] * fit[i], leverage[j] += q.N[p].v[i][j] * inverse.v[i][j];
    enlarge[p] = 1 / std::max(1 - sum(leverage) / q.n, 0.5);
  }
  return enlarge;
}

// Fits pose and amplitudes to the gradients and adds them to `fit` of the observable part and to `all`. Takes the fit from the
// gradients, and returns how much the leverage of each patch enlarges their covariance.
std::vector<double> fitted(Equations& q, const Joined& reduced, const Joined& inverse, double (&fit)[JOINED], double (&all)[JOINED]) {
  Row g{};
  for (const Row& each : q.g)
    for (int i = 0; i < JOINED; ++i) g[i] += each[i];
  double found[JOINED] = {};
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) fit[i] += reduced.v[i][j] * g[j], found[i] += inverse.v[i][j] * g[j];
  for (int i = 0; i < JOINED; ++i) all[i] += found[i];
  return take_fit(q, inverse, found);
}

// Amplitudes of the modes of the ranges, and their variances, 0 if they are not significant.
struct Ranges {
  bool significant = false;
  double variances[RANGES] = {}, amplitudes[RANGES] = {};
};

// Sums over a patch of the residuals' derivatives by pose and amplitudes times that by each mode, from its normal equations.
using Crossed = std::array<std::array<double, RANGES>, JOINED>;

Crossed crossed(const PatchTable& t, const Equations& q, int64_t p) {
  Crossed X{};
  const auto& D = t.ranges[(size_t)p];
  for (int i = 0; i < JOINED; ++i)
    for (int a = 0; a < 3; ++a)
      for (int c = 0; c < RANGES; ++c) X[(size_t)i][(size_t)c] += q.N[p].v[i][3 + a] * D[(size_t)a][(size_t)c];
  return X;
}

// Takes the modes of the ranges from the gradients g.
void take_ranges(const PatchTable& t, const Equations& q, const double (&amplitudes)[RANGES], std::vector<Row>& g) {
  for (int64_t p = 0; p < t.m; ++p) {
    const Crossed X = crossed(t, q, p);
    for (size_t i = 0; i < JOINED; ++i)
      for (size_t c = 0; c < RANGES; ++c) g[(size_t)p][i] -= X[i][c] * amplitudes[c];
  }
}

// The normal equations of the modes without what pose and amplitudes explain.
struct ModeEquations {
  double B[RANGES][JOINED] = {};  // of the gradients of pose and amplitudes, those of the modes
  Square<RANGES> F;
  double points = 0;

  // Of a patch, the part of its gradient by the modes that pose and amplitudes do not explain.
  std::array<double, RANGES> gradient(const PatchTable& t, int64_t p, const Row& g) const {
    std::array<double, RANGES> h{};
    for (size_t c = 0; c < RANGES; ++c) {
      for (size_t a = 0; a < 3; ++a) h[c] += t.ranges[(size_t)p][a][c] * g[3 + a];
      for (size_t i = 0; i < JOINED; ++i) h[c] -= B[c][i] * g[i];
    }
    return h;
  }
};

ModeEquations mode_equations(const PatchTable& t, const Equations& q, const Joined& inverse) {
  ModeEquations out;
  Crossed all{};
  for (int64_t p = 0; p < t.m; ++p) {
    const Crossed X = crossed(t, q, p);
    const auto& D = t.ranges[(size_t)p];
    out.points += (double)t.counts[p];
    for (size_t i = 0; i < JOINED; ++i)
      for (size_t c = 0; c < RANGES; ++c) all[i][c] += X[i][c];
    for (size_t a = 0; a < 3; ++a)
      for (size_t b = 0; b < RANGES; ++b)
        for (size_t c = 0; c < RANGES; ++c) out.F.v[b][c] += D[a][b] * X[3 + a][c];
  }
  for (size_t c = 0; c < RANGES; ++c)
    for (size_t i = 0; i < JOINED; ++i)
      for (size_t j = 0; j < JOINED; ++j) out.B[c][i] += all[j][c] * inverse.v[j][i];
  for (size_t b = 0; b < RANGES; ++b)
    for (size_t c = 0; c < RANGES; ++c)
      for (size_t i = 0; i < JOINED; ++i) out.F.v[b][c] -= out.B[b][i] * all[i][c];
  return out;
}

// The observable combinations of the modes, each times `scale`: amplitudes along them from the summed gradients, and the
// amplitudes of the modes from those.
struct Combinations {
  int n = 0;
  double to[RANGES][RANGES] = {}, back[RANGES][RANGES] = {};

  Combinations(const ModeEquations& modes, const double (&scale)[RANGES]) {
    Square<RANGES> F, V;
    for (int b = 0; b < RANGES; ++b)
      for (int c = 0; c < RANGES; ++c) F.v[b][c] = scale[b] * modes.F.v[b][c] * scale[c];
    eigen(F.v, V.v, RANGES, 1e-32);
    for (int k = 0; k < RANGES; ++k) {
      if (!(F.v[k][k] > OBSERVABLE_RANGES * modes.points)) continue;
      for (int c = 0; c < RANGES; ++c) back[c][n] = scale[c] * V.v[c][k], to[n][c] = back[c][n] / F.v[k][k];
      ++n;
    }
  }

  std::array<double, RANGES> along(const double (&sum)[RANGES]) const {
    std::array<double, RANGES> values{};
    for (size_t k = 0; k < (size_t)n; ++k)
      for (size_t c = 0; c < RANGES; ++c) values[k] += to[k][c] * sum[c];
    return values;
  }

  void amplitudes(const std::array<double, RANGES>& values, double (&out)[RANGES]) const {
    for (size_t c = 0; c < RANGES; ++c) {
      out[c] = 0;
      for (size_t k = 0; k < (size_t)n; ++k) out[c] += back[c][k] * values[k];
    }
  }

  // Of a matrix of the summed gradients, that of the values.
  Square<RANGES> about(const Square<RANGES>& S) const {
    Square<RANGES> P;
    for (int k = 0; k < n; ++k)
      for (int l = 0; l < n; ++l)
        for (int b = 0; b < RANGES; ++b)
          for (int c = 0; c < RANGES; ++c) P.v[k][l] += to[k][b] * S.v[b][c] * to[l][c];
    return P;
  }

  // Mean share of the observable combinations that one patch determines.
  double leverage(const PatchTable& t, int64_t p) const {
    double sum = 0;
    const double* N = t.normals + 36 * p;
    for (size_t k = 0; k < (size_t)n; ++k) {
      double u[3] = {}, w[3] = {};
      for (size_t a = 0; a < 3; ++a)
        for (size_t c = 0; c < RANGES; ++c) {
          u[a] += t.ranges[(size_t)p][a][c] * back[c][k], w[a] += t.ranges[(size_t)p][a][c] * to[k][c];
        }
      for (size_t a = 0; a < 3; ++a)
        for (size_t b = 0; b < 3; ++b) sum += u[a] * N[6 * (3 + a) + 3 + b] * w[b];
    }
    return sum / n;
  }
};

// The covariance of the modes' summed gradients from what a fit of pose, amplitudes and modes leaves of each patch: an error
// of the ranges must not count as noise, which would hide it.
Square<RANGES> mode_noise(const PatchTable& t, const Equations& q, const Joined& inverse, const ModeEquations& modes,
                          const Combinations& whole, const double (&fit)[RANGES]) {
  std::vector<Row> left = q.g;
  take_ranges(t, q, fit, left);
  double moved[JOINED] = {};
  Row g{};
  for (const Row& each : left)
    for (size_t i = 0; i < JOINED; ++i) g[i] += each[i];
  for (size_t i = 0; i < JOINED; ++i)
    for (size_t j = 0; j < JOINED; ++j) moved[i] += inverse.v[i][j] * g[j];
  Square<RANGES> S;
  for (int64_t p = 0; p < t.m; ++p) {
    Row& each = left[(size_t)p];
    for (size_t i = 0; i < JOINED; ++i)
      for (size_t j = 0; j < JOINED; ++j) each[j] -= q.N[(size_t)p].v[i][j] * moved[i];
    const std::array<double, RANGES> h = modes.gradient(t, p, each);
    const double enlarge = 1 / std::max(1 - whole.leverage(t, p), 0.5);
    for (size_t b = 0; b < RANGES; ++b)
      for (size_t c = 0; c < RANGES; ++c) S.v[b][c] += enlarge * h[b] * h[c];
  }
  return S;
}

// The modes in the common fit with pose and amplitudes, from what these leave of the gradients. The variances of the modes
// are those of the lengths, each weighted with its likelihood.
Ranges range_errors(const PatchTable& t, const Equations& q, const Joined& inverse) {
  constexpr size_t SCALES = std::size(LENGTHS);
  const ModeEquations modes = mode_equations(t, q, inverse);
  double sum[RANGES] = {}, fit[RANGES] = {}, unit[RANGES];
  for (int64_t p = 0; p < t.m; ++p) {
    const std::array<double, RANGES> h = modes.gradient(t, p, q.g[(size_t)p]);
    for (size_t c = 0; c < RANGES; ++c) sum[c] += h[c];
  }
  std::fill(unit, unit + RANGES, 1.0);
  const Combinations whole(modes, unit);
  Ranges out;
  if (whole.n == 0) return out;
  whole.amplitudes(whole.along(sum), fit);
  const Square<RANGES> S = mode_noise(t, q, inverse, modes, whole, fit);
  double scales[SCALES][RANGES], amplitudes[SCALES][RANGES];
  Likely found[SCALES];
  size_t best = 0;
  for (size_t s = 0; s < SCALES; ++s) {
    size_t mode = 0;
    for (int d = 0; d < 4; ++d)
      for (int k = 0; k <= d; ++k, ++mode) {
        scales[s][mode] = 1;
        for (int i = 0; i < d; ++i) scales[s][mode] *= MODES / LENGTHS[s];
      }
    const Combinations scaled(modes, scales[s]);
    const std::array<double, RANGES> values = scaled.along(sum);
    scaled.amplitudes(values, amplitudes[s]);
    found[s] = likely_variance(values.data(), scaled.about(S), 0, scaled.n);
    if (found[s].gain > found[best].gain) best = s;
  }
  double weights[SCALES], total = 0;
  for (size_t s = 0; s < SCALES; ++s) total += weights[s] = std::exp(0.5 * (found[s].gain - found[best].gain));
  if (!(found[best].gain + 2 * std::log(total / SCALES) > SIGNIFICANT)) return out;
  out.significant = true;
  std::copy(amplitudes[best], amplitudes[best] + RANGES, out.amplitudes);
  for (size_t s = 0; s < SCALES; ++s)
    for (size_t c = 0; c < RANGES; ++c) out.variances[c] += weights[s] / total * found[s].variance * scales[s][c] * scales[s][c];
  return out;
}

// The modes at each patch: the terms of a polynomial over the image, along the rays. The terms are weighted so that equal
// variances of their amplitudes do not depend on the axes of the image, and give a random field that varies over one unit.
void image_modes(PatchTable& t) {
  t.ranges.resize((size_t)t.m);
  if (!std::isfinite(t.camera[0])) return;
  std::vector<std::array<double, 3>> rays((size_t)t.m);
  double along[3] = {}, centre[2] = {}, points = 0;
  for (int64_t p = 0; p < t.m; ++p) {
    std::array<double, 3>& r = rays[(size_t)p];
    double length = 0;
    for (size_t a = 0; a < 3; ++a) r[a] = t.places[3 * p + (int64_t)a] - t.camera[a], length += r[a] * r[a];
    for (double& x : r) x /= std::sqrt(length);
    for (size_t a = 0; a < 3; ++a) along[a] += (double)t.counts[p] * r[a];
    points += (double)t.counts[p];
  }
  int least = 0;
  for (int a = 1; a < 3; ++a)
    if (std::fabs(along[a]) < std::fabs(along[least])) least = a;
  double axes[2][3] = {};
  axes[0][least] = 1;
  const double square = along[0] * along[0] + along[1] * along[1] + along[2] * along[2];
  double size = 0;
  for (int a = 0; a < 3; ++a) axes[0][a] -= along[least] / square * along[a], size += axes[0][a] * axes[0][a];
  for (int a = 0; a < 3; ++a) axes[0][a] /= std::sqrt(size);
  for (int a = 0; a < 3; ++a)
    axes[1][a] = (along[(a + 1) % 3] * axes[0][(a + 2) % 3] - along[(a + 2) % 3] * axes[0][(a + 1) % 3]) / std::sqrt(square);
  std::vector<std::array<double, 2>> image((size_t)t.m);
  for (int64_t p = 0; p < t.m; ++p)
    for (size_t k = 0; k < 2; ++k) {
      for (int64_t a = 0; a < 3; ++a) image[(size_t)p][k] += axes[k][a] * t.places[3 * p + a];
      centre[k] += (double)t.counts[p] / points * image[(size_t)p][k];
    }
  double spread = 0;
  for (int64_t p = 0; p < t.m; ++p)
    for (size_t k = 0; k < 2; ++k) spread += (double)t.counts[p] / points * (image[(size_t)p][k] - centre[k]) * (image[(size_t)p][k] - centre[k]);
  const double unit = MODES * std::sqrt(std::max(0.5 * spread, std::numeric_limits<double>::min()));
  constexpr double WEIGHTS[4] = {1, 0.7071067811865476, 0.3535533905932738, 0.14433756729740643};  // 1 / sqrt(2^d d!)
  constexpr double TERMS[4][4] = {{1}, {1, 1}, {1, 1.4142135623730951, 1}, {1, 1.7320508075688772, 1.7320508075688772, 1}};
  for (int64_t p = 0; p < t.m; ++p) {
    const double u = (image[(size_t)p][0] - centre[0]) / unit, v = (image[(size_t)p][1] - centre[1]) / unit;
    size_t mode = 0;
    for (int d = 0; d < 4; ++d)
      for (int k = 0; k <= d; ++k, ++mode) {
        double value = WEIGHTS[d] * TERMS[d][k];
        for (int i = 0; i < d; ++i) value *= i < d - k ? u : v;
        for (size_t a = 0; a < 3; ++a) t.ranges[(size_t)p][a][mode] = rays[(size_t)p][a] * value;
      }
  }
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
    for (int k = 0; k < RANGES; ++k)
      for (int a = 0; a < 3; ++a) A[i][SURFACE + k] += N[6 * i + 3 + a] * t.ranges[(size_t)p][(size_t)a][(size_t)k];
  }
}

void complete(PatchTable& t, const Inverted& all) {
  t.total = all;
  image_modes(t);
  t.coupling.resize((size_t)t.m);
  for (int64_t p = 0; p < t.m; ++p) {
    double T[3][6];
    strains(t, p, T);
    couple(t, p, T, t.coupling[(size_t)p]);
  }
  std::vector<std::array<double, 3>> cube((size_t)t.m);
  std::vector<int64_t> order((size_t)t.m);
  for (int64_t p = 0; p < t.m; ++p) {
    for (int a = 0; a < 3; ++a) cube[p][a] = std::floor(t.places[3 * p + a] / (BLOCK * t.side));
    order[p] = p;
  }
  std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return cube[a] < cube[b]; });
  t.block.resize((size_t)t.m);
  for (int64_t k = 0; k < t.m; ++k) {
    t.blocks += k == 0 || cube[order[k]] != cube[order[k - 1]];
    t.block[order[k]] = t.blocks - 1;
  }
}

Systematic systematic_errors(const PatchTable& t) {
  Systematic out;
  int64_t most = 0;
  for (int64_t p = 0; p < t.m; ++p) most = std::max(most, t.counts[p]);
  if (t.m < LEAST_PATCHES || most == 1) return out;
  Joined N, M, spread;
  Equations q = joined(t, N);
  const int n = q.n;
  const Joined back = transposed(q.basis), reduced = product(pseudo_inverse(about(back, N), n), back), inverse = product(q.basis, reduced);
  double fit[JOINED] = {}, all[JOINED] = {};  // of the observable part, and of pose and amplitudes
  std::vector<double> enlarge = fitted(q, reduced, inverse, fit, all);
  const Ranges ranges = range_errors(t, q, inverse);
  if (ranges.significant) take_ranges(t, q, ranges.amplitudes, q.g), enlarge = fitted(q, reduced, inverse, fit, all);
  for (int64_t p = 0; p < t.m; ++p) add_outer(enlarge[p], q.g[p], q.g[p], spread);
  out.block = block_variance(t, q, enlarge, spread, inverse, M);
  for (int i = 0; i < JOINED; ++i)
    for (int j = 0; j < JOINED; ++j) spread.v[i][j] += out.block * M.v[i][j];
  const Joined P = about(reduced, spread);
  const double strain = common_variance(fit, P, 6, q.strains);
  for (int k = 0; k < 6; ++k) out.smooth[k] = strain, out.fit[k] = fit[k];
  out.smooth[6] = common_variance(fit, P, 6 + q.strains, n - 6 - q.strains);
  for (int r = 0; r < SURFACE; ++r) out.amplitudes[r] = all[6 + r];
  for (int k = 0; k < RANGES; ++k) out.smooth[SURFACE + k] = ranges.variances[k], out.amplitudes[SURFACE + k] = ranges.amplitudes[k];
  return out;
}

}  // namespace avs
