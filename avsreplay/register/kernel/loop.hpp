// The whole alignment, and the sums at one pose.
#pragma once
#include "hot.hpp"
#include "team.hpp"

namespace avs {

struct Rule {
  int n_max, n_plane;
  double gate, tighten, floor, eps_rad, eps_m;
  bool facing, keep, newton;
};

struct Outcome {
  double T[12];  // rows of [R t]
  int passes;
  bool converged;
  int64_t inliers, ignored, searched;
  double rms, gate, turn, move;
};

Sums run_pass(const Store& store, const Code& code, const View& points, const Look& look, Kept* kept, Team& team);
// T: rows of [R t], scan into {C}.
Outcome icp(const Store& store, const Code& code, const View& points, const double* T, const Rule& rule, Team& team);

}  // namespace avs
