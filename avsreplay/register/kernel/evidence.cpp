#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <unordered_map>

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

// A scan in {C} and its closest points.
struct Matched {
  std::vector<double> p, foot, d2, normal;
  std::vector<int32_t> id;

  explicit Matched(size_t n) : p(3 * n), foot(3 * n), d2(n), normal(3 * n), id(n) {}
};

double coordinate(const View& v, int64_t i, int k) {
  const char* at = v.data + i * v.row + k * v.column;
  if (!v.single) {
    double x;
    std::memcpy(&x, at, sizeof x);
    return x;
  }
  float x;
  std::memcpy(&x, at, sizeof x);
  return x;
}

void match(const Store& s, const Code& code, const View& v, const double* T, bool sided, Team& team, Matched& m) {
  Facing facing;
  const Vec3 eye{T[3], T[7], T[11]};
  code.face(s, sided ? &eye : nullptr, 0, facing);
  const View moved{reinterpret_cast<const char*>(m.p.data()), v.n, 3 * (int64_t)sizeof(double), sizeof(double), false};
  const Feet feet{m.foot.data(), m.d2.data(), m.id.data(), m.normal.data()};
  team.each((v.n + CHUNK - 1) / CHUNK, [&](int64_t chunk) {
    const int64_t first = chunk * CHUNK, last = std::min(v.n, first + CHUNK);
    for (int64_t i = first; i < last; ++i) {
      const double x = coordinate(v, i, 0), y = coordinate(v, i, 1), z = coordinate(v, i, 2);
      for (int k = 0; k < 3; ++k) m.p[(size_t)(3 * i + k)] = T[4 * k] * x + T[4 * k + 1] * y + T[4 * k + 2] * z + T[4 * k + 3];
    }
    code.closest(s, moved, first, last, facing, sided, feet);
  });
}

double residual(const Matched& m, size_t i) {
  double e = 0;
  for (size_t k = 3 * i; k < 3 * i + 3; ++k) e += m.normal[k] * (m.p[k] - m.foot[k]);
  return e;
}

void add(const Matched& m, size_t i, double e, PatchSums& to) {
  const double *p = m.p.data() + 3 * i, *n = m.normal.data() + 3 * i;
  const double J[6] = {p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0], n[0], n[1], n[2]};
  int t = 0;
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c <= r; ++c) to.normals[t++] += J[r] * J[c];
    to.gradients[r] += e * J[r];
  }
  ++to.points;
}

// Number of the patch of each inlier; returns how many there are.
size_t number(const Matched& m, const std::vector<size_t>& inliers, double side, int least, std::vector<size_t>& patch) {
  std::unordered_map<Cube, size_t, CubeHash> cubes;
  const auto cell = [&](double x) { return (int64_t)std::floor(std::min(std::max(x / side, -1e15), 1e15)); };
  patch.resize(inliers.size());
  for (size_t k = 0; k < inliers.size(); ++k) {
    const double* p = m.p.data() + 3 * inliers[k];
    patch[k] = cubes.emplace(Cube{cell(p[0]), cell(p[1]), cell(p[2])}, cubes.size()).first->second;
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

}  // namespace

Evidence evidence(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, Team& team) {
  Matched m((size_t)v.n);
  match(s, code, v, T, rule.facing && s.mesh, team, m);
  Evidence out;
  out.points = v.n;
  std::vector<size_t> inliers, patch;
  for (size_t i = 0; i < (size_t)v.n; ++i)
    if (m.id[i] >= 0 && m.d2[i] < rule.gate * rule.gate) inliers.push_back(i);
  out.inliers = (int64_t)inliers.size();
  out.patches.resize(number(m, inliers, rule.side, rule.least, patch));
  std::vector<double> errors(inliers.size());
  for (size_t k = 0; k < inliers.size(); ++k) {
    const size_t i = inliers[k];
    const double e = residual(m, i);
    out.sum_d2 += m.d2[i];
    for (int a = 0; a < 3; ++a) out.centre[a] += m.p[3 * i + (size_t)a] / (double)inliers.size();
    errors[k] = std::fabs(e);
    add(m, i, e, out.patches[patch[k]]);
  }
  out.median = median(errors);
  return out;
}

}  // namespace avs
