#include "evidence.hpp"

#include <algorithm>
#include <cmath>
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

constexpr double NEARER = 0.999;  // of the gate of an alignment: neighbours this near are the nearest whatever the gate

// The closest points of a scan at a pose, a chunk at a time.
class Matcher {
 public:
  Matcher(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, const Matches* matches)
      : s_(s), code_(code), v_(v), sided_(rule.facing && s.mesh) {
    const Vec3 eye{T[3], T[7], T[11]};
    const bool hold = matches && matches->hold(v.n, eye, sided_);
    if (!hold) code.face(s, sided_ ? &eye : nullptr, 0, own_);
    look_ = {T, rule.gate, 0.f, Pass::plane, sided_, hold ? &matches->facing : &own_, hold ? NEARER * matches->gate : 0};
    kept_ = hold ? matches->kept.data() : nullptr;
  }
  Matcher(const Matcher&) = delete;
  Matcher& operator=(const Matcher&) = delete;

  int64_t chunks() const { return (v_.n + CHUNK - 1) / CHUNK; }

  // The inliers of a chunk, in the order of the scan; returns how many.
  int inliers(int64_t chunk, Match (&out)[CHUNK]) const {
    const int64_t first = chunk * CHUNK, last = std::min(v_.n, first + CHUNK);
    const View part{v_.data + first * v_.row, last - first, v_.row, v_.column, v_.single};
    return code_.match(s_, part, 0, part.n, look_, kept_ ? kept_ + first : nullptr, out);
  }

 private:
  const Store& s_;
  const Code& code_;
  const View v_;
  const bool sided_;
  Facing own_;
  Look look_{};
  const Kept* kept_ = nullptr;
};

Cube cube_of(const Match& m, double per_m) {
  const auto cell = [&](double x) {
    const double y = std::min(std::max(x * per_m, -1e15), 1e15);
    const int64_t k = (int64_t)y;
    return k - (y < (double)k);
  };
  return {cell(m.p[0]), cell(m.p[1]), cell(m.p[2])};
}

void add(const PatchSums& from, PatchSums& to) {
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 8; ++c) to.rows[r][c] += from.rows[r][c];
  for (int k = 0; k < 4; ++k) to.last[k] += from.last[k];
  to.points += from.points;
}

// Sums by cube, in the order in which the cubes first came.
class Patches {
 public:
  PatchSums& at(const Cube& cube) {
    if (sums_.empty() || !(cube == cubes_[last_])) {
      last_ = number_.try_emplace(cube, sums_.size()).first->second;
      if (last_ == sums_.size()) cubes_.push_back(cube), sums_.emplace_back();
    }
    return sums_[last_];
  }
  void add(const Patches& o) {
    for (size_t k = 0; k < o.sums_.size(); ++k) avs::add(o.sums_[k], at(o.cubes_[k]));
  }
  std::vector<PatchSums>& sums() { return sums_; }

 private:
  std::unordered_map<Cube, size_t, CubeHash> number_;
  std::vector<Cube> cubes_;
  std::vector<PatchSums> sums_;
  size_t last_ = 0;
};

// What one chunk adds.
struct Part {
  Patches patches;
  int64_t inliers = 0;
  double sum_d2 = 0, sum[3] = {0, 0, 0}, errors[CHUNK];
};

double median(std::vector<double>& x) {
  if (x.empty()) return 0;
  const auto middle = x.begin() + (int64_t)(x.size() / 2);
  std::nth_element(x.begin(), middle, x.end());
  return x.size() % 2 ? *middle : 0.5 * (*middle + *std::max_element(x.begin(), middle));
}

}  // namespace

Evidence evidence(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, Team& team,
                  const Matches* matches) {
  const Matcher matcher(s, code, v, T, rule, matches);
  std::vector<Part> parts((size_t)matcher.chunks());
  const double per_m = 1 / rule.side;
  team.each(matcher.chunks(), [&](int64_t k) {
    Match found[CHUNK];
    Part& part = parts[(size_t)k];
    const int n = matcher.inliers(k, found);
    part.inliers = n;
    for (int i = 0; i < n; ++i) {
      const Match& m = found[i];
      part.sum_d2 += m.d2, part.errors[i] = std::fabs(m.e);
      for (int a = 0; a < 3; ++a) part.sum[a] += m.p[a];
    }
    Cube next = n ? cube_of(found[0], per_m) : Cube{};
    for (int i = 0, end; i < n; i = end) {  // points that follow each other are often in one cube
      const Cube cube = next;
      for (end = i + 1; end < n && (next = cube_of(found[end], per_m)) == cube;) ++end;
      code.add(found + i, end - i, part.patches.at(cube));
    }
  });
  Evidence out;
  out.points = v.n;
  Patches all;
  std::vector<double> errors;
  for (const Part& part : parts) {
    out.inliers += part.inliers, out.sum_d2 += part.sum_d2;
    for (int a = 0; a < 3; ++a) out.centre[a] += part.sum[a];
    errors.insert(errors.end(), part.errors, part.errors + part.inliers);
    all.add(part.patches);
  }
  for (double& x : out.centre) x = out.inliers ? x / (double)out.inliers : 0;
  out.median = median(errors);
  out.patches = std::move(all.sums());
  if (out.patches.size() > (size_t)rule.least) return out;
  out.patches.clear();  // too few cubes: every point is a patch
  for (int64_t k = 0; k < matcher.chunks(); ++k) {
    Match found[CHUNK];
    const int n = matcher.inliers(k, found);
    for (int i = 0; i < n; ++i) code.add(found + i, 1, out.patches.emplace_back());
  }
  return out;
}

Looks looks(const Store& s, const Code& code, const View& v, const double* T, int64_t stride) {
  Looks found;
  const View few{v.data, (v.n + stride - 1) / stride, v.row * stride, v.column, v.single};
  const Matcher matcher(s, code, few, T, {s.reach, 1, 0, false}, nullptr);
  for (int64_t k = 0; k < matcher.chunks(); ++k) {
    Match matches[CHUNK];
    const int n = matcher.inliers(k, matches);
    found.matched += n;
    for (int i = 0; i < n; ++i) {
      double height = matches[i].e;  // n . (t - foot) = n . (t - p) + e: of the camera above the face
      for (int a = 0; a < 3; ++a) height += matches[i].n[a] * (T[4 * a + 3] - matches[i].p[a]);
      found.facing += height > 0;
    }
  }
  return found;
}

}  // namespace avs
