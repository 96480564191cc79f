// The quality of a pose: what its inliers tell, summed over patches of the model.
#pragma once
#include "hot.hpp"
#include "team.hpp"

namespace avs {

// Sums over the inliers of one patch, with J = [p x n, n] about {C}'s origin and e = n . (p - foot).
struct PatchSums {
  int64_t points = 0;
  double normals[21] = {};   // lower triangle of J'J, row by row
  double gradients[6] = {};  // e J
};

struct Evidence {
  int64_t points = 0, inliers = 0;
  double sum_d2 = 0, centre[3] = {0, 0, 0};  // centroid of the inliers
  double median = 0;                         // of |e|
  std::vector<PatchSums> patches;            // in the order of their first points
};

struct PatchRule {
  double gate, side;  // [m]; a patch is what lies in one cube of this side
  int least;          // with no more patches than this every point is one
  bool facing;
};

// T: rows of [R t], scan into {C}. Points that are not finite are left out.
Evidence evidence(const Store& store, const Code& code, const View& points, const double* T, const PatchRule& rule,
                  Team& team);

}  // namespace avs
