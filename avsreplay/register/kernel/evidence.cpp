#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <memory>

namespace avs {
namespace {

// What one chunk adds.
struct Part {
  int inliers = 0, summed = 0;
  uint16_t off[CHUNK];  // the first are the numbers of its other points
  double sum_d2 = 0, sum[3] = {0, 0, 0};
  std::vector<Sample> samples;
};

constexpr int64_t BLOCK = 8;  // chunks whose matches are held at a time

// The inliers of some chunks, sorted by the patches: those of a patch in the order of the scan.
class Sorted {
 public:
  explicit Sorted(int64_t chunks)
      : matches_(new Match[(size_t)(chunks * CHUNK)]), patch_((size_t)(chunks * CHUNK)), order_((size_t)(chunks * CHUNK)) {}

  Match* chunk(int64_t k) { return matches_.get() + k * CHUNK; }

  // Adds those of the first chunks that count to the sums of their patches.
  void add(const Code& code, const Part* parts, int64_t chunks, double per_m, Numbers& numbers, std::vector<PatchSums>& sums) {
    begin_.assign(numbers.size() + 1, 0);
    for (int64_t k = 0; k < chunks; ++k)
      for (int64_t i = k * CHUNK; i < k * CHUNK + parts[k].summed; ++i) {
        const uint32_t p = patch_[(size_t)i] = numbers.of(cube_of(matches_[(size_t)i].p, per_m));
        if (begin_.size() < p + 2) begin_.resize(p + 2, 0);
        ++begin_[p + 1];
      }
    for (size_t p = 1; p < begin_.size(); ++p) begin_[p] += begin_[p - 1];
    next_ = begin_;
    for (int64_t k = 0; k < chunks; ++k)
      for (int64_t i = k * CHUNK; i < k * CHUNK + parts[k].summed; ++i) order_[next_[patch_[(size_t)i]]++] = (uint32_t)i;
    sums.resize(numbers.size());
    for (size_t p = 0; p < sums.size(); ++p)
      if (begin_[p + 1] > begin_[p]) code.add(matches_.get(), order_.data() + begin_[p], begin_[p + 1] - begin_[p], sums[p]);
  }

 private:
  std::unique_ptr<Match[]> matches_;
  std::vector<uint32_t> patch_, order_, begin_, next_;
};

constexpr size_t BINS = 2048;

// Leaves the values of the bins of the given rank and of the one before it; returns the rank among them. Values are >= 0.
size_t narrow(std::vector<double>& x, size_t rank) {
  double most = 0;
  for (const double value : x) most = std::max(most, value);
  const double per_value = (double)BINS / most;
  if (x.size() < BINS || rank == 0 || !(per_value > 0 && std::isfinite(per_value))) return rank;
  const auto bin = [per_value](double value) { return std::min((size_t)(int64_t)(value * per_value), BINS - 1); };
  std::vector<uint32_t> count(BINS, 0);
  for (const double value : x) ++count[bin(value)];
  size_t first = 0, below = 0, kept = 0;
  while (below + count[first] < rank) below += count[first++];
  size_t last = first;
  for (size_t to = below + count[first]; to <= rank;) to += count[++last];
  for (const double value : x) {
    const size_t k = bin(value);
    x[kept] = value, kept += first <= k && k <= last;
  }
  x.resize(kept);
  return rank - below;
}

// The value of a rank, or its mean with that of the rank before it.
double value_at(std::vector<double>& x, size_t rank, bool odd) {
  const auto at = x.begin() + (int64_t)rank;
  std::nth_element(x.begin(), at, x.end());
  return odd ? *at : 0.5 * (*at + *std::max_element(x.begin(), at));
}

// Of values >= 0.
double median(std::vector<double>& x) {
  if (x.empty()) return 0;
  const bool odd = x.size() % 2;
  const size_t rank = narrow(x, x.size() / 2);
  return value_at(x, rank, odd);
}

}  // namespace

bool is_clear(const Store& s, int32_t lane, const double* on, double distance) {
  if (s.clear.empty()) return false;
  const uint32_t levels = s.clear[(size_t)lane];
  const Triangle& t = s.triangles[(size_t)lane];
  const double d[3] = {on[0] - t.a.x, on[1] - t.a.y, on[2] - t.a.z};
  const double x = d[0] * t.u.x + d[1] * t.u.y + d[2] * t.u.z, y = d[0] * t.w.x + d[1] * t.w.y + d[2] * t.w.z;
  const std::array<double, 3> sides = side_distances(t, x, y);
  bool flat = clear_radius(s, levels >> 4 & 15) >= distance;
  for (int k = 0; k < 3; ++k) flat = flat && std::max(sides[(size_t)k], clear_radius(s, levels >> (8 + 4 * k) & 15)) >= distance;
  if (flat) return true;
  const double left = clear_radius(s, levels & 15) - distance, dx = x - (t.length + t.cx) / 3, dy = y - t.cy / 3;
  return left >= 0 && dx * dx + dy * dy <= left * left;
}

Evidence evidence(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, Team& team,
                  const Matches* matches) {
  return evidence(Matcher(s, code, v, T, rule, matches), code, v, rule, team, 0);
}

Evidence evidence(const Matcher& matcher, const Code& code, const View& v, const PatchRule& rule, Team& team, int64_t stride) {
  const int64_t chunks = matcher.chunks();
  std::vector<Part> parts((size_t)chunks);
  std::vector<double> errors((size_t)v.n);
  Sorted sorted(std::min(chunks, BLOCK));
  Evidence out;
  out.points = v.n;
  size_t summed = 0;
  for (int64_t first = 0; first < chunks; first += BLOCK) {
    const int64_t many = std::min(BLOCK, chunks - first);
    team.each(many, [&](int64_t k) {
      Match* found = sorted.chunk(k);
      Part& part = parts[(size_t)(first + k)];
      Footing feet[CHUNK];
      part.inliers = matcher.inliers(first + k, found, part.off, stride > 0 || rule.noise > 0 ? feet : nullptr);
      for (int i = (int)(stride / 2); stride > 0 && i < part.inliers; i += (int)stride) part.samples.push_back({found[i], feet[i]});
      for (int i = 0; i < part.inliers; ++i) {
        Match m = found[i];
        part.sum_d2 += m.d2;
        for (int a = 0; a < 3; ++a) part.sum[a] += m.p[a];
        if (!matcher.is_of_face(m, feet[i], rule.noise)) continue;
        onto_face(m), found[part.summed++] = m;
      }
    });
    for (int64_t k = 0; k < many; ++k) {
      const Part& part = parts[(size_t)(first + k)];
      for (int i = 0; i < part.summed; ++i) errors[summed++] = std::fabs(sorted.chunk(k)[i].e);
      const int64_t begin = (first + k) * CHUNK, others = std::min<int64_t>(v.n - begin, CHUNK) - part.inliers;
      for (int64_t i = 0; i < others; ++i) out.off.push_back(begin + part.off[i]);
      out.inliers += part.inliers, out.sum_d2 += part.sum_d2;
      out.samples.insert(out.samples.end(), part.samples.begin(), part.samples.end());
      for (int a = 0; a < 3; ++a) out.centre[a] += part.sum[a];
    }
    sorted.add(code, parts.data() + first, many, 1 / rule.side, out.cubes, out.patches);
  }
  for (double& x : out.centre) x = out.inliers ? x / (double)out.inliers : 0;
  errors.resize(summed);
  out.median = median(errors);
  if (out.patches.size() > (size_t)rule.least) return out;
  out.patches.clear();  // too few cubes: every point is a patch
  out.samples.clear();
  const uint32_t one = 0;
  for (int64_t k = 0; k < chunks; ++k) {
    Match found[CHUNK];
    Footing feet[CHUNK];
    uint16_t off[CHUNK];
    const int n = matcher.inliers(k, found, off, rule.noise > 0 ? feet : nullptr);
    for (int i = 0; i < n; ++i) {
      if (!matcher.is_of_face(found[i], feet[i], rule.noise)) continue;
      onto_face(found[i]), code.add(found + i, &one, 1, out.patches.emplace_back());
    }
  }
  return out;
}

namespace {

constexpr double CLEAR = 0.3;  // a share this far from the least one is that of the other points as well
constexpr int64_t QUARTER = 4;

// Points with a closest point, and those of them on a face that faces t of T.
struct Looks {
  int64_t matched = 0, facing = 0;
};

// Of every `stride`-th point.
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

}  // namespace

bool faces_camera(const Store& s, const Code& code, const View& v, const double* T, int64_t tested, double least_facing) {
  const int64_t stride = std::max<int64_t>(1, v.n / tested);
  const Looks few = looks(s, code, v, T, QUARTER * stride);
  const double beyond = (double)few.facing - least_facing * (double)few.matched;
  if (2 * QUARTER * few.matched >= tested && std::fabs(beyond) > CLEAR * (double)few.matched) return beyond > 0;
  const Looks all = looks(s, code, v, T, stride);
  return (double)all.facing >= least_facing * (double)all.matched;
}

namespace {

// An image in the tangent plane about a viewing direction, and the extents of points in it.
class Image {
 public:
  explicit Image(const double (&direction)[3]) {
    const double length = std::sqrt(dot(direction, direction));
    int least = 0;
    for (int a = 0; a < 3; ++a) {
      towards_[a] = direction[a] / length;
      if (std::fabs(towards_[a]) < std::fabs(towards_[least])) least = a;
    }
    for (int a = 0; a < 3; ++a) across_[a] = (a == least) - towards_[least] * towards_[a];
    const double size = std::sqrt(dot(across_, across_)), *t = towards_, *u = across_;
    for (double& x : across_) x /= size;
    up_[0] = t[1] * u[2] - t[2] * u[1], up_[1] = t[2] * u[0] - t[0] * u[2], up_[2] = t[0] * u[1] - t[1] * u[0];
  }

  // Widens the extents along x, y, x + y and x - y by a point.
  void add(const double* p, double (&low)[4], double (&high)[4]) const {
    const double at[4] = {x(p), y(p), x(p) + y(p), x(p) - y(p)};
    for (int k = 0; k < 4; ++k) low[k] = std::min(low[k], at[k]), high[k] = std::max(high[k], at[k]);
  }

  double depth(const double* p) const { return dot(towards_, p); }
  double x(const double* p) const { return dot(across_, p) / depth(p); }
  double y(const double* p) const { return dot(up_, p) / depth(p); }

 private:
  static double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

  double towards_[3], across_[3], up_[3];
};

// The image about the medians of the coordinates of points (n, 3).
Image image_of(const std::vector<double>& points) {
  std::vector<double> x(points.size() / 3);
  double direction[3];
  for (size_t a = 0; a < 3; ++a) {
    for (size_t k = 0; k < x.size(); ++k) x[k] = points[3 * k + a];
    direction[a] = x.empty() ? 0 : value_at(x, x.size() / 2, x.size() % 2);
  }
  return Image(direction);
}

// A point of the model that faces the camera.
struct Facet {
  int64_t number;
  double x, y, range, cosine;
};

constexpr double LEAST_CELL = 1e-9, MOST_CELLS = 512;  // side of a cell of the image, and cells along it

// The cell of each facet, and how many cells there are.
std::pair<std::vector<size_t>, size_t> cells_of(const std::vector<Facet>& facets, double per_cell) {
  double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL};
  for (const Facet& f : facets) {
    low[0] = std::min(low[0], f.x), high[0] = std::max(high[0], f.x);
    low[1] = std::min(low[1], f.y), high[1] = std::max(high[1], f.y);
  }
  const double area = std::max(high[0] - low[0], LEAST_CELL) * std::max(high[1] - low[1], LEAST_CELL);
  const double side = std::max(std::sqrt(area * per_cell / (double)std::max<size_t>(facets.size(), 1)), LEAST_CELL);
  const auto cell = [side](double x) { return (size_t)std::min(x / side, MOST_CELLS - 1); };
  const size_t columns = facets.empty() ? 0 : cell(high[1] - low[1]) + 1, lines = facets.empty() ? 0 : cell(high[0] - low[0]) + 1;
  std::vector<size_t> of;
  for (const Facet& f : facets) of.push_back(cell(f.x - low[0]) * columns + cell(f.y - low[1]));
  return {of, columns * lines};
}

}  // namespace

std::vector<int64_t> seen(const View& scan, const double* T, const double* model, const double* normals, int64_t n, const SeenRule& rule) {
  std::vector<double> points((size_t)(3 * scan.n));
  for (int64_t k = 0; k < scan.n; ++k) copy_point(scan, k, points.data() + 3 * k);
  const Image image = image_of(points);
  std::vector<Facet> facets;
  for (int64_t k = 0; k < n; ++k) {
    double q[3], p[3], towards = 0;
    for (int a = 0; a < 3; ++a) q[a] = model[3 * k + a] - T[4 * a + 3], towards -= normals[3 * k + a] * q[a];
    for (int a = 0; a < 3; ++a) p[a] = T[a] * q[0] + T[4 + a] * q[1] + T[8 + a] * q[2];
    const double range = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
    if (towards > rule.least_facing * range && image.depth(p) > rule.in_front * range)
      facets.push_back({k, image.x(p), image.y(p), range, towards / range});
  }
  const auto [cell, count] = cells_of(facets, rule.per_cell);
  std::vector<double> nearest(count, HUGE_VAL);
  for (size_t k = 0; k < facets.size(); ++k) nearest[cell[k]] = std::min(nearest[cell[k]], facets[k].range);
  std::vector<int64_t> found;
  for (size_t k = 0; k < facets.size(); ++k)
    if (facets[k].range < nearest[cell[k]] + rule.hidden && facets[k].cosine > rule.least_cosine) found.push_back(facets[k].number);
  return found;
}

bool is_narrower(const View& v, const double* T, const double* model, int64_t n, double least) {
  std::vector<double> points((size_t)(3 * v.n));
  for (int64_t k = 0; k < v.n; ++k) copy_point(v, k, points.data() + 3 * k);
  const Image image = image_of(points);
  constexpr double FAR = HUGE_VAL;
  double low[2][4] = {{FAR, FAR, FAR, FAR}, {FAR, FAR, FAR, FAR}}, high[2][4] = {{-FAR, -FAR, -FAR, -FAR}, {-FAR, -FAR, -FAR, -FAR}};
  for (int64_t k = 0; k < v.n; ++k) image.add(points.data() + 3 * k, low[0], high[0]);
  for (int64_t k = 0; k < n; ++k) {
    double q[3], p[3];
    for (int a = 0; a < 3; ++a) q[a] = model[3 * k + a] - T[4 * a + 3];
    for (int a = 0; a < 3; ++a) p[a] = T[a] * q[0] + T[4 + a] * q[1] + T[8 + a] * q[2];
    image.add(p, low[1], high[1]);
  }
  for (int k = 0; k < 4; ++k)
    if (high[0][k] - low[0][k] < least * (high[1][k] - low[1][k])) return true;
  return false;
}

namespace {

// Squared distances, feet and normals of some points of a scan, with the work that finding them took.
struct Found {
  std::vector<double> foot, d2, normal;
  std::vector<int32_t> id;
  int64_t work;

  Found(const Store& s, const Code& code, const View& v, const double* T, bool sided, double bound)
      : foot((size_t)(3 * v.n)), d2((size_t)v.n), normal((size_t)(3 * v.n)), id((size_t)v.n) {
    const Vec3 eye{T[3], T[7], T[11]};
    Facing facing;
    code.face(s, sided ? &eye : nullptr, 0, facing);
    const int64_t compared = code.closest(s, v, 0, v.n, T, facing, sided, bound, {foot.data(), d2.data(), id.data(), normal.data()});
    work = work_of(v.n, compared);
  }

  // Whether the closest face of a point is there and faces the eye.
  bool faces(int64_t k, const double* T) const {
    double height = 0;
    for (int64_t a = 0; a < 3; ++a) height += normal[(size_t)(3 * k + a)] * (T[4 * a + 3] - foot[(size_t)(3 * k + a)]);
    return id[(size_t)k] >= 0 && height > 0;
  }
};

}  // namespace

int64_t count_beyond(const Store& s, const Code& code, const View& v, const double* T, bool sided, double beyond, int64_t part,
                     const std::vector<int64_t>& off) {
  std::vector<double> points;
  const double step = (double)(v.n - 1) / (double)(part - 1);  // as numpy.linspace
  const auto add = [&](int64_t k) { points.resize(points.size() + 3), copy_point(v, k, points.data() + points.size() - 3); };
  if (v.n <= part) {
    for (const int64_t k : off) add(k);
  } else {
    auto next = off.begin();
    for (int64_t i = 0; i < part && next != off.end(); ++i) {
      const int64_t k = i + 1 < part ? (int64_t)((double)i * step) : v.n - 1;
      next = std::lower_bound(next, off.end(), k);
      if (next != off.end() && *next == k) add(k);
    }
  }
  const View few{reinterpret_cast<const char*>(points.data()), (int64_t)points.size() / 3, 3 * (int64_t)sizeof(double), sizeof(double), false};
  const Found found(s, code, few, T, sided && s.mesh, s.reach);
  int64_t count = 0;
  for (size_t k = 0; k < found.d2.size(); ++k) count += found.id[k] >= 0 && found.d2[k] > beyond * beyond;
  return count;
}

int64_t distances(const Store& s, const Code& code, const View& v, const double* T, const Sight& sight, double most, double* out) {
  const int64_t stride = std::max<int64_t>(1, v.n / sight.tested);
  std::vector<int64_t> left;
  int64_t work = 0;
  bool sided = false;
  if (sight.known && s.mesh) {
    const View few{v.data, (v.n + stride - 1) / stride, v.row * stride, v.column, v.single};
    const Found tested(s, code, few, T, false, s.reach);
    int64_t matched = 0, facing = 0;
    for (int64_t k = 0; k < few.n; ++k) matched += tested.id[(size_t)k] >= 0, facing += tested.faces(k, T);
    sided = (double)facing >= sight.least_facing * (double)matched;
    work += tested.work;
    for (int64_t k = 0; k < v.n; ++k) {
      const bool settled = k % stride == 0 && (!sided || tested.faces(k / stride, T));
      if (settled) out[k] = std::min(std::sqrt(tested.d2[(size_t)(k / stride)]), most);
      if (!settled) left.push_back(k);
    }
  } else {
    for (int64_t k = 0; k < v.n; ++k) left.push_back(k);
  }
  std::vector<double> points(3 * left.size());
  for (size_t k = 0; k < left.size(); ++k) copy_point(v, left[k], points.data() + 3 * k);
  const View rest{reinterpret_cast<const char*>(points.data()), (int64_t)left.size(), 3 * (int64_t)sizeof(double), sizeof(double), false};
  const Found found(s, code, rest, T, sided, std::min(most, s.reach));
  for (size_t k = 0; k < left.size(); ++k) out[left[k]] = std::min(std::sqrt(found.d2[k]), most);
  return work + found.work;
}

}  // namespace avs
