// What is compiled once for each instruction set, and how to call it.
#pragma once
#include "layout.hpp"

namespace avs {

// (n, 3) numbers with any strides [bytes].
struct View {
  const char* data;
  int64_t n, row, column;
  bool single;
};

constexpr int CHUNK = 512;  // points; partial sums are added in the order of chunks

enum class Pass { point, plane };

// What one pass does.
struct Look {
  const double* T;  // rows of [R t], scan into {C}; t is also where the camera is
  double gate2;
  Pass kind;
  bool facing;  // only primitives that face the camera count
};

// Sums over a chunk or a scan; p, foot relative to the model's centre, e = n . (foot - p), J = [p x n, n].
//   always: [0] inliers, [1] sum d2, [2] points not finite, [3] searches made, [4..6] sum p
//   point:  [7..9] sum foot, [10..18] sum p foot', row by row
//   plane:  [7..27] lower triangle of sum J'J, row by row, [28..33] sum J'e, [34] sum e^2
constexpr int SUMS = 35;
struct Sums {
  double v[SUMS];
};

// Where a point was at its last search, and what was found.
struct Kept {
  double x, y, z;
  float radius2;   // the neighbour is the same nearer than this to (x, y, z)
  int32_t lane;    // 8 block + lane, -1: none
};

struct Feet {
  double* foot;     // (n, 3)
  double* d2;       // (n)
  int32_t* id;      // (n)
  double* normal;   // (n, 3)
};

// A question to `filter`: which of the blocks `in` can hold the nearest primitive of some place in a box?
struct Filter {
  double centre[3];
  double half;
  const uint32_t* in;
  uint32_t n;
  uint32_t* out;      // room for n
  float* scratch;     // room for 8 n
};

struct Filtered {
  uint32_t n;
  double distance;  // of the centre to the nearest primitive [m]
};

constexpr int NEIGHBOURS = 10;  // of a cloud's point, itself among them, that give its normal

struct Code {
  const char* name;
  Filtered (*filter)(const Store&, const Filter&);
  void (*closest)(const Store&, const View&, int64_t first, int64_t last, const Vec3* eye, const Feet&);
  void (*normals)(const Store&, int64_t first, int64_t last, Vec3* out);  // of lanes
  void (*pass)(const Store&, const View&, int64_t first, int64_t last, const Look&, Kept*, Sums&);
};

const Code& code_base();
#if defined(AVS_HAS_AVX2)
const Code& code_avx2();
#endif
// The fastest code this machine runs; the baseline where `portable`. Both give the same bits.
const Code& code(bool portable);

}  // namespace avs
