// The grid near the surface: for each cell the blocks around it, nearest first.
#include <algorithm>
#include <atomic>
#include <cmath>

#include "build.hpp"

namespace avs {
namespace {

constexpr double CELL_OF_GRAIN = 0.25;          // a cell's side over the median diagonal of a block
constexpr double FINEST = 1.0 / 256, COARSEST = 1.0 / 32;  // and over the extent, at least and at most
constexpr double FINEST_NARROW = 1.0 / 1024;     // the same for the cells of NARROW: bounds the number of bricks
constexpr double BAND_OF_EXTENT = 0.01, BAND_OF_CELL = 3.0;  // cells so near to the surface have a list
constexpr int64_t BLOCKS_A_TASK = 64;
constexpr size_t MOST_NEAR = 6'000'000;  // pairs of a cell and a block; where there are more another grid is tried
constexpr uint32_t SAMPLE = 16;          // one block in so many gives the estimate of the number of pairs

// Side of a cell over the median diagonal of a block, and band over the side. Where the first grid has too many pairs
// these are tried before its cells are made larger: a cell as large as a block or larger is near to more blocks than a
// list holds, so the lists of such a grid are incomplete and every search needs the tree as well.
constexpr struct {
  double cell_of_grain, band_of_cell;
} NARROW[] = {{0.35, 1.0}, {0.5, 0.5}};

// Lays the grid over the model for a given cell.
void set_grid(Store& s, const Box& box, double cell, double band) {
  const double centre[3] = {s.centre.x, s.centre.y, s.centre.z};
  double low[3];
  size_t words = 1;
  for (int k = 0; k < 3; ++k) {
    low[k] = centre[k] + box.lo[k] - band;
    const double side = (double)box.hi[k] - box.lo[k] + 2.0 * band;
    s.size[k] = (int32_t)(side / (cell * BRICK)) + 1;
    words *= (size_t)s.size[k];
  }
  s.low = {low[0], low[1], low[2]};
  s.cell = cell, s.step = (float)((band + 0.87 * cell + 2.0 * s.slack) / STEPS);
  s.top.assign(words, 0);
}

Box root_box(const Store& s) {
  Box b{{s.nodes[0].lo[0][0], s.nodes[0].lo[1][0], s.nodes[0].lo[2][0], 0}, {s.nodes[0].hi[0][0], s.nodes[0].hi[1][0], s.nodes[0].hi[2][0], 0}};
  for (int a = 0; a < 3; ++a)
    for (int k = 1; k < LANES && s.nodes[0].child[k] != NO_CHILD; ++k)
      b.lo[a] = std::min(b.lo[a], s.nodes[0].lo[a][k]), b.hi[a] = std::max(b.hi[a], s.nodes[0].hi[a][k]);
  return b;
}

// All pairs of a cell and a block in the order of the blocks, or nothing where there are too many.
bool gather(const Store& s, const Code& code, Team& team, float band, std::vector<std::vector<Near>>& parts) {
  const int64_t tasks = ((int64_t)s.blocks + BLOCKS_A_TASK - 1) / BLOCKS_A_TASK;
  parts.assign((size_t)tasks, {});
  std::atomic<bool> good{true};
  team.each(tasks, [&](int64_t t) {
    const int64_t last = std::min((int64_t)s.blocks, (t + 1) * BLOCKS_A_TASK);
    for (int64_t k = t * BLOCKS_A_TASK; k < last && good; ++k)
      if (!code.cells(s, (uint32_t)k, band, MOST_NEAR, parts[(size_t)t])) good = false;
  });
  size_t total = 0;
  for (const auto& p : parts) total += p.size();
  return good && total <= MOST_NEAR;
}

// Whether the number of pairs, estimated from a part of the blocks, is within the limit.
bool seems_few(const Store& s, const Code& code, float band) {
  std::vector<Near> pairs;
  for (uint32_t k = 0; k < s.blocks; k += SAMPLE)
    if (!code.cells(s, k, band, MOST_NEAR / SAMPLE, pairs)) return false;
  return true;
}

// Numbers the bricks that are used and counts the entries of each cell; returns where each cell's entries begin.
std::vector<uint32_t> count(Store& s, const std::vector<std::vector<Near>>& parts) {
  uint32_t bricks = 0;
  for (const auto& part : parts)
    for (const Near& n : part) s.top[(size_t)(n.cell / WORDS)] = 1;
  for (uint32_t& w : s.top)
    if (w) w = ++bricks;
  std::vector<uint32_t> start((size_t)bricks * WORDS + 1, 0);
  for (const auto& part : parts)
    for (const Near& n : part) ++start[(size_t)(s.top[(size_t)(n.cell / WORDS)] - 1) * WORDS + n.cell % WORDS + 1];
  for (size_t k = 1; k < start.size(); ++k) start[k] += start[k - 1];
  return start;
}

void write_list(Store& s, size_t cell, uint32_t* first, uint32_t* last) {
  std::sort(first, last);  // an entry's high bits are its distance
  uint32_t n = (uint32_t)(last - first), known = STEPS;
  if (n > (uint32_t)LONGEST_LIST) n = LONGEST_LIST, known = first[n] >> (32 - DISTANCE_BITS);
  s.bricks[cell] = (uint32_t)s.lists.size();
  s.lists.push_back(n | known << (32 - DISTANCE_BITS));
  s.lists.insert(s.lists.end(), first, first + n);
}

void write_lists(Store& s, const std::vector<std::vector<Near>>& parts) {
  std::vector<uint32_t> start = count(s, parts), entries(start.back());
  std::vector<uint32_t> next(start.begin(), start.end() - 1);
  for (const auto& part : parts)
    for (const Near& n : part)
      entries[next[(size_t)(s.top[(size_t)(n.cell / WORDS)] - 1) * WORDS + n.cell % WORDS]++] = n.steps << (32 - DISTANCE_BITS) | n.block;
  s.bricks.assign(next.size(), 0);
  s.lists.assign(1, 0);
  for (size_t k = 0; k < next.size(); ++k)
    if (start[k + 1] > start[k]) write_list(s, k, entries.data() + start[k], entries.data() + start[k + 1]);
  s.lists.insert(s.lists.end(), LANES, 0);  // eight entries are read at a time
  s.lists.shrink_to_fit();
}

}  // namespace

void build_cells(Store& s, const Code& code, Team& team) {
  if (s.blocks >= MOST_BLOCKS || !(s.extent > 0)) return;
  const Box box = root_box(s);
  const auto made = [&](double cell, double band) {
    std::vector<std::vector<Near>> parts;
    set_grid(s, box, cell, band);
    if (!seems_few(s, code, (float)band) || !gather(s, code, team, (float)band, parts)) return false;
    write_lists(s, parts);
    return true;
  };
  const double first = std::min(std::max(CELL_OF_GRAIN * s.grain, FINEST * s.extent), COARSEST * s.extent);
  for (double cell = first; cell < s.extent; cell *= 1.5) {
    if (made(cell, std::min(s.reach, std::min(BAND_OF_EXTENT * s.extent, BAND_OF_CELL * cell)))) return;
    if (cell > first) continue;
    for (const auto& n : NARROW) {
      const double side = n.cell_of_grain * s.grain;
      if (side > FINEST_NARROW * s.extent && made(side, std::min(s.reach, n.band_of_cell * side))) return;
    }
  }
  s.cell = 0, s.top.clear();
}

}  // namespace avs
