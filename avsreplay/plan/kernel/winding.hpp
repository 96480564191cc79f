// Winding number of a triangle mesh: how often its faces enclose a point, also where closed parts overlap.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace avs {

// Sums the solid angles of the faces. A group of faces that is far away in units of its radius counts as one dipole at
// its centre (Barill et al. 2018, first order), the others are exact (Van Oosterom and Strackee 1983).
class Winding {
 public:
  Winding(const double* vertices, const int32_t* faces, size_t count);
  double at(const std::array<double, 3>& q) const;

  // Which of n points with their distances to the surface have a winding number above ``least``. It does not change
  // within the ball around a point that does not reach the surface, so that it is summed for few points of a path.
  void inside(const std::array<double, 3>* points, const double* distances, size_t n, double least, bool* out) const;

 private:
  struct Node {
    std::array<double, 3> centre{}, area{};  // area: sum of the normals of the faces, each as long as its area
    double radius = 0;
    uint32_t begin = 0, end = 0, next = 0;  // faces, and the node after the whole subtree
  };
  void build(uint32_t begin, uint32_t end, std::vector<uint32_t>& order, const std::vector<std::array<double, 3>>& middles);

  std::vector<std::array<std::array<double, 3>, 3>> corners_;
  std::vector<Node> nodes_;
};

}  // namespace avs
