#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <memory>

namespace avs {
namespace {

struct Cube {
  int64_t x, y, z;
  bool operator==(const Cube& o) const { return x == o.x && y == o.y && z == o.z; }
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
  int inliers(int64_t chunk, Match* out) const {
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

// Numbers cubes in the order in which they first come.
class Numbers {
 public:
  uint32_t of(const Cube& cube) {
    if (!cubes_.empty() && cube == cubes_[last_]) return last_;
    size_t at = hash(cube) & (slots_.size() - 1);
    while (slots_[at] != EMPTY && !(cubes_[slots_[at]] == cube)) at = (at + 1) & (slots_.size() - 1);
    if (slots_[at] != EMPTY) return last_ = slots_[at];
    slots_[at] = last_ = (uint32_t)cubes_.size();
    cubes_.push_back(cube);
    if (2 * cubes_.size() > slots_.size()) grow();
    return last_;
  }
  size_t size() const { return cubes_.size(); }

 private:
  static constexpr uint32_t EMPTY = UINT32_MAX;

  static size_t hash(const Cube& c) {
    const uint64_t h = ((uint64_t)c.x * 73856093u ^ (uint64_t)c.y * 19349663u ^ (uint64_t)c.z * 83492791u) * 0x9e3779b97f4a7c15u;
    return (size_t)(h >> 32);
  }

  void grow() {
    slots_.assign(2 * slots_.size(), EMPTY);
    for (uint32_t k = 0; k < (uint32_t)cubes_.size(); ++k) {
      size_t at = hash(cubes_[k]) & (slots_.size() - 1);
      while (slots_[at] != EMPTY) at = (at + 1) & (slots_.size() - 1);
      slots_[at] = k;
    }
  }

  std::vector<Cube> cubes_;
  std::vector<uint32_t> slots_ = std::vector<uint32_t>(1024, EMPTY);
  uint32_t last_ = 0;
};

// What one chunk adds.
struct Part {
  int inliers = 0;
  double sum_d2 = 0, sum[3] = {0, 0, 0};
};

constexpr int64_t BLOCK = 32;  // chunks whose matches are held at a time

// The inliers of some chunks, sorted by the patches: those of a patch in the order of the scan.
class Sorted {
 public:
  explicit Sorted(int64_t chunks)
      : matches_(new Match[(size_t)(chunks * CHUNK)]), patch_((size_t)(chunks * CHUNK)), order_((size_t)(chunks * CHUNK)) {}

  Match* chunk(int64_t k) { return matches_.get() + k * CHUNK; }

  // Adds the inliers of the first chunks to the sums of their patches.
  void add(const Code& code, const Part* parts, int64_t chunks, double per_m, Numbers& numbers, std::vector<PatchSums>& sums) {
    begin_.assign(numbers.size() + 1, 0);
    for (int64_t k = 0; k < chunks; ++k)
      for (int64_t i = k * CHUNK; i < k * CHUNK + parts[k].inliers; ++i) {
        const uint32_t p = patch_[(size_t)i] = numbers.of(cube_of(matches_[(size_t)i], per_m));
        if (begin_.size() < p + 2) begin_.resize(p + 2, 0);
        ++begin_[p + 1];
      }
    for (size_t p = 1; p < begin_.size(); ++p) begin_[p] += begin_[p - 1];
    next_ = begin_;
    for (int64_t k = 0; k < chunks; ++k)
      for (int64_t i = k * CHUNK; i < k * CHUNK + parts[k].inliers; ++i) order_[next_[patch_[(size_t)i]]++] = (uint32_t)i;
    sums.resize(numbers.size());
    for (size_t p = 0; p < sums.size(); ++p)
      if (begin_[p + 1] > begin_[p]) code.add(matches_.get(), order_.data() + begin_[p], begin_[p + 1] - begin_[p], sums[p]);
  }

 private:
  std::unique_ptr<Match[]> matches_;
  std::vector<uint32_t> patch_, order_, begin_, next_;
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
  const int64_t chunks = matcher.chunks();
  std::vector<Part> parts((size_t)chunks);
  std::vector<double> errors;
  errors.reserve((size_t)v.n);
  Sorted sorted(std::min(chunks, BLOCK));
  Numbers numbers;
  Evidence out;
  out.points = v.n;
  for (int64_t first = 0; first < chunks; first += BLOCK) {
    const int64_t many = std::min(BLOCK, chunks - first);
    team.each(many, [&](int64_t k) {
      const Match* found = sorted.chunk(k);
      Part& part = parts[(size_t)(first + k)];
      part.inliers = matcher.inliers(first + k, sorted.chunk(k));
      for (const Match* m = found; m != found + part.inliers; ++m) {
        part.sum_d2 += m->d2;
        for (int a = 0; a < 3; ++a) part.sum[a] += m->p[a];
      }
    });
    for (int64_t k = 0; k < many; ++k) {
      const Part& part = parts[(size_t)(first + k)];
      out.inliers += part.inliers, out.sum_d2 += part.sum_d2;
      for (int a = 0; a < 3; ++a) out.centre[a] += part.sum[a];
      for (int i = 0; i < part.inliers; ++i) errors.push_back(std::fabs(sorted.chunk(k)[i].e));
    }
    sorted.add(code, parts.data() + first, many, 1 / rule.side, numbers, out.patches);
  }
  for (double& x : out.centre) x = out.inliers ? x / (double)out.inliers : 0;
  out.median = median(errors);
  if (out.patches.size() > (size_t)rule.least) return out;
  out.patches.clear();  // too few cubes: every point is a patch
  const uint32_t one = 0;
  for (int64_t k = 0; k < chunks; ++k) {
    Match found[CHUNK];
    const int n = matcher.inliers(k, found);
    for (int i = 0; i < n; ++i) code.add(found + i, &one, 1, out.patches.emplace_back());
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
