// All code that is compiled once for each instruction set. AVS_ISA names its namespace and AVS_CODE the function that returns it.
#include <algorithm>
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

#include "facing.hpp"

#include "neighbours.hpp"

#include "cells.hpp"

#include "pass.hpp"

#include "segment.hpp"

#include "field_pass.hpp"

#include "leverage.hpp"

static int64_t closest(const Store& s, const View& v, int64_t first, int64_t last, const double* T, const Facing& facing,
                       bool sided, double bound, const Feet& out) {
  return s.mesh ? closest_kind<Triangles>(s, v, first, last, T, facing, sided, bound, out)
                : closest_kind<Points>(s, v, first, last, T, facing, sided, bound, out);
}

static bool cells(const Store& s, uint32_t block, float band, size_t most, std::vector<Near>& out) {
  return s.mesh ? cells_kind<Triangles>(s, block, band, most, out) : cells_kind<Points>(s, block, band, most, out);
}

static void normals(const Store& s, int64_t first, int64_t last, Vec3* out) {
  for (int64_t lane = first; lane < last; ++lane) out[lane] = normal_at(s, (uint32_t)lane);
}

static void pass(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, Kept* kept, Sums& out) {
  s.mesh ? pass_kind<Triangles>(s, v, first, last, look, kept, out)
         : pass_kind<Points>(s, v, first, last, look, kept, out);
}

static int match(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, const Kept* kept, Match* out,
                 uint16_t* off, Footing* feet) {
  return s.mesh ? match_kind<Triangles>(s, v, first, last, look, kept, out, off, feet)
                : match_kind<Points>(s, v, first, last, look, kept, out, off, feet);
}
}  // namespace AVS_ISA

const Code& AVS_CODE() {
  static const Code code{AVS_NAME, AVS_ISA::cells, AVS_ISA::face, AVS_ISA::closest, AVS_ISA::normals, AVS_ISA::pass, AVS_ISA::match,
                         AVS_ISA::first_face, AVS_ISA::add, AVS_ISA::field_pass, AVS_ISA::reduce};
  return code;
}
}  // namespace avs
