// The nearest points of a set and its connected groups: a k-d tree with leaves of a few points. Among equal distances the
// first point counts.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <utility>
#include <vector>

#include "interrupt.hpp"

namespace avs {

class PointTree {
 public:
  explicit PointTree(const double* points, int64_t n) : points_(n) {
    for (int64_t k = 0; k < n; ++k) points_[k] = {{points[3 * k], points[3 * k + 1], points[3 * k + 2]}, k};
    if (n > 0) divide(0, n);
  }

  int64_t size() const { return (int64_t)points_.size(); }

  // The squared distances and numbers of the k nearest points in ascending order; size() where fewer are within `most`.
  void query(const double* p, int64_t k, std::pair<double, int64_t>* best, double most = HUGE_VAL) const {
    std::fill(best, best + k, std::make_pair(most * most, size()));
    if (size() > 0) visit(0, p, k, best);
  }

  // The number of the group of each point, in the order of their first points; neighbours are at most `most` apart.
  std::vector<int64_t> groups(double most) const {
    std::vector<int64_t> first(points_.size()), of(points_.size());
    std::iota(first.begin(), first.end(), 0);
    const auto root = [&first](int64_t k) {
      while (first[k] != k) k = first[k] = first[first[k]];
      return k;
    };
    int64_t visited = 0;
    for (const Point& point : points_) {
      poll(visited++, 16);  // the neighbours of one point may be all others
      int64_t own = root(point.number);
      within(0, point.x.data(), most * most, [&](int64_t other) {
        const int64_t theirs = root(other);
        first[std::max(own, theirs)] = std::min(own, theirs);
        own = std::min(own, theirs);
      });
    }
    int64_t count = 0;
    for (int64_t k = 0; k < size(); ++k) of[k] = first[k] == k ? count++ : of[root(k)];
    return of;
  }

 private:
  struct Point {
    std::array<double, 3> x;
    int64_t number;
  };
  struct Node {
    int64_t begin, end, further;  // its points; the node of the larger half, the other is the next one
    int axis;                     // -1: a leaf
    double low, high;             // largest coordinate of the smaller half, smallest of the larger half
  };
  static constexpr int64_t LEAF = 12;

  int64_t divide(int64_t begin, int64_t end) {
    const int64_t self = (int64_t)nodes_.size(), middle = (begin + end) / 2;
    nodes_.push_back({begin, end, 0, -1, 0, 0});
    std::array<double, 3> low = points_[begin].x, high = low;
    for (int64_t i = begin; i < end; ++i)
      for (int d = 0; d < 3; ++d) low[d] = std::min(low[d], points_[i].x[d]), high[d] = std::max(high[d], points_[i].x[d]);
    int axis = 0;
    for (int d = 1; d < 3; ++d) axis = high[d] - low[d] > high[axis] - low[axis] ? d : axis;
    if (end - begin <= LEAF || !(high[axis] > low[axis])) return self;
    const auto before = [axis](const Point& a, const Point& b) { return a.x[axis] < b.x[axis]; };
    std::nth_element(points_.begin() + begin, points_.begin() + middle, points_.begin() + end, before);
    double most = points_[begin].x[axis];
    for (int64_t i = begin; i < middle; ++i) most = std::max(most, points_[i].x[axis]);
    const double least = points_[middle].x[axis];
    divide(begin, middle);
    const int64_t further = divide(middle, end);
    nodes_[self] = {begin, end, further, axis, most, least};
    return self;
  }

  void visit(int64_t at, const double* p, int64_t k, std::pair<double, int64_t>* best) const {
    const Node& node = nodes_[at];
    if (node.axis < 0) {
      for (int64_t i = node.begin; i < node.end; ++i) {
        const double x = p[0] - points_[i].x[0], y = p[1] - points_[i].x[1], z = p[2] - points_[i].x[2];
        const std::pair<double, int64_t> found{x * x + y * y + z * z, points_[i].number};
        if (!(found < best[k - 1])) continue;
        int64_t j = k - 1;
        for (; j > 0 && found < best[j - 1]; --j) best[j] = best[j - 1];
        best[j] = found;
      }
      return;
    }
    const double below = p[node.axis] - node.low, above = node.high - p[node.axis];  // distances to the two halves
    const bool first_low = below < above;
    visit(first_low ? at + 1 : node.further, p, k, best);
    const double gap = std::max(0.0, first_low ? above : below);
    if (gap * gap <= best[k - 1].first) visit(first_low ? node.further : at + 1, p, k, best);
  }

  template <class F>
  void within(int64_t at, const double* p, double most2, const F& found) const {
    const Node& node = nodes_[at];
    if (node.axis < 0) {
      for (int64_t i = node.begin; i < node.end; ++i) {
        const double x = p[0] - points_[i].x[0], y = p[1] - points_[i].x[1], z = p[2] - points_[i].x[2];
        if (x * x + y * y + z * z <= most2) found(points_[i].number);
      }
      return;
    }
    const double below = std::max(0.0, p[node.axis] - node.low), above = std::max(0.0, node.high - p[node.axis]);
    if (below * below <= most2) within(at + 1, p, most2, found);
    if (above * above <= most2) within(node.further, p, most2, found);
  }

  std::vector<Point> points_;
  std::vector<Node> nodes_;
};

}  // namespace avs
