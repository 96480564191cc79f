#include "covariance.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "hot.hpp"

namespace avs {
namespace {

constexpr double DOMINANT = 0.5;            // a patch with more than this share of the information on a motion is left out
constexpr int64_t LEAST_POINTS = 6;         // no patch is left out where fewer points would remain
constexpr double ALONE = 1e-9;              // keeps a motion finite that only one patch determines
constexpr int64_t LEAST_HALF = 12;          // patches that each half of a split needs
constexpr double WORST_CONDITION = 1e8;     // of the scaled information of a half
constexpr double SURE = 0.01;               // of it: rounding changes no bound by a factor of 100
constexpr double LEAST_DOF = 12, MOST_DOF = 1e6;  // of an estimated covariance
constexpr double LEAST_OF_SIZE = 1.5e-3;    // least share of the effect of a size that the pose cannot explain; patches across an edge feign 1e-3
constexpr double LEAST_LEFT = 0.2;          // a leverage above 0.8 enlarges the residual of a patch no further
constexpr double TINY = std::numeric_limits<double>::min();

// N_p W.
Six product(const double* Np, const Six& W) {
  Six B;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j)
      for (int k = 0; k < 6; ++k) B.v[i][j] += Np[6 * i + k] * W.v[k][j];
  return B;
}

// W' B, which is symmetric for B = N_p W: its lower triangle is computed, and copied to the upper one.
Six congruence(const Six& W, const Six& B) {
  Six A;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      for (int k = 0; k < 6; ++k) A.v[i][j] += W.v[k][i] * B.v[k][j];
      A.v[j][i] = A.v[i][j];
    }
  return A;
}

// Whether an eigenvalue of W' N_p W exceeds DOMINANT, with W W' = `inverse`. Their sum is the trace. Where that does not decide, DOMINANT I - W' N_p W
// is factorised: all eigenvalues are below DOMINANT where every pivot is positive.
bool dominates(const double* Np, const Six& W, const Six& inverse) {
  double trace = 0;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) trace += Np[6 * i + j] * inverse.v[i][j];
  if (!(trace > DOMINANT)) return false;
  Six L = congruence(W, product(Np, W));
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) L.v[i][j] = (i == j ? DOMINANT : 0) - L.v[i][j];
  for (int j = 0; j < 6; ++j) {
    const double pivot = L.v[j][j];
    if (!(pivot > 0)) return true;
    for (int i = j + 1; i < 6; ++i)
      for (int k = j + 1; k <= i; ++k) L.v[i][k] -= L.v[i][j] * L.v[k][j] / pivot;
  }
  return false;
}

// W W'.
Six squared(const Six& W) {
  Six A;
  for (int k = 0; k < 6; ++k)
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) A.v[i][j] += W.v[i][k] * W.v[j][k];
  return A;
}

// (I - A)^-1/2 x with A = W' N_p W, where the trace of A is not small.
std::array<double, 6> reduced(const double* Np, const Six& W, const std::array<double, 6>& x) {
  Six A = congruence(W, product(Np, W)), V;
  std::array<double, 6> out{};
  eigen(A.v, V.v, 6, 1e-32);
  for (int k = 0; k < 6; ++k) {
    double along = 0;
    for (size_t i = 0; i < 6; ++i) along += V.v[i][k] * x[i];
    along /= std::sqrt(std::max(1 + ALONE - A.v[k][k], ALONE));
    for (size_t i = 0; i < 6; ++i) out[i] += V.v[i][k] * along;
  }
  return out;
}

// (I - A)^-1/2 W' g of all patches: with residuals of independent noise, the sum of its squares has the identity times the
// variance as its mean (bias-reduced linearisation).
std::vector<std::array<double, 6>> all_reduced(const double* normals, const double* gradients, int64_t m, const Six& W) {
  std::vector<std::array<double, 6>> out((size_t)m);
  std::vector<uint8_t> done((size_t)m);
  if (m) code(false).reduce(normals, gradients, m, W.v[0], out[0].data(), done.data());
  for (int64_t p = 0; p < m; ++p) {
    if (done[(size_t)p]) continue;
    std::array<double, 6> x{};
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) x[(size_t)j] += W.v[i][j] * gradients[6 * p + i];
    out[(size_t)p] = reduced(normals + 36 * p, W, x);
  }
  return out;
}

// tr A^2 + (tr A)^2: the expected squared error of the entries of A, estimated with one degree of freedom.
double unit_error(const Six& A) {
  double trace = 0, square = 0;
  for (int i = 0; i < 6; ++i) {
    trace += A.v[i][i];
    for (int j = 0; j < 6; ++j) square += A.v[i][j] * A.v[j][i];
  }
  return square + trace * trace;
}

// Shrinks the sum S of the squares of `y` towards its mean eigenvalue times the identity (Ledoit and Wolf). Returns the
// degrees of freedom of the result: those of a Wishart matrix with the same mean and the same expected squared error.
double shrink(const std::vector<std::array<double, 6>>& y, int rank, Six& S) {
  double fourth = 0, squares = 0, level = 0;
  for (const auto& each : y) {
    double length = 0;
    for (const double value : each) length += value * value;
    fourth += length * length;
  }
  for (int i = 0; i < 6; ++i) {
    level += S.v[i][i] / rank;
    for (int j = 0; j < 6; ++j) squares += S.v[i][j] * S.v[i][j];
  }
  const double n = (double)y.size(), trace = rank * level;
  const double spread = squares - rank * level * level;  // of the eigenvalues about their mean
  const double error = fourth - squares / n;             // of S, from the differences between the patches
  const double intensity = spread > 0 ? std::clamp(error / spread, 0.0, 1.0) : 1.0;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) S.v[i][j] = (1 - intensity) * S.v[i][j] + (i == j && S.v[i][i] > 0 ? intensity * level : 0);
  const double of_level = std::max(fourth - trace * trace / n, 0.0) / rank;
  const double left = of_level + (1 - intensity) * std::max(error - of_level, 0.0);
  return left > 0 ? std::clamp(unit_error(S) / left, LEAST_DOF, MOST_DOF) : MOST_DOF;
}

// Degrees of freedom of a sum, of which only `part` is an estimate, over those of this part (Welch and Satterthwaite, for
// matrices by Nel and van der Merwe).
double diluted(const Six& part, const Six& sum) {
  const Six inverse = pseudo_inverse(sum);
  Six A;
  int rank = 0;
  for (int i = 0; i < 6; ++i) {
    rank += sum.v[i][i] > 0;
    for (int j = 0; j < 6; ++j)
      for (int k = 0; k < 6; ++k) A.v[i][j] += inverse.v[i][k] * part.v[k][j];
  }
  const double own = unit_error(A);
  return own > 0 ? std::max(rank * (rank + 1) / own, 1.0) : 1.0;
}

// The patches of one half, or all of them.
struct PatchPart {
  std::vector<double> normals, gradients;  // (m, 6, 6), and (m, 6) without what pose and amplitudes explain
  double sum[6] = {};                      // of the gradients as they are
  std::array<std::array<double, AMPLITUDES>, 6> coupling{};
  std::vector<std::array<double, 18>> blocks;  // sums of the displacements' columns of the normals
};

// `left`: of `unexplained`.
void add(const PatchTable& t, const std::vector<double>& left, int64_t p, PatchPart& to) {
  const Coupling& A = t.coupling[(size_t)p];
  const double *N = t.normals + 36 * p, *g = t.gradients + 6 * p;
  to.normals.insert(to.normals.end(), N, N + 36);
  to.gradients.insert(to.gradients.end(), left.begin() + 6 * p, left.begin() + 6 * (p + 1));
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < AMPLITUDES; ++k) to.coupling[i][k] += A[i][k];
    to.sum[i] += g[i];
    for (int a = 0; a < 3; ++a) to.blocks[(size_t)t.block[(size_t)p]][(size_t)(3 * i + a)] += N[6 * i + 3 + a];
  }
}

// What the systematic errors do to a pose, or to the difference of two.
struct Effect {
  std::vector<std::array<double, 18>> blocks;  // (6, 3) of each block
  double smooth[6][AMPLITUDES] = {};

  void add(const PatchPart& part, const Six& inverse, double sign) {
    blocks.resize(part.blocks.size());
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) {
        const double f = sign * inverse.v[i][k];
        for (size_t b = 0; b < blocks.size(); ++b)
          for (size_t a = 0; a < 3; ++a) blocks[b][(size_t)(3 * i) + a] += f * part.blocks[b][(size_t)(3 * k) + a];
        for (int a = 0; a < AMPLITUDES; ++a) smooth[i][a] += f * part.coupling[k][a];
      }
  }

  void add_to(const Systematic& errors, Six& P) const {
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) {
        double sum = 0;
        for (const auto& X : blocks)
          for (size_t a = 0; a < 3; ++a) sum += X[(size_t)(3 * i) + a] * X[(size_t)(3 * j) + a];
        P.v[i][j] += errors.block * sum;
        for (int a = 0; a < AMPLITUDES; ++a) P.v[i][j] += errors.smooth[a] * smooth[i][a] * smooth[j][a];
      }
  }
};

// Whether the information of a half determines a pose. With unit diagonal the largest eigenvalue is at most 6, and the least
// one at least the inverse of the trace of the inverse; where this decides, the eigenvalues need not be computed.
bool determines(Six N, const Inverted& of) {
  double spread = 0;
  bool whole = true;
  for (int i = 0; i < 6; ++i) {
    double column = 0;
    for (int k = 0; k < 6; ++k) column += of.root.v[k][i] * of.root.v[k][i];
    spread += N.v[i][i] * of.inverse.v[i][i], whole = whole && column > 0;
  }
  if (whole && 6 * spread < SURE * WORST_CONDITION) return true;
  double scale[6];
  for (int i = 0; i < 6; ++i) scale[i] = 1 / std::sqrt(std::max(N.v[i][i], TINY));
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) N.v[i][j] *= scale[i] * scale[j];
  Six V;
  eigen(N.v, V.v, 6, 1e-32);
  double least = N.v[0][0], most = least;
  for (int k = 1; k < 6; ++k) least = std::min(least, N.v[k][k]), most = std::max(most, N.v[k][k]);
  return least * WORST_CONDITION > most;
}

// Normalised squared difference of the poses from the patches below the median of `along`, and from the others.
double difference(const PatchTable& t, const Systematic& errors, const std::vector<double>& left, const std::vector<double>& along) {
  std::vector<double> sorted = along;
  std::sort(sorted.begin(), sorted.end());
  const double middle = 0.5 * (sorted[(sorted.size() - 1) / 2] + sorted[sorted.size() / 2]);
  PatchPart parts[2];
  for (PatchPart& part : parts) part.blocks.resize((size_t)t.blocks);
  for (int64_t p = 0; p < t.m; ++p) add(t, left, p, parts[along[(size_t)p] < middle ? 0 : 1]);
  double d[6] = {}, value = 0;
  Six C;
  Effect effect;
  for (int half = 0; half < 2; ++half) {
    const PatchPart& part = parts[half];
    const int64_t m = (int64_t)part.gradients.size() / 6;
    const Six N = total(part.normals.data(), m);
    if (m < LEAST_HALF) return std::numeric_limits<double>::quiet_NaN();
    const Inverted of_half = inverted(N);
    if (!determines(N, of_half)) return std::numeric_limits<double>::quiet_NaN();
    const Six &inverse = of_half.inverse, P = sandwich(part.normals.data(), part.gradients.data(), m, of_half.root).P;
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) d[i] += (half ? 1 : -1) * inverse.v[i][j] * part.sum[j], C.v[i][j] += P.v[i][j];
    effect.add(part, inverse, half ? 1 : -1);
  }
  effect.add_to(errors, C);
  C = pseudo_inverse(C);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) value += d[i] * C.v[i][j] * d[j];
  return value;
}

}  // namespace

Inverted inverted(Six N) {
  Six V;
  Inverted out;
  eigen(N.v, V.v, 6, 1e-32);
  out.inverse = pseudo_inverse(N, V);
  double most = 0;
  for (int k = 0; k < 6; ++k) most = std::max(most, N.v[k][k]);
  for (int k = 0; k < 6; ++k) {
    const double f = N.v[k][k] > 1.4e-15 * most ? 1 / std::sqrt(N.v[k][k]) : 0;
    for (int i = 0; i < 6; ++i) out.root.v[i][k] = V.v[i][k] * f;
  }
  return out;
}

Six total(const double* normals, int64_t m, const uint8_t* keep) {
  Six N;
  for (int64_t k = 0; k < m; ++k)
    if (!keep || keep[k])
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) N.v[i][j] += normals[36 * k + 6 * i + j];
  return N;
}

void drop_dominant(const double* normals, const int64_t* counts, int64_t m, const Inverted& all, uint8_t* keep) {
  for (Six W = all.root;; W = inverted(total(normals, m, keep)).root) {
    const Six inverse = squared(W);
    std::vector<uint8_t> left(keep, keep + m);
    int64_t points = 0, dropped = 0;
    for (int64_t k = 0; k < m; ++k) {
      if (!keep[k]) continue;
      if (dominates(normals + 36 * k, W, inverse)) {
        left[(size_t)k] = 0, ++dropped;
        continue;
      }
      points += counts[k];
    }
    if (dropped == 0 || points < LEAST_POINTS) return;
    std::copy(left.begin(), left.end(), keep);
  }
}

Estimated sandwich(const double* normals, const double* gradients, int64_t m, const Six& W) {
  Six S;
  Estimated out{{}, LEAST_DOF};
  Six& P = out.P;
  int rank = 0;
  for (int j = 0; j < 6; ++j) {
    double length = 0;
    for (int i = 0; i < 6; ++i) length += W.v[i][j] * W.v[i][j];
    rank += length > 0;
  }
  if (rank == 0) return out;
  const std::vector<std::array<double, 6>> y = all_reduced(normals, gradients, m, W);
  for (const auto& x : y)
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) S.v[i][j] += x[(size_t)i] * x[(size_t)j];
  out.dof = shrink(y, rank, S);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      for (int k = 0; k < 6; ++k)
        for (int l = 0; l < 6; ++l) P.v[i][j] += W.v[i][k] * S.v[k][l] * W.v[j][l];
      P.v[j][i] = P.v[i][j];
    }
  return out;
}

std::vector<double> unexplained(const PatchTable& t, const Systematic& errors) {
  std::vector<double> left(t.gradients, t.gradients + 6 * t.m);
  for (int64_t p = 0; p < t.m; ++p)
    for (int i = 0; i < 6; ++i) {
      double& to = left[(size_t)(6 * p + i)];
      for (int j = 0; j < 6; ++j) to -= t.normals[36 * p + 6 * i + j] * errors.fit[j];
      for (int k = 0; k < AMPLITUDES; ++k) to -= t.coupling[(size_t)p][(size_t)i][(size_t)k] * errors.amplitudes[k];
    }
  return left;
}

Estimated covariance(const PatchTable& t, const Systematic& errors, const std::vector<double>& left) {
  PatchPart all;
  all.blocks.resize((size_t)t.blocks);
  for (int64_t p = 0; p < t.m; ++p) add(t, left, p, all);
  Estimated out = sandwich(t.normals, left.data(), t.m, t.total.root);
  const Six random = out.P;
  Six& P = out.P;
  Effect effect;
  effect.add(all, t.total.inverse, 1);
  effect.add_to(errors, P);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < i; ++j) P.v[i][j] = P.v[j][i] = 0.5 * (P.v[i][j] + P.v[j][i]);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) out.systematic.v[i][j] = P.v[i][j] - random.v[i][j];
  out.dof *= diluted(random, P);
  return out;
}

std::array<double, 2> size_error(const PatchTable& t) {
  const Six& inverse = t.total.inverse;
  std::vector<std::array<double, 6>> a((size_t)t.m);  // sums of J times the residual per unit of size
  std::vector<double> f((size_t)t.m), e((size_t)t.m);  // sums of its square, and of its product with the residual
  double A[6] = {}, g[6] = {}, pose_of_size[6] = {}, pose[6] = {}, F = 0, free = 0, size = 0, squares = 0;
  for (int64_t p = 0; p < t.m; ++p) {
    const size_t k = (size_t)p;
    const double *N = t.normals + 36 * p, *of_p = t.gradients + 6 * p;
    double x[3];
    for (int c = 0; c < 3; ++c) x[c] = t.places[3 * p + c] - t.centre[c];
    for (int i = 0; i < 6; ++i) {
      a[k][(size_t)i] = N[6 * i + 3] * x[0] + N[6 * i + 4] * x[1] + N[6 * i + 5] * x[2];
      A[i] += a[k][(size_t)i], g[i] += of_p[i];
    }
    for (int c = 0; c < 3; ++c) f[k] += x[c] * a[k][(size_t)(3 + c)], e[k] += x[c] * of_p[3 + c];
    F += f[k], size += e[k];
  }
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) pose_of_size[i] += inverse.v[i][j] * A[j];
  free = F;
  for (int i = 0; i < 6; ++i) free -= pose_of_size[i] * A[i], size -= pose_of_size[i] * g[i];
  if (!(free > LEAST_OF_SIZE * F)) return {0, std::numeric_limits<double>::infinity()};
  size /= free;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) pose[i] += inverse.v[i][j] * (g[j] - size * A[j]);
  for (int64_t p = 0; p < t.m; ++p) {
    const size_t k = (size_t)p;
    double score = e[k] - size * f[k], leverage = f[k];
    for (int i = 0; i < 6; ++i) {
      double left = t.gradients[6 * p + i] - size * a[k][(size_t)i], moved = 0;
      for (int j = 0; j < 6; ++j) {
        left -= t.normals[36 * p + 6 * i + j] * pose[j];
        moved += t.normals[36 * p + 6 * i + j] * pose_of_size[j];
      }
      score -= a[k][(size_t)i] * pose[i] + pose_of_size[i] * left;
      leverage += pose_of_size[i] * (moved - 2 * a[k][(size_t)i]);
    }
    score /= std::max(1 - leverage / free, LEAST_LEFT);
    squares += score * score;
  }
  return {size, std::sqrt(squares) / free};
}

double split(const PatchTable& t, const Systematic& errors, const std::vector<double>& left, const double* across, int64_t k) {
  double worst = t.m && k ? 0 : std::numeric_limits<double>::quiet_NaN();
  for (int64_t d = 0; d < k && t.m; ++d) {
    std::vector<double> along((size_t)t.m);
    for (int64_t p = 0; p < t.m; ++p) {
      const double *a = across + 3 * d, *x = t.places + 3 * p;
      along[(size_t)p] = a[0] * x[0] + a[1] * x[1] + a[2] * x[2];
    }
    const double found = difference(t, errors, left, along);
    if (!(found <= worst)) worst = found;
    if (std::isnan(found)) break;
  }
  return worst;
}

}  // namespace avs
