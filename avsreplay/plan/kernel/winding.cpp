#include "winding.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace avs {
namespace {

using Point = std::array<double, 3>;
constexpr double PI = 3.14159265358979323846;
constexpr uint32_t LEAF = 8;      // faces of a group that is not divided further
constexpr double FAR_RADII = 3;   // from this many radii on a group is a dipole: an error below 0.01 of one turn

Point minus(const Point& a, const Point& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
double dot(const Point& a, const Point& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
double norm(const Point& a) { return std::sqrt(dot(a, a)); }
Point cross(const Point& a, const Point& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

double solid_angle(const std::array<Point, 3>& face, const Point& q) {
  const Point a = minus(face[0], q), b = minus(face[1], q), c = minus(face[2], q);
  const double la = norm(a), lb = norm(b), lc = norm(c);
  return 2 * std::atan2(dot(a, cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
}

}  // namespace

Winding::Winding(const double* vertices, const int32_t* faces, size_t count) : corners_(count) {
  std::vector<Point> middles(count);
  for (size_t i = 0; i < count; ++i)
    for (size_t k = 0; k < 3; ++k)
      for (size_t axis = 0; axis < 3; ++axis) {
        corners_[i][k][axis] = vertices[3 * static_cast<size_t>(faces[3 * i + k]) + axis];
        middles[i][axis] += corners_[i][k][axis] / 3;
      }
  std::vector<uint32_t> order(count);
  std::iota(order.begin(), order.end(), 0u);
  if (count) build(0, static_cast<uint32_t>(count), order, middles);
  std::vector<std::array<Point, 3>> sorted(count);
  for (size_t i = 0; i < count; ++i) sorted[i] = corners_[order[i]];
  corners_ = std::move(sorted);
}

void Winding::build(uint32_t begin, uint32_t end, std::vector<uint32_t>& order, const std::vector<Point>& middles) {
  const size_t at = nodes_.size();
  nodes_.emplace_back();
  Node node;
  node.begin = begin;
  node.end = end;
  double whole = 0;
  Point low = middles[order[begin]], high = low, mean{};
  for (uint32_t i = begin; i < end; ++i) {
    const auto& face = corners_[order[i]];
    const Point twice = cross(minus(face[1], face[0]), minus(face[2], face[0]));
    const double size = norm(twice) / 2;
    whole += size;
    for (size_t axis = 0; axis < 3; ++axis) {
      const double middle = middles[order[i]][axis];
      node.area[axis] += twice[axis] / 2;
      node.centre[axis] += size * middle;
      mean[axis] += middle / (end - begin);
      low[axis] = std::min(low[axis], middle);
      high[axis] = std::max(high[axis], middle);
    }
  }
  for (size_t axis = 0; axis < 3; ++axis) node.centre[axis] = whole > 0 ? node.centre[axis] / whole : mean[axis];
  for (uint32_t i = begin; i < end; ++i)
    for (const Point& corner : corners_[order[i]]) node.radius = std::max(node.radius, norm(minus(corner, node.centre)));
  if (end - begin > LEAF) {
    const Point size = minus(high, low);
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

double Winding::at(const Point& q) const {
  double sum = 0;
  for (uint32_t i = 0; i < nodes_.size();) {
    const Node& node = nodes_[i];
    const Point away = minus(node.centre, q);
    const double distance = norm(away);
    if (distance > FAR_RADII * node.radius) {
      sum += dot(node.area, away) / (distance * distance * distance);
      i = node.next;
    } else {
      if (node.next == i + 1)
        for (uint32_t k = node.begin; k < node.end; ++k) sum += solid_angle(corners_[k], q);
      ++i;
    }
  }
  return sum / (4 * PI);
}

void Winding::inside(const Point* points, const double* distances, size_t n, double least, bool* out) const {
  std::vector<size_t> summed;
  for (size_t i = 0; i < n; ++i) {
    const auto covers = [&](size_t k) { return norm(minus(points[i], points[k])) < distances[k]; };
    const auto found = std::find_if(summed.rbegin(), summed.rend(), covers);
    if (found != summed.rend()) {
      out[i] = out[*found];
    } else {
      out[i] = at(points[i]) > least;
      summed.push_back(i);
    }
  }
}

}  // namespace avs
