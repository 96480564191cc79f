// The target's body: closest points and signed distances of a triangle mesh or a point cloud.
#pragma once
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "vector.hpp"

namespace avs {

// A point on a path with its distance to the surface, from which the search for the next point begins.
struct Near {
  Vector3 at{};
  double distance = 0;  // signed
  bool known = false;
  uint32_t face = 0;  // the closest one, in the order of the tree

  // Distance from q to the surface at least; negative where the ball around this point does not contain q.
  double least(const Vector3& q) const { return known ? std::abs(distance) - norm(q - at) : -HUGE_VAL; }
};

// A tree of faces answers both questions. Distances are exact. A point is inside where the winding number, how often
// the faces enclose it, is above one half, also where closed parts overlap. For that sum a group of faces that is far
// away in units of its radius counts as one dipole at its centre (Barill et al. 2018, first order), the others are exact
// (Van Oosterom and Strackee 1983).
class FaceTree {
 public:
  // It is built at the first question.
  FaceTree(const double* vertices, size_t vertex_count, const int32_t* faces, size_t count);

  // Signed distance of q, negative inside, and the closest point. ``last`` is a point nearby: the answer does not depend
  // on it, except inside an open surface, but the search is shorter, and the winding number is not summed again where
  // one of the balls around both that do not reach the surface contains the other point.
  double signed_distance(const Vector3& q, Near& last, Vector3* foot = nullptr) const;

 private:
  using Face = std::array<Vector3, 3>;
  struct Node {
    Vector3 low{}, high{};                  // box of the corners
    uint32_t begin = 0, end = 0, next = 0;  // faces, and the node after the whole subtree
  };
  struct Dipole {  // of the faces of a node
    Vector3 centre{}, area{};  // area: sum of the normals of the faces, each as long as its area
    double far2 = 0;           // squared distance from which on it replaces them
  };
  struct Middle {  // of a face
    Vector3 at{};
    uint32_t face = 0;
  };
  void index() const;
  void divide(uint32_t begin, uint32_t end, std::vector<Middle>& order) const;
  void bound(const std::vector<Middle>& order) const;
  double winding(const Vector3& q) const;
  double distance(const Vector3& q, double most, double rounding, Vector3& foot, uint32_t& face) const;

  mutable std::once_flag built_;
  mutable std::vector<Face> corners_;
  mutable std::vector<Vector3> normals_;  // of the faces, unit; zero without an area
  mutable std::vector<Node> nodes_;
  mutable std::vector<Dipole> dipoles_;  // one for each node
};

// A body in a frame whose origin is a point of the frame of its tree.
class Body {
 public:
  Body(std::shared_ptr<const FaceTree> tree, const Vector3& origin) : tree_(std::move(tree)), origin_(origin) {}
  Body moved(const Vector3& origin) const { return {tree_, origin_ + origin}; }
  double signed_distance(const Vector3& q, Near& last, Vector3* foot = nullptr) const {
    const double found = tree_->signed_distance(q + origin_, last, foot);
    if (foot) *foot = *foot - origin_;
    return found;
  }
  // That of two points from which the search for the distance of q is shorter.
  const Near& nearer(const Vector3& q, const Near& a, const Near& b) const {
    return a.least(q + origin_) < b.least(q + origin_) ? b : a;
  }
  // Signed distance of q, or a lower bound of it that is at least ``enough``.
  double at_least(const Vector3& q, double enough, Near& last) const {
    if (last.known) {
      const double bound = last.distance - norm(q + origin_ - last.at);
      if (bound >= enough) return bound;
    }
    return signed_distance(q, last);
  }

 private:
  std::shared_ptr<const FaceTree> tree_;
  Vector3 origin_;
};

}  // namespace avs
