// The whole alignment, and the sums at one pose.
#pragma once
#include <vector>

#include "hot.hpp"
#include "team.hpp"

namespace avs {

struct Rule {
  int n_max, n_plane;
  int64_t few;  // points of the passes that come first, see `icp`; 0: all points from the first pass on
  double gate, tighten, floor, eps_rad, eps_m;
  bool facing, keep, newton;
  int64_t most_work;  // after the pass that reaches it the loop ends, not converged
  double poor;        // with a larger rms distance after the passes over few points it ends there; 0: never
};

// In point searches: an ordinary one moves a point and compares two blocks.
inline int64_t work_of(int64_t moved, int64_t compared) { return (moved + 2 * compared) / 5; }

struct Outcome {
  double T[12];  // rows of [R t]
  int passes;      // over all points and over a part of them
  int few_passes;  // of those the ones over a part
  bool converged;
  int64_t inliers, ignored, searched;
  int64_t compared;  // blocks and nodes of the tree
  int64_t moved;     // points, over all passes

  int64_t work() const { return work_of(moved, compared) + PASS_WORK * passes; }
  static constexpr int64_t PASS_WORK = 20;  // cost of a pass over any number of points
  double rms, gate, turn, move;
};

// What the last pass knew of each point, so that a later question at a pose near by need not search again.
struct Matches {
  std::vector<Kept> kept;
  Facing facing;
  double gate = 0;     // below which neighbours were searched for [m]
  bool sided = false;

  // Whether what is kept holds for n points seen from `eye`, with feet nearer than `gate`.
  bool hold(int64_t n, const Vec3& eye, bool sided) const;
};

// Copies point k of a view to p[3].
void copy_point(const View& points, int64_t k, double* p);
Sums run_pass(const Store& store, const Code& code, const View& points, const Look& look, Kept* kept, Team& team);
// T: rows of [R t], scan into {C}. A scan of at least twice `rule.few` points is first aligned by that many of its points,
// or by one in four if these are fewer, until a step is below the error that so few points leave; then all of its points
// go to the fixed point, unless the rms distance of the part is poor. A converged pose is that of the last pass, with
// its inliers and rejection distance: a further step could move a point across that distance, and the next step with it.
Outcome icp(const Store& store, const Code& code, const View& points, const double* T, const Rule& rule, Team& team,
            Matches& matches);

}  // namespace avs
