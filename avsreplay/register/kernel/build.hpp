// From vertices and faces to a Store.
#pragma once
#include "hot.hpp"

namespace avs {

struct Surface {
  const double* vertices;  // (n, 3)
  int64_t n_vertices;
  const int32_t* faces;    // (m, 3)
  const int32_t* kept;     // (k): which faces have an area
  int64_t n_kept;          // 0: a cloud
  const double* normals;   // (n, 3) of a cloud
};

void build(Store& store, const Surface& surface, double reach, int threads);
void build_blocks(Store& store, const Surface& surface);  // primitives, blocks, tree
void build_cells(Store& store, const Code& code, int threads);

}  // namespace avs
