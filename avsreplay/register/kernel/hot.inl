// The whole hot code of one instruction set. AVS_ISA names it and AVS_CODE its door.
#include <cmath>
#include <cstring>
#include <limits>
#if defined(__SSE2__)
#include <immintrin.h>
#endif
#include "hot.hpp"

namespace avs {
namespace AVS_ISA {
#include "simd.hpp"

#include "primitive.hpp"

#include "search.hpp"

#include "filter.hpp"

#include "neighbours.hpp"

#include "pass.hpp"

static Filtered filter(const Store& s, const Filter& f) {
  return s.mesh ? filter_kind<Triangles, TrianglePivots>(s, f) : filter_kind<Points, PointPivots>(s, f);
}

static void closest(const Store& s, const View& v, int64_t first, int64_t last, const Vec3* eye, const Feet& out) {
  s.mesh ? closest_kind<Triangles>(s, v, first, last, eye, out) : closest_kind<Points>(s, v, first, last, eye, out);
}

static void normals(const Store& s, int64_t first, int64_t last, Vec3* out) {
  for (int64_t lane = first; lane < last; ++lane) out[lane] = normal_at(s, (uint32_t)lane);
}

static void pass(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, Kept* kept, Sums& out) {
  s.mesh ? pass_kind<Triangles>(s, v, first, last, look, kept, out)
         : pass_kind<Points>(s, v, first, last, look, kept, out);
}
}  // namespace AVS_ISA

const Code& AVS_CODE() {
  static const Code code{AVS_NAME, AVS_ISA::filter, AVS_ISA::closest, AVS_ISA::normals, AVS_ISA::pass};
  return code;
}
}  // namespace avs
