// Cubes of a lattice, numbered in the order in which they first come.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace avs {

struct Cube {
  int64_t x, y, z;
  bool operator==(const Cube& o) const { return x == o.x && y == o.y && z == o.z; }
};

// The cube of a point, with `per_m` cubes along a metre.
inline Cube cube_of(const double* p, double per_m) {
  const auto cell = [per_m](double x) {
    double y = x * per_m;
    if (!(std::fabs(y) < 1e15)) y = y > 0 ? 1e15 : -1e15;
    const int64_t k = (int64_t)y;
    return k - (y < (double)k);
  };
  return {cell(p[0]), cell(p[1]), cell(p[2])};
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
  // The number of a cube, or NONE where it never came.
  uint32_t find(const Cube& cube) const {
    size_t at = hash(cube) & (slots_.size() - 1);
    while (slots_[at] != EMPTY && !(cubes_[slots_[at]] == cube)) at = (at + 1) & (slots_.size() - 1);
    return slots_[at];
  }
  size_t size() const { return cubes_.size(); }
  static constexpr uint32_t NONE = UINT32_MAX;

 private:
  static constexpr uint32_t EMPTY = NONE;

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

}  // namespace avs
