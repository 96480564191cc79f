#include "body.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

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
  std::vector<Middle> order(count);
  for (size_t i = 0; i < count; ++i)
    order[i] = {(1.0 / 3.0) * (corners_[i][0] + corners_[i][1] + corners_[i][2]), static_cast<uint32_t>(i)};
  if (count) divide(0, static_cast<uint32_t>(count), order);
  std::vector<Face> sorted(count);
  for (size_t i = 0; i < count; ++i) sorted[i] = corners_[order[i].face];
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
  bound(order);
}

// Orders the middles of faces so that each node has those of its children one after the other.
void FaceTree::divide(uint32_t begin, uint32_t end, std::vector<Middle>& order) const {
  const size_t at = nodes_.size();
  nodes_.emplace_back();
  dipoles_.emplace_back();
  if (end - begin > LEAF) {
    Vector3 low = order[begin].at, high = low;
    for (uint32_t i = begin; i < end; ++i)
      for (size_t axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], order[i].at[axis]);
        high[axis] = std::max(high[axis], order[i].at[axis]);
      }
    const Vector3 size = high - low;
    const size_t axis = static_cast<size_t>(std::max_element(size.begin(), size.end()) - size.begin());
    const uint32_t middle = begin + (end - begin) / 2;
    std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [axis](const Middle& a, const Middle& b) {
      return a.at[axis] != b.at[axis] ? a.at[axis] < b.at[axis] : a.face < b.face;
    });
    divide(begin, middle, order);
    divide(middle, end, order);
  }
  nodes_[at].begin = begin;
  nodes_[at].end = end;
  nodes_[at].next = static_cast<uint32_t>(nodes_.size());
}

// Boxes and dipoles of the nodes, from the leaves up.
void FaceTree::bound(const std::vector<Middle>& order) const {
  struct Sum {
    double area = 0;
    Vector3 weighted{}, plain{};  // sums of the middles, weighted by the areas and not
  };
  std::vector<Sum> sums(nodes_.size());
  for (size_t at = nodes_.size(); at-- > 0;) {
    Node& node = nodes_[at];
    Dipole& dipole = dipoles_[at];
    Sum& sum = sums[at];
    if (node.next == at + 1) {
      node.low = node.high = corners_[node.begin][0];
      for (uint32_t i = node.begin; i < node.end; ++i) {
        const Face& face = corners_[i];
        const Vector3 normal = 0.5 * cross(face[1] - face[0], face[2] - face[0]);
        const double size = norm(normal);
        sum.area += size;
        sum.weighted = sum.weighted + size * order[i].at;
        sum.plain = sum.plain + order[i].at;
        dipole.area = dipole.area + normal;
        for (const Vector3& corner : face)
          for (size_t axis = 0; axis < 3; ++axis) {
            node.low[axis] = std::min(node.low[axis], corner[axis]);
            node.high[axis] = std::max(node.high[axis], corner[axis]);
          }
      }
    } else {
      const size_t left = at + 1, right = nodes_[left].next;
      sum = {sums[left].area + sums[right].area, sums[left].weighted + sums[right].weighted, sums[left].plain + sums[right].plain};
      dipole.area = dipoles_[left].area + dipoles_[right].area;
      for (size_t axis = 0; axis < 3; ++axis) {
        node.low[axis] = std::min(nodes_[left].low[axis], nodes_[right].low[axis]);
        node.high[axis] = std::max(nodes_[left].high[axis], nodes_[right].high[axis]);
      }
    }
    dipole.centre = sum.area > 0 ? (1 / sum.area) * sum.weighted : (1.0 / (node.end - node.begin)) * sum.plain;
    double radius2 = 0;
    for (uint32_t i = node.begin; i < node.end; ++i)
      for (const Vector3& corner : corners_[i]) {
        const Vector3 away = corner - dipole.centre;
        radius2 = std::max(radius2, dot(away, away));
      }
    dipole.far2 = FAR_RADII * FAR_RADII * radius2;
  }
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
