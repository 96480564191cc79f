// The index as plain data, shared by the code of every instruction set.
//
// Primitives (points or triangles) are split at medians into compact blocks of eight. A block holds single-precision
// copies relative to the model's centre, which only pre-select; results come from the double-precision records.
// A tree with eight children a node bounds the blocks by axis-aligned boxes.
#pragma once
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "pages.hpp"

namespace avs {

constexpr int LANES = 8;

struct Vec3 {
  double x, y, z;
};

inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// A triangle in its own plane: corner a, unit u along the longest side ab, unit w towards c, unit n = u x w (winding).
// There a = (0, 0), b = (length, 0), c = (cx, cy) with cy > 0; both angles at the longest side are acute.
struct Triangle {
  Vec3 a, u, w;
  double length, cx, cy;

  Vec3 n() const { return {u.y * w.z - u.z * w.y, u.z * w.x - u.x * w.z, u.x * w.y - u.y * w.x}; }
};

struct PointBlock {
  float x[LANES], y[LANES], z[LANES];
};

struct TriangleBlock {
  float a[3][LANES], u[3][LANES], w[3][LANES], length[LANES], cx[LANES], cy[LANES];
};

struct Box {
  float lo[4], hi[4];  // the last of each is not used
};

// A node covers a contiguous range of blocks. Its children cover consecutive parts of that range, in order.
constexpr uint32_t IS_BLOCK = 0x80000000u;  // set in a child that is one block instead of a node
constexpr uint32_t NO_CHILD = 0xffffffffu;
struct Node {
  float lo[3][LANES], hi[3][LANES];  // boxes of the children; an absent child has lo = inf
  uint32_t child[LANES];
};

// Bounds over the faces below each child: of the unit normals n and of the plane offsets h = n . (a - centre).
struct NodeSides {
  float n_lo[3][LANES], n_hi[3][LANES], h_lo[LANES], h_hi[LANES];
};

// The grid near the surface. A cell's word is 0 (not near, or nothing there) or where its list starts: a header with
// the number of entries and a distance, then the blocks by their distance from the cell's centre. All blocks within the
// header's distance of the centre are listed that are within the band of some place of the cell. Distances are in units
// of `Store::step`, rounded down.
constexpr int BRICK = 4, WORDS = BRICK * BRICK * BRICK;  // cells along a brick's side, and in a brick
constexpr int DISTANCE_BITS = 10, LONGEST_LIST = 24;
constexpr uint32_t STEPS = (1u << DISTANCE_BITS) - 1;
constexpr uint32_t MOST_BLOCKS = 1u << (32 - DISTANCE_BITS);  // larger models have no grid

struct Store {
  bool mesh = false;
  double reach = 0, extent = 0;
  Vec3 centre{};
  float slack = 0;  // bound of the error of any single-precision distance [m]
  double tie = 0, tie2 = 0;  // distances nearer each other than this are equal [m], and its square
  double grain = 0;  // median diagonal of a block [m]

  uint32_t blocks = 0;
  uint8_t last_valid = 0xff;        // lanes of the last block that are not padding
  Many<int32_t> id;          // of the caller's faces or points, LANES a block
  Many<Vec3> points;         // LANES a block, a cloud's
  Many<Triangle> triangles;  // LANES a block, a mesh's
  Many<Vec3> normals;        // LANES a block, a cloud's
  Many<PointBlock> point_blocks;
  Many<TriangleBlock> triangle_blocks;
  Many<Box> boxes;        // of each block, relative to the centre
  Many<Node> nodes;       // preorder
  Many<NodeSides> sides;  // of each node, a mesh's
  Many<uint32_t> clear;   // LANES a block, a mesh's: levels of `clear_radius`, four bits each: at the middle of the face, inside
                          // it, and on its sides ab, bc and ca

  Vec3 low{};       // corner of the grid
  double cell = 0;  // side of a cell [m]; 0: no grid
  float step = 0;   // unit of distances in the lists [m]
  int32_t size[3]{};             // bricks along each axis
  Many<uint32_t> top;     // a word a brick: 0 or 1 + its number
  Many<uint32_t> bricks;  // WORDS a brick
  Many<uint32_t> lists;

  std::size_t bytes() const;
};

// Size of the left part where a node's range of n > 1 blocks is halved. Parts are multiples of a power of eight, so
// that all nodes but the last of each level are full.
inline uint32_t child_capacity(uint32_t n) {
  uint32_t c = 1;
  while ((uint64_t)c * 8 < n) c *= 8;
  return c;
}
inline uint32_t left_part(uint32_t n) {
  const uint32_t c = child_capacity(n), parts = (n + c - 1) / c;
  return c * ((parts + 1) / 2);
}

// Half a cell's diagonal, rounded up.
inline float cell_radius(const Store& s) { return (float)(0.8660255 * s.cell) + s.slack; }

// The largest radius, of so many levels, of clear balls on both sides of a face [m]; see clear.cpp. Level 0 is no ball.
constexpr int CLEAR_LEVELS = 5;
constexpr double LEAST_CLEAR = 0.00075;   // of the extent, the radius of the first level; the others are twice as large each
inline double clear_radius(const Store& s, int level) { return level > 0 ? LEAST_CLEAR * (double)(1 << (level - 1)) * s.extent : 0; }

// Distances of a place of a face, in its own plane, from the sides ab, bc and ca; negative outside.
inline std::array<double, 3> side_distances(const Triangle& t, double x, double y) {
  const double ac = std::sqrt(t.cx * t.cx + t.cy * t.cy), bx = t.length - t.cx, bc = std::sqrt(bx * bx + t.cy * t.cy);
  return {y, ((t.length - x) * t.cy - y * bx) / bc, (x * t.cy - y * t.cx) / ac};
}

// Which lanes of the blocks face an eye that is within `margin` of `eye`. `may`: the lane faces at least one such
// place, or rounding cannot tell; `sure`: it faces all of them. A child without any `may` lane is not `alive`.
struct Facing {
  Vec3 eye{};
  double margin = 0;
  std::vector<uint8_t> may, sure;  // a bit a lane, a byte a block
  std::vector<uint8_t> alive;      // a bit a child, a byte a node
};

}  // namespace avs
