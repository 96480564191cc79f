#include "body.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace avs {
namespace {

constexpr double PI = 3.14159265358979323846;
constexpr uint32_t LEAF = 4;      // faces of a group that is not divided further
constexpr double FAR_RADII = 3;   // from this many radii on a group is a dipole: an error below 0.01 of one turn
constexpr double INSIDE = 0.52;   // winding number above which a point is inside: one half and twice that error
constexpr double ROUNDING = 1e-9; // of a distance, relative to the coordinates
constexpr double SLIVER = 1e-5;   // area of a face, in squares of its longest side, below which its normal is not used
constexpr size_t DEPTH = 96;      // of the tree: faces are halved, so that 2^32 of them need 32

// Sum of the solid angles of faces: each is twice the angle of a complex number, so that one arc tangent of their product
// serves all. A product of two numbers on one side of the real axis that ends on the other one has passed the angle pi.
class SolidAngle {
 public:
  void add(const std::array<Vector3, 3>& face, const Vector3& q) {
    const Vector3 a = face[0] - q, b = face[1] - q, c = face[2] - q;
    const double la = norm(a), lb = norm(b), lc = norm(c);
    const double re = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb, im = dot(a, cross(b, c));
    const double x = re_ * re - im_ * im, y = re_ * im + im_ * re, size = std::abs(x) + std::abs(y);
    if (!(size > 0)) return;  // a corner of the face
    const bool side = std::signbit(im_);
    if (side == std::signbit(im) && side != std::signbit(y)) turns_ += side ? -1 : 1;
    re_ = x / size;
    im_ = y / size;
  }
  double sum() const { return 2 * (std::atan2(im_, re_) + 2 * PI * turns_); }

 private:
  double re_ = 1, im_ = 0;
  int turns_ = 0;
};

inline Vector3 closest_on_segment(const Vector3& a, const Vector3& b, const Vector3& q) {
  const Vector3 side = b - a;
  const double length2 = dot(side, side);
  const double share = length2 > 0 ? std::clamp(dot(q - a, side) / length2, 0.0, 1.0) : 0;
  return a + share * side;
}

// Closest point of a triangle, by the regions of its plane (Ericson, Real-Time Collision Detection, 5.1.5); a triangle
// without area is its sides.
Vector3 closest_on_face(const std::array<Vector3, 3>& face, const Vector3& q) {
  const Vector3 &a = face[0], &b = face[1], &c = face[2];
  const Vector3 ab = b - a, ac = c - a, aq = q - a, bq = q - b, cq = q - c;
  const double d1 = dot(ab, aq), d2 = dot(ac, aq), d3 = dot(ab, bq), d4 = dot(ac, bq), d5 = dot(ab, cq), d6 = dot(ac, cq);
  const double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2, whole = va + vb + vc;
  if (va > 0 && vb > 0 && vc > 0 && whole > 0) return a + (vb / whole) * ab + (vc / whole) * ac;
  Vector3 best = closest_on_segment(a, b, q);
  for (const Vector3& other : {closest_on_segment(b, c, q), closest_on_segment(c, a, q)})
    if (dot(other - q, other - q) < dot(best - q, best - q)) best = other;
  return best;
}

inline double box_distance2(const Vector3& low, const Vector3& high, const Vector3& q) {
  double sum = 0;
  for (size_t axis = 0; axis < 3; ++axis) {
    const double away = std::max(std::max(low[axis] - q[axis], q[axis] - high[axis]), 0.0);
    sum += away * away;
  }
  return sum;
}

}  // namespace

FaceTree::FaceTree(const double* vertices, size_t vertex_count, const int32_t* faces, size_t count) {
  const auto vertex = [&](size_t i) { return Vector3{vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]}; };
  if (count == 0)
    for (size_t i = 0; i < vertex_count; ++i) corners_.push_back({vertex(i), vertex(i), vertex(i)});
  for (size_t i = 0; i < count; ++i)
    corners_.push_back({vertex(static_cast<size_t>(faces[3 * i])), vertex(static_cast<size_t>(faces[3 * i + 1])),
                        vertex(static_cast<size_t>(faces[3 * i + 2]))});
}

void FaceTree::index() const {
  const size_t count = corners_.size();
  std::vector<Vector3> middles(count);
  for (size_t i = 0; i < count; ++i) middles[i] = (1.0 / 3.0) * (corners_[i][0] + corners_[i][1] + corners_[i][2]);
  std::vector<uint32_t> order(count);
  std::iota(order.begin(), order.end(), 0u);
  if (count) build(0, static_cast<uint32_t>(count), order, middles);
  std::vector<Face> sorted(count);
  for (size_t i = 0; i < count; ++i) sorted[i] = corners_[order[i]];
  corners_ = std::move(sorted);
  for (const Face& face : corners_) {
    const Vector3 twice = cross(face[1] - face[0], face[2] - face[0]);
    const double size = norm(twice);
    double longest2 = 0;
    for (size_t k = 0; k < 3; ++k) {
      const Vector3 side = face[(k + 1) % 3] - face[k];
      longest2 = std::max(longest2, dot(side, side));
    }
    normals_.push_back(size > 2 * SLIVER * longest2 ? (1 / size) * twice : Vector3{});
  }
}

void FaceTree::build(uint32_t begin, uint32_t end, std::vector<uint32_t>& order, const std::vector<Vector3>& middles) const {
  const size_t at = nodes_.size();
  nodes_.emplace_back();
  dipoles_.emplace_back();
  Node node;
  Dipole dipole;
  node.begin = begin;
  node.end = end;
  double whole = 0, radius = 0;
  Vector3 low = middles[order[begin]], high = low, mean{};
  node.low = node.high = corners_[order[begin]][0];
  for (uint32_t i = begin; i < end; ++i) {
    const Face& face = corners_[order[i]];
    const Vector3 twice = cross(face[1] - face[0], face[2] - face[0]);
    const double size = norm(twice) / 2;
    whole += size;
    for (size_t axis = 0; axis < 3; ++axis) {
      const double middle = middles[order[i]][axis];
      dipole.area[axis] += twice[axis] / 2;
      dipole.centre[axis] += size * middle;
      mean[axis] += middle / (end - begin);
      low[axis] = std::min(low[axis], middle);
      high[axis] = std::max(high[axis], middle);
      for (const Vector3& corner : face) {
        node.low[axis] = std::min(node.low[axis], corner[axis]);
        node.high[axis] = std::max(node.high[axis], corner[axis]);
      }
    }
  }
  for (size_t axis = 0; axis < 3; ++axis) dipole.centre[axis] = whole > 0 ? dipole.centre[axis] / whole : mean[axis];
  for (uint32_t i = begin; i < end; ++i)
    for (const Vector3& corner : corners_[order[i]]) radius = std::max(radius, norm(corner - dipole.centre));
  dipole.far2 = FAR_RADII * radius * FAR_RADII * radius;
  dipoles_[at] = dipole;
  if (end - begin > LEAF) {
    const Vector3 size = high - low;
    const size_t axis = static_cast<size_t>(std::max_element(size.begin(), size.end()) - size.begin());
    const uint32_t middle = begin + (end - begin) / 2;
    std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](uint32_t a, uint32_t b) {
      return middles[a][axis] != middles[b][axis] ? middles[a][axis] < middles[b][axis] : a < b;
    });
    build(begin, middle, order, middles);
    build(middle, end, order, middles);
  }
  node.next = static_cast<uint32_t>(nodes_.size());
  nodes_[at] = node;
}

double FaceTree::winding(const Vector3& q) const {
  double sum = 0;
  SolidAngle near;
  for (uint32_t i = 0; i < nodes_.size();) {
    const Node& node = nodes_[i];
    const Dipole& dipole = dipoles_[i];
    const Vector3 away = dipole.centre - q;
    const double distance2 = dot(away, away);
    if (distance2 > dipole.far2) {
      sum += dot(dipole.area, away) / (distance2 * std::sqrt(distance2));
      i = node.next;
    } else {
      if (node.next == i + 1)
        for (uint32_t k = node.begin; k < node.end; ++k) near.add(corners_[k], q);
      ++i;
    }
  }
  return (sum + near.sum()) / (4 * PI);
}

// Distance to the surface, which is known to be below ``most``, and the closest face; ``face`` is one nearby. A face
// whose plane is farther away, by more than ``rounding``, is not examined.
double FaceTree::distance(const Vector3& q, double most, double rounding, Vector3& foot, uint32_t& face) const {
  struct Open {
    uint32_t node;
    double least2;
  };
  std::array<Open, DEPTH> stack;
  size_t depth = 0;
  most = std::min(most, norm(closest_on_face(corners_[face], q) - q) + rounding);
  double best2 = most * most, examined = most + rounding;
  foot = corners_[0][0];
  stack[depth++] = {0, box_distance2(nodes_[0].low, nodes_[0].high, q)};
  while (depth) {
    const Open open = stack[--depth];
    if (!(open.least2 < best2)) continue;
    const Node& node = nodes_[open.node];
    if (node.next == open.node + 1) {
      for (uint32_t k = node.begin; k < node.end; ++k) {
        if (std::abs(dot(normals_[k], q - corners_[k][0])) > examined) continue;
        const Vector3 p = closest_on_face(corners_[k], q), away = p - q;
        const double d2 = dot(away, away);
        if (d2 < best2) {
          best2 = d2;
          examined = std::sqrt(d2) + rounding;
          foot = p;
          face = k;
        }
      }
      continue;
    }
    const uint32_t left = open.node + 1, right = nodes_[left].next;
    Open first{left, box_distance2(nodes_[left].low, nodes_[left].high, q)};
    Open second{right, box_distance2(nodes_[right].low, nodes_[right].high, q)};
    if (second.least2 < first.least2) std::swap(first, second);
    if (second.least2 < best2) stack[depth++] = second;
    if (first.least2 < best2) stack[depth++] = first;
  }
  return std::sqrt(best2);
}

double FaceTree::signed_distance(const Vector3& q, Near& last, Vector3* foot) const {
  std::call_once(built_, [this] { index(); });
  Vector3 closest{};
  if (nodes_.empty() || !std::isfinite(dot(q, q))) {
    if (foot) *foot = closest;
    return INFINITE;
  }
  const double step = last.known ? norm(q - last.at) : 0, reached = std::abs(last.distance);
  const double rounding = ROUNDING * (norm(nodes_[0].high - nodes_[0].low) + norm(q - nodes_[0].low));
  uint32_t face = last.face;
  double found = distance(q, last.known ? step + reached + rounding : INFINITE, rounding, closest, face);
  if (last.known && (step < reached || step < found)) {
    found = std::copysign(found, last.distance);
  } else if (box_distance2(nodes_[0].low, nodes_[0].high, q) == 0 && winding(q) > INSIDE) {
    found = -found;
  }
  last = {q, found, true, face};
  if (foot) *foot = closest;
  return found;
}

}  // namespace avs
