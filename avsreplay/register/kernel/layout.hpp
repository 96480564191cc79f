// What the index is made of: plain data, read by the code of every instruction set.
//
// Primitives (points or triangles) are split at medians into compact blocks of eight. A block holds single-precision
// copies relative to the model's centre, which only pre-select; the answer comes from the double-precision records.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

namespace avs {

constexpr int LANES = 8;

struct Vec3 {
  double x, y, z;
};

// A triangle in its own plane: corner a, unit u along the longest side ab, unit w towards c, unit n = u x w (winding).
// There a = (0, 0), b = (length, 0), c = (cx, cy) with cy > 0; both angles at the longest side are acute.
struct Triangle {
  Vec3 a, u, w, n;
  double length, cx, cy, inv_ac2, inv_bc2;
};

struct PointBlock {
  float x[LANES], y[LANES], z[LANES];
};

struct TriangleBlock {
  float a[3][LANES], u[3][LANES], w[3][LANES], n[3][LANES];
  float length[LANES], cx[LANES], cy[LANES], inv_ac2[LANES], inv_bc2[LANES];
};

struct Box {
  float lo[3], hi[3];
};

// A cell's word: 0 no primitive within reach of any place in it; top bit: number of a brick of 4 x 4 x 4 words;
// else where its list starts: a count, then blocks. A count of TOO_MANY sends the query to the tree.
constexpr uint32_t EMPTY = 0;
constexpr uint32_t IS_BRICK = 0x80000000u;
constexpr uint32_t TOO_MANY = 0xffffffffu;
constexpr int LEVELS = 2;            // bricks below the top grid
constexpr int FINE = 1 << 2 * LEVELS;  // finest cells along a top cell's side
constexpr int LONGEST_LIST = 48;

struct Store {
  bool mesh = false;
  double reach = 0, extent = 0;
  Vec3 centre{};
  float slack = 0;  // bound of the error of any single-precision distance here [m]
  double tie = 0, tie2 = 0;  // distances nearer each other than this are equal [m], and its square

  uint32_t blocks = 0;
  std::vector<int32_t> id;          // of the caller's faces or points, LANES a block
  std::vector<Vec3> points;         // LANES a block, a cloud's
  std::vector<Triangle> triangles;  // LANES a block, a mesh's
  std::vector<Vec3> normals;        // LANES a block
  std::vector<PointBlock> point_blocks;
  std::vector<TriangleBlock> triangle_blocks;
  std::vector<Box> nodes;  // preorder; a node of k blocks has its right child 2 ceil(k / 2) further on

  Vec3 low{};       // corner of the grid
  double cell = 0;  // side of a finest cell [m]
  int32_t size[3]{};  // top cells
  std::vector<uint32_t> top, bricks, lists;

  std::size_t bytes() const;
};

}  // namespace avs
