#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <unordered_map>

#include "step.hpp"

namespace avs {
namespace {

struct Cube {
  int64_t x, y, z;
  bool operator==(const Cube& o) const { return x == o.x && y == o.y && z == o.z; }
};

struct CubeHash {
  size_t operator()(const Cube& c) const {
    return (size_t)((uint64_t)c.x * 73856093u ^ (uint64_t)c.y * 19349663u ^ (uint64_t)c.z * 83492791u);
  }
};

void match(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, Team& team,
           const Matches* matches, std::vector<Match>& out) {
  const bool sided = rule.facing && s.mesh;
  const Vec3 eye{T[3], T[7], T[11]};
  const bool hold = matches && matches->hold(v.n, eye, rule.gate, sided);
  Facing own;
  if (!hold) code.face(s, sided ? &eye : nullptr, 0, own);
  const Look look{T, rule.gate, 0.f, Pass::plane, sided, hold ? &matches->facing : &own};
  const Kept* kept = hold ? matches->kept.data() : nullptr;
  team.each((v.n + CHUNK - 1) / CHUNK, [&](int64_t k) {
    code.match(s, v, k * CHUNK, std::min(v.n, (k + 1) * CHUNK), look, kept, out.data());
  });
}

void add(const Match& m, PatchSums& to) {
  const double *p = m.p, *n = m.n;
  const double J[6] = {p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0], n[0], n[1], n[2]};
  int t = 0;
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c <= r; ++c) to.normals[t++] += J[r] * J[c];
    to.gradients[r] += m.e * J[r];
  }
  ++to.points;
}

// Number of the patch of each inlier; returns how many there are.
size_t number(const std::vector<Match>& inliers, double side, int least, std::vector<size_t>& patch) {
  std::unordered_map<Cube, size_t, CubeHash> cubes;
  const auto cell = [&](double x) { return (int64_t)std::floor(std::min(std::max(x / side, -1e15), 1e15)); };
  patch.resize(inliers.size());
  Cube last{};
  for (size_t k = 0; k < inliers.size(); ++k) {
    const double* p = inliers[k].p;
    const Cube cube{cell(p[0]), cell(p[1]), cell(p[2])};
    patch[k] = k > 0 && cube == last ? patch[k - 1] : cubes.emplace(cube, cubes.size()).first->second;
    last = cube;
  }
  if (cubes.size() > (size_t)least) return cubes.size();
  for (size_t k = 0; k < patch.size(); ++k) patch[k] = k;
  return patch.size();
}

double median(std::vector<double>& x) {
  if (x.empty()) return 0;
  const auto middle = x.begin() + (int64_t)(x.size() / 2);
  std::nth_element(x.begin(), middle, x.end());
  return x.size() % 2 ? *middle : 0.5 * (*middle + *std::max_element(x.begin(), middle));
}

using Matrix = double[6][6];

// Root W of the pseudo-inverse of a symmetric positive semidefinite matrix: N^+ = W W'.
void pseudo_root(const Matrix& N, Matrix& W) {
  Matrix A, V;
  std::memcpy(A, N, sizeof A);
  eigen6(A, V);
  double most = 0;
  for (int k = 0; k < 6; ++k) most = std::max(most, A[k][k]);
  for (int k = 0; k < 6; ++k) {
    const double f = A[k][k] > 1.4e-15 * most ? 1 / std::sqrt(A[k][k]) : 0;
    for (int i = 0; i < 6; ++i) W[i][k] = f * V[i][k];
  }
}

void total(const double* normals, int64_t m, const uint8_t* keep, Matrix& N) {
  std::memset(N, 0, sizeof N);
  for (int64_t k = 0; k < m; ++k)
    if (!keep || keep[k])
      for (int i = 0; i < 36; ++i) N[i / 6][i % 6] += normals[36 * k + i];
}

// Largest eigenvalue of W' N_p W, if its trace exceeds `most`; the trace bounds it.
double share(const double* Np, const Matrix& W, double most) {
  Matrix B, A, V;
  double trace = 0;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) {
      B[i][j] = 0;
      for (int k = 0; k < 6; ++k) B[i][j] += Np[6 * i + k] * W[k][j];
    }
  for (int j = 0; j < 6; ++j)
    for (int k = 0; k < 6; ++k) trace += W[k][j] * B[k][j];
  if (!(trace > most)) return trace;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = 0;
      for (int k = 0; k < 6; ++k) sum += W[k][i] * B[k][j];
      A[i][j] = A[j][i] = sum;
    }
  eigen6(A, V);
  double largest = 0;
  for (int k = 0; k < 6; ++k) largest = std::max(largest, A[k][k]);
  return largest;
}

// x = A^-1 x by elimination with row pivots; a pivot of zero leaves its unknown zero.
void solve(Matrix& A, double* x) {
  for (int k = 0; k < 6; ++k) {
    int best = k;
    for (int i = k + 1; i < 6; ++i)
      if (std::fabs(A[i][k]) > std::fabs(A[best][k])) best = i;
    std::swap(A[k], A[best]), std::swap(x[k], x[best]);
    if (A[k][k] == 0) continue;
    for (int i = k + 1; i < 6; ++i) {
      const double f = A[i][k] / A[k][k];
      for (int j = k; j < 6; ++j) A[i][j] -= f * A[k][j];
      x[i] -= f * x[k];
    }
  }
  for (int k = 5; k >= 0; --k) {
    for (int j = k + 1; j < 6; ++j) x[k] -= A[k][j] * x[j];
    x[k] = A[k][k] == 0 ? 0 : x[k] / A[k][k];
  }
}

}  // namespace

Evidence evidence(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, Team& team,
                  const Matches* matches) {
  std::vector<Match> inliers((size_t)v.n);
  match(s, code, v, T, rule, team, matches, inliers);
  inliers.erase(std::remove_if(inliers.begin(), inliers.end(), [](const Match& m) { return !m.inlier; }), inliers.end());
  Evidence out;
  out.points = v.n, out.inliers = (int64_t)inliers.size();
  std::vector<size_t> patch;
  out.patches.resize(number(inliers, rule.side, rule.least, patch));
  std::vector<double> errors(inliers.size());
  for (size_t k = 0; k < inliers.size(); ++k) {
    const Match& m = inliers[k];
    out.sum_d2 += m.d2;
    for (int a = 0; a < 3; ++a) out.centre[a] += m.p[a];
    errors[k] = std::fabs(m.e);
    add(m, out.patches[patch[k]]);
  }
  for (double& x : out.centre) x = inliers.empty() ? 0 : x / (double)inliers.size();
  out.median = median(errors);
  return out;
}

Looks looks(const Store& s, const Code& code, const View& v, const double* T, int64_t stride) {
  Looks found;
  Facing facing;
  code.face(s, nullptr, 0, facing);
  const View few{v.data, (v.n + stride - 1) / stride, v.row * stride, v.column, v.single};
  std::vector<Match> matches((size_t)few.n);
  for (int64_t first = 0; first < few.n; first += CHUNK) {
    const Look look{T, s.reach, 0.f, Pass::plane, false, &facing};
    code.match(s, few, first, std::min(few.n, first + CHUNK), look, nullptr, matches.data());
  }
  for (const Match& m : matches) {
    if (!m.inlier) continue;
    double height = m.e;  // n . (t - foot) = n . (t - p) + e: of the camera above the face
    for (int k = 0; k < 3; ++k) height += m.n[k] * (T[4 * k + 3] - m.p[k]);
    ++found.matched;
    found.facing += height > 0;
  }
  return found;
}

void drop_dominant(const double* normals, const int64_t* counts, int64_t m, double most, int64_t least, uint8_t* keep) {
  for (;;) {
    Matrix N, W;
    total(normals, m, keep, N);
    pseudo_root(N, W);
    std::vector<uint8_t> left(keep, keep + m);
    int64_t points = 0, dropped = 0;
    for (int64_t k = 0; k < m; ++k) {
      if (!keep[k]) continue;
      if (share(normals + 36 * k, W, most) > most) {
        left[(size_t)k] = 0, ++dropped;
        continue;
      }
      points += counts[k];
    }
    if (dropped == 0 || points < least) return;
    std::copy(left.begin(), left.end(), keep);
  }
}

void jackknife(const double* normals, const double* gradients, int64_t m, double alone, double* P) {
  Matrix N, W, inverse;
  total(normals, m, nullptr, N);
  pseudo_root(N, W);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) {
      inverse[i][j] = 0;
      for (int k = 0; k < 6; ++k) inverse[i][j] += W[i][k] * W[j][k];
    }
  std::memset(P, 0, 36 * sizeof *P);
  for (int64_t p = 0; p < m; ++p) {
    const double* Np = normals + 36 * p;
    Matrix A;
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) {
        A[i][j] = i == j ? 1 + alone : 0;
        for (int k = 0; k < 6; ++k) A[i][j] -= Np[6 * i + k] * inverse[k][j];
      }
    double x[6], moved[6] = {};
    std::memcpy(x, gradients + 6 * p, sizeof x);
    solve(A, x);
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) moved[i] += inverse[i][k] * x[k];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) P[6 * i + j] += moved[i] * moved[j];
  }
}

}  // namespace avs
