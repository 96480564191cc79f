// The grid of candidate lists: an octree refined from the top, each child filtering its parent's list.
#include <algorithm>
#include <cmath>

#include "build.hpp"

namespace avs {
namespace {

// When a cell is fine enough to be a leaf.
constexpr uint32_t FEW_POINT_BLOCKS = 4, FEW_TRIANGLE_BLOCKS = 2;  // so few are never split further
constexpr uint32_t FEW_FAR = 20;                                   // nor so many farther from the surface than
constexpr double FAR = 1.0;                                        // this many finest cells
constexpr double CELL_PER_POINT_BLOCK = 0.35, CELL_PER_TRIANGLE_BLOCK = 0.1;  // finest cell's side over a block's median diagonal
constexpr double COARSEST = 1.0 / 48.0, FINEST = 1.0 / 448.0;  // finest cell's side over the grid's longest side

struct Cell {
  int32_t at[3];  // in units of its own side
  int level;      // side = finest << level
};

Cell octant(const Cell& c, int k) {
  return {{2 * c.at[0] + (k & 1), 2 * c.at[1] + (k >> 1 & 1), 2 * c.at[2] + (k >> 2)}, c.level - 1};
}

// The bricks and lists under one top cell, numbered from 0 and from 1 until they are joined to the store's.
struct Part {
  std::vector<uint32_t> bricks, lists{0};
  uint32_t root = EMPTY;
};

// Refines one cell of the top grid, or, above it, the octree that leads to them.
class Refiner {
 public:
  Refiner(const Store& store, const Code& code) : s_(store), code_(code) {}

  struct Seen {
    std::vector<uint32_t> list;
    double least;  // distance from the surface of the cell's nearest place, or less [m]
    bool empty;
  };

  Seen look(const Cell& c, const uint32_t* list, uint32_t n) {
    const double half = 0.5 * s_.cell * (double)(1 << c.level);
    Seen seen{std::vector<uint32_t>(n), 0, false};
    scratch_.resize(std::max(scratch_.size(), (size_t)LANES * n));
    const Filter f{{s_.low.x + (2 * c.at[0] + 1) * half, s_.low.y + (2 * c.at[1] + 1) * half,
                    s_.low.z + (2 * c.at[2] + 1) * half},
                   half, list, n, seen.list.data(), scratch_.data()};
    const Filtered r = code_.filter(s_, f);
    seen.list.resize(r.n);
    seen.least = r.distance - 1.7320509 * half;
    seen.empty = seen.least > s_.reach + 4.0 * s_.slack;
    return seen;
  }

  bool is_leaf(const Cell& c, const Seen& seen) const {
    const uint32_t few = s_.mesh ? FEW_TRIANGLE_BLOCKS : FEW_POINT_BLOCKS;
    return c.level == 0 || seen.list.size() <= few || (seen.least > FAR * s_.cell && seen.list.size() <= FEW_FAR);
  }

  Part refine(const Cell& top, const Seen& seen) {
    Part part;
    if (is_leaf(top, seen))
      part.root = add_leaf(part, seen.list);
    else
      part.root = add_brick(part, top, seen);
    return part;
  }

  static uint32_t add_leaf(Part& part, const std::vector<uint32_t>& list) {
    const uint32_t start = (uint32_t)part.lists.size();
    const bool long_list = list.size() > (size_t)LONGEST_LIST;
    part.lists.push_back(long_list ? TOO_MANY : (uint32_t)list.size());
    if (!long_list) part.lists.insert(part.lists.end(), list.begin(), list.end());
    return start;
  }

 private:
  // A brick's cell is halved twice: its words are the grandchildren.
  uint32_t add_brick(Part& part, const Cell& c, const Seen& seen) {
    const uint32_t brick = (uint32_t)(part.bricks.size() / 64);
    part.bricks.resize(part.bricks.size() + 64, EMPTY);
    for (int k = 0; k < 8; ++k) {
      const Cell child = octant(c, k);
      const Seen inner = look(child, seen.list.data(), (uint32_t)seen.list.size());
      if (inner.empty) continue;
      if (is_leaf(child, inner))
        paint(part, brick, child, add_leaf(part, inner.list));
      else
        add_grandchildren(part, brick, child, inner);
    }
    return IS_BRICK | brick;
  }

  void add_grandchildren(Part& part, uint32_t brick, const Cell& c, const Seen& seen) {
    for (int k = 0; k < 8; ++k) {
      const Cell child = octant(c, k);
      const Seen inner = look(child, seen.list.data(), (uint32_t)seen.list.size());
      if (inner.empty) continue;
      const uint32_t word = is_leaf(child, inner) ? add_leaf(part, inner.list) : add_brick(part, child, inner);
      part.bricks[word_of(brick, child.at)] = word;
    }
  }

  static void paint(Part& part, uint32_t brick, const Cell& c, uint32_t word) {
    for (int k = 0; k < 8; ++k) part.bricks[word_of(brick, octant(c, k).at)] = word;
  }

  static size_t word_of(uint32_t brick, const int32_t* at) {
    return (size_t)brick * 64 + (size_t)(((at[0] & 3) * 4 + (at[1] & 3)) * 4 + (at[2] & 3));
  }

  const Store& s_;
  const Code& code_;
  std::vector<float> scratch_;
};

class Builder {
 public:
  Builder(Store& store, const Code& code, Team& team) : s_(store), code_(code), team_(team) {}

  void run() {
    int level = 2 * LEVELS;
    while ((1 << (level - 2 * LEVELS)) < std::max({s_.size[0], s_.size[1], s_.size[2]})) ++level;
    std::vector<uint32_t> all(s_.blocks);
    for (uint32_t k = 0; k < s_.blocks; ++k) all[k] = k;
    Refiner refiner(s_, code_);
    divide(refiner, {{0, 0, 0}, level}, all);
    std::vector<Part> parts(tasks_.size());
    team_.each((int64_t)tasks_.size(), [&](int64_t k) {
      const Task& t = tasks_[(size_t)k];
      parts[(size_t)k] = Refiner(s_, code_).refine(t.cell, t.seen);
    });
    join(parts);
  }

 private:
  struct Task {
    Cell cell;
    Refiner::Seen seen;
  };

  void divide(Refiner& refiner, const Cell& c, const std::vector<uint32_t>& list) {
    for (int k = 0; k < 3; ++k)
      if (((int64_t)c.at[k] << c.level) >= (int64_t)s_.size[k] * FINE) return;
    Refiner::Seen seen = refiner.look(c, list.data(), (uint32_t)list.size());
    if (seen.empty) return;
    if (c.level == 2 * LEVELS) {
      tasks_.push_back({c, std::move(seen)});
      return;
    }
    for (int k = 0; k < 8; ++k) divide(refiner, octant(c, k), seen.list);
  }

  // In the order of the tasks, whoever did them.
  void join(const std::vector<Part>& parts) {
    s_.lists.assign(1, 0);
    for (size_t k = 0; k < parts.size(); ++k) {
      const Part& p = parts[k];
      const uint32_t list = (uint32_t)s_.lists.size() - 1, brick = (uint32_t)(s_.bricks.size() / 64);
      const auto rebased = [&](uint32_t w) { return w == EMPTY ? w : w & IS_BRICK ? w + brick : w + list; };
      s_.lists.insert(s_.lists.end(), p.lists.begin() + 1, p.lists.end());
      for (uint32_t w : p.bricks) s_.bricks.push_back(rebased(w));
      const int32_t* at = tasks_[k].cell.at;
      s_.top[((size_t)at[0] * s_.size[1] + at[1]) * s_.size[2] + at[2]] = rebased(p.root);
    }
  }

  Store& s_;
  const Code& code_;
  Team& team_;
  std::vector<Task> tasks_;
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
  s.cell = std::min(std::max((s.mesh ? CELL_PER_TRIANGLE_BLOCK : CELL_PER_POINT_BLOCK) * median_diagonal(s), FINEST * longest), COARSEST * longest);
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

void build_cells(Store& s, const Code& code, Team& team) {
  set_grid(s);
  Builder(s, code, team).run();
  s.bricks.shrink_to_fit();
  s.lists.shrink_to_fit();
}

void build(Store& s, const Surface& surface, double reach, const Code& code, Team& team) {
  s.reach = reach;
  build_blocks(s, surface);
  if (!s.mesh) build_normals(s, code, team);
  build_cells(s, code, team);
}

}  // namespace avs
