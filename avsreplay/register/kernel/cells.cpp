// The grid of candidate lists: an octree refined from the top, each child filtering its parent's list.
#include <algorithm>
#include <cmath>

#include "build.hpp"

namespace avs {
namespace {

// When a cell is fine enough to be a leaf; lengths in finest cells.
constexpr uint32_t FEW = 2;        // blocks: never split further
constexpr uint32_t FEW_FAR = 8;    // blocks, farther than FAR from the surface
constexpr double FAR = 3.0;
constexpr double CELL_PER_BLOCK = 0.35;  // finest cell's side over a block's median diagonal
constexpr double COARSEST = 1.0 / 48.0, FINEST = 1.0 / 448.0;  // finest cell's side over the grid's longest side

struct Cell {
  int32_t at[3];  // in units of its own side
  int level;      // side = finest << level
};

class Builder {
 public:
  Builder(Store& store, const Code& code) : s_(store), code_(code) {}

  void run() {
    s_.lists.assign(1, 0);  // offset 0 is EMPTY
    int level = 2 * LEVELS;
    while ((1 << (level - 2 * LEVELS)) < std::max({s_.size[0], s_.size[1], s_.size[2]})) ++level;
    std::vector<uint32_t> all(s_.blocks);
    for (uint32_t k = 0; k < s_.blocks; ++k) all[k] = k;
    visit({{0, 0, 0}, level}, all.data(), s_.blocks, 0);
  }

 private:
  void visit(const Cell& c, const uint32_t* list, uint32_t n, uint32_t brick) {
    const double half = 0.5 * s_.cell * (double)(1 << c.level);
    std::vector<uint32_t> kept(n);
    scratch_.resize(std::max(scratch_.size(), (size_t)LANES * n));
    const Filter f{{s_.low.x + (2 * c.at[0] + 1) * half, s_.low.y + (2 * c.at[1] + 1) * half,
                    s_.low.z + (2 * c.at[2] + 1) * half},
                   half, list, n, kept.data(), scratch_.data()};
    const Filtered r = code_.filter(s_, f);
    const double least = r.distance - 1.7320509 * half;  // of any place in the cell
    if (least > s_.reach + 4.0 * s_.slack) return;
    const bool far = least > FAR * s_.cell;
    if (c.level == 0 || r.n <= FEW || (far && r.n <= FEW_FAR)) {
      paint(c, brick, leaf(kept.data(), r.n));
      return;
    }
    descend(c, kept.data(), r.n, brick);
  }

  void descend(const Cell& c, const uint32_t* list, uint32_t n, uint32_t brick) {
    if (c.level <= 2 * LEVELS && c.level % 2 == 0) {
      const uint32_t inner = (uint32_t)(s_.bricks.size() / 64);
      s_.bricks.resize(s_.bricks.size() + 64, EMPTY);
      paint(c, brick, IS_BRICK | inner);
      brick = inner;
    }
    for (int k = 0; k < 8; ++k) {
      const Cell child{{2 * c.at[0] + (k & 1), 2 * c.at[1] + (k >> 1 & 1), 2 * c.at[2] + (k >> 2)}, c.level - 1};
      if (in_grid(child)) visit(child, list, n, brick);
    }
  }

  bool in_grid(const Cell& c) const {
    for (int k = 0; k < 3; ++k)
      if (((int64_t)c.at[k] << c.level) >= (int64_t)s_.size[k] * FINE) return false;
    return true;
  }

  uint32_t leaf(const uint32_t* list, uint32_t n) {
    const uint32_t start = (uint32_t)s_.lists.size();
    if (n > (uint32_t)LONGEST_LIST) {
      s_.lists.push_back(TOO_MANY);
    } else {
      s_.lists.push_back(n);
      s_.lists.insert(s_.lists.end(), list, list + n);
    }
    return start;
  }

  void paint(const Cell& c, uint32_t brick, uint32_t word) {
    if (c.level >= 2 * LEVELS)
      paint_top(c, word);
    else
      paint_brick(c, brick, word);
  }

  void paint_top(const Cell& c, uint32_t word) {
    const int side = 1 << (c.level - 2 * LEVELS);
    int32_t lo[3], hi[3];
    for (int k = 0; k < 3; ++k) lo[k] = c.at[k] * side, hi[k] = std::min(lo[k] + side, s_.size[k]);
    for (int32_t x = lo[0]; x < hi[0]; ++x)
      for (int32_t y = lo[1]; y < hi[1]; ++y)
        for (int32_t z = lo[2]; z < hi[2]; ++z) s_.top[((size_t)x * s_.size[1] + y) * s_.size[2] + z] = word;
  }

  void paint_brick(const Cell& c, uint32_t brick, uint32_t word) {
    const int side = c.level % 2 ? 2 : 1;  // in the brick's words
    int32_t lo[3];
    for (int k = 0; k < 3; ++k) lo[k] = c.at[k] * side & 3;
    for (int32_t x = lo[0]; x < lo[0] + side; ++x)
      for (int32_t y = lo[1]; y < lo[1] + side; ++y)
        for (int32_t z = lo[2]; z < lo[2] + side; ++z) s_.bricks[(size_t)brick * 64 + (x * 4 + y) * 4 + z] = word;
  }

  Store& s_;
  const Code& code_;
  std::vector<float> scratch_;
};

double median_diagonal(const Store& s) {
  std::vector<double> d(s.blocks);
  for (uint32_t k = 0; k < s.blocks; ++k) {
    double sum = 0;
    // In preorder the leaves are the nodes of one block: found by walking down from the root.
    uint32_t node = 0, first = 0, last = s.blocks;
    while (last - first > 1) {
      const uint32_t left = (last - first + 1) / 2;
      if (k < first + left)
        ++node, last = first + left;
      else
        node += 2 * left, first += left;
    }
    for (int a = 0; a < 3; ++a) sum += std::pow((double)s.nodes[node].hi[a] - (double)s.nodes[node].lo[a], 2);
    d[k] = std::sqrt(sum);
  }
  std::nth_element(d.begin(), d.begin() + d.size() / 2, d.end());
  return d[d.size() / 2];
}

void set_grid(Store& s) {
  double side[3], longest = 0;
  for (int k = 0; k < 3; ++k) {
    const double lo[3] = {s.low.x, s.low.y, s.low.z}, c[3] = {s.centre.x, s.centre.y, s.centre.z};
    side[k] = 2.0 * (c[k] - lo[k]);
    longest = std::max(longest, side[k]);
  }
  s.cell = std::min(std::max(CELL_PER_BLOCK * median_diagonal(s), FINEST * longest), COARSEST * longest);
  size_t words = 1;
  for (int k = 0; k < 3; ++k) {
    s.size[k] = (int32_t)(side[k] / (s.cell * FINE)) + 1;
    words *= (size_t)s.size[k];
  }
  s.top.assign(words, EMPTY);
}

}  // namespace

size_t Store::bytes() const {
  return id.size() * sizeof id[0] + points.size() * sizeof(Vec3) + triangles.size() * sizeof(Triangle) +
         normals.size() * sizeof(Vec3) + point_blocks.size() * sizeof(PointBlock) +
         triangle_blocks.size() * sizeof(TriangleBlock) + nodes.size() * sizeof(Box) +
         (top.size() + bricks.size() + lists.size()) * sizeof(uint32_t);
}

void build_cells(Store& s, const Code& code, int threads) {
  (void)threads;
  set_grid(s);
  Builder(s, code).run();
}

void build(Store& s, const Surface& surface, double reach, int threads) {
  s.reach = reach;
  build_blocks(s, surface);
  build_cells(s, code(false), threads);
}

}  // namespace avs
