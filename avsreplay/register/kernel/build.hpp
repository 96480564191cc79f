// From vertices and faces to a Store.
#pragma once
#include "hot.hpp"
#include "team.hpp"

namespace avs {

struct Surface {
  const double* vertices;  // (n, 3)
  int64_t n_vertices;
  const int32_t* faces;    // (m, 3)
  const int32_t* kept;     // (k): which faces have an area
  int64_t n_kept;          // 0: a cloud
};

void build_cells(Store& store, const Code& code, Team& team);
// Fills in how far the surface around each face is flat, for `is_clear`.
void build_clearances(Store& store, const Code& code, Team& team);
// Without `clearances` no point is known to be clear.
void build(Store& store, const Surface& surface, double reach, bool clearances, const Code& code, Team& team);

}  // namespace avs
