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

// What a pass adds up: Horn's moments, those and the second derivative of the cost, or the plane's normal equations.
enum class Pass { point, newton, plane };

// What one pass does.
struct Look {
  const double* T;  // rows of [R t], scan into {C}; t is also where the camera is
  double gate;      // [m]
  float lead;       // [m], see Scope; 0: no neighbour is kept for later passes
  Pass kind;
  bool sided;       // only primitives that face the camera count
  const Facing* facing;
  double known = 0;  // what is kept holds for neighbours nearer than this [m]; read by `match` only
};

// Sums over a chunk or a scan; p, foot relative to the model's centre, e = n . (foot - p), J = [p x n, n].
//   always: [0] inliers, [1] sum d2, [2] points not finite, [3] searches made, [4..6] sum p,
//           [50] blocks and nodes of the tree that were compared
//   point:  [7..9] sum foot, [10..18] sum p foot', row by row
//   newton: those, [19..39] lower triangle of sum sign J'J with v in the place of n, [40] sum whole, [41..43] sum whole p,
//           [44..49] lower triangle of sum whole p p'; see Stiffness
//   plane:  [7..27] lower triangle of sum J'J, row by row, [28..33] sum J'e, [34] sum e^2
constexpr int SUMS = 51;
struct Sums {
  double v[SUMS];
};

// Where a point was at its last search, and what was found.
struct Kept {
  double x, y, z;
  float radius2;   // the neighbour is the same nearer than this to (x, y, z); negative: nowhere
  float block2;    // the same of its block, at least radius2
  float pair2;     // the same of that block and `other`
  int32_t lane;    // 8 block + lane, -1: none
  uint32_t other;  // a block, or NO_CHILD
};

struct Feet {
  double* foot;     // (n, 3)
  double* d2;       // (n)
  int32_t* id;      // (n)
  double* normal;   // (n, 3)
};

// An inlier of the scan at a pose, in {C}.
struct Match {
  double p[3], n[3];  // the point, and the normal at its foot
  double e, d2;       // n . (p - foot), and the squared distance
};

// Where the foot of an inlier is, in {C}, and on which primitive.
struct Footing {
  double foot[3];
  int32_t lane;  // 8 block + lane
};

// Where a ray meets a face: its range [m], and the lane of the face, -1: none.
struct Hit {
  double range;
  int32_t lane;
};

// Sums over the inliers of one patch, with J = [p x n, n] about {C}'s origin.
struct PatchSums {
  int64_t points = 0;
  double rows[6][8] = {};  // J' [J, e, 1]
  double last[4] = {};     // [p, e]
};

// A cell near a block: the cell's number, the block, their distance in steps.
struct Near {
  uint64_t cell;
  uint32_t block, steps;
};

// The points sampled from a model and the grid around it, see `Field`; all places are relative to its middle.
struct alignas(32) FieldSample {
  float p[3], rest = 0, n[3], end = 0;
};
struct FieldCell {
  int16_t front = -1, back = -1;
};
struct FieldTable {
  const FieldSample* samples;
  const FieldCell* cells;
  float low[3], cell;
  int32_t size[3];
};

// One pass over m points of a scan, (3, m) with m a multiple of eight; those from `points` on are padding.
struct FieldLook {
  const float* scan;
  int64_t points, m;
  const float* T;    // rows of [R t] to places relative to the middle
  const float* eye;  // the same
  float gate, beyond;
  bool facing, cost_only;
};

// Sum of min(1, d^2 / beyond^2); matched points, lower triangle of J'J and J'e with J = [p x n, n].
struct FieldSums {
  double unexplained, matched, info[21], gradient[6];
};

constexpr int NEIGHBOURS = 10;  // of a cloud's point, itself among them, that give its normal

struct Code {
  const char* name;
  // Appends the cells nearer than `band` to a block; false once there are more than `most`.
  bool (*cells)(const Store&, uint32_t block, float band, size_t most, std::vector<Near>&);
  void (*face)(const Store&, const Vec3* eye, double margin, Facing&);
  // The closest points of a scan moved by T; returns how many blocks and nodes of the tree the searches compared.
  int64_t (*closest)(const Store&, const View&, int64_t first, int64_t last, const double* T, const Facing&, bool sided,
                     double bound, const Feet&);
  void (*normals)(const Store&, int64_t first, int64_t last, Vec3* out);  // of lanes
  void (*pass)(const Store&, const View&, int64_t first, int64_t last, const Look&, Kept*, Sums&);
  // The inliers among a chunk's points, in their order; returns how many. `kept`: where the searches begin, or null; what
  // is said there must hold for the eye of `look`, and below its `known`. `off`: the numbers of the others, or null; `feet`:
  // of the inliers, or null.
  int (*match)(const Store&, const View&, int64_t first, int64_t last, const Look&, const Kept* kept, Match* out, uint16_t* off,
               Footing* feet);
  // The first face of a mesh on a ray from `eye` with the unit direction d between two ranges.
  Hit (*first_face)(const Store&, const Vec3& eye, const double* d, double from, double to);
  // Adds the n matches that `order` names, ascending; partial sums of those of a chunk are added in the order of chunks.
  void (*add)(const Match*, const uint32_t* order, int64_t n, PatchSums&);
  void (*field_pass)(const FieldTable&, const FieldLook&, FieldSums&);
  // The gradients (m, 6) of patches with normals (m, 6, 6) in the axes of W (6, 6), without the effect of their own leverage.
  void (*reduce)(const double* normals, const double* gradients, int64_t m, const double* W, double* out, uint8_t* done);
};

const Code& code_base();
#if defined(AVS_HAS_AVX2)
const Code& code_avx2();
#endif
// The fastest code this machine runs; the baseline where `portable`. Both give the same bits.
const Code& code(bool portable);

}  // namespace avs
