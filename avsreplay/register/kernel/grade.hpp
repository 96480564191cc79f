// The quality of a pose in one call: what `evidence` sums up, and what follows from the sums, see register/quality.py.
#pragma once
#include "covariance.hpp"
#include "evidence.hpp"
#include "noise.hpp"

namespace avs {

struct GradeRule {
  PatchRule patches;             // its `facing` says whether the camera may be where the faces look
  double extent;                 // of the model [m]
  int64_t tested;                // points of the scan, about, that tell whether it is
  double least_facing;           // share of them on faces towards it, at least
  double noise, noise_floor;     // standard deviation of e [m]; 0: estimated, and not below the floor
  double least_inliers, least_ratio;  // with fewer there is no overlap
  double least_information;      // scaled information below which a motion is not observable
  bool systematic;               // the covariance includes systematic errors
  double turn, move;             // accuracy of the back end [rad, m]
  std::vector<double> across;    // (k, 3) directions of the test of halves
  double beyond, least_close;    // [m], see `well_off`; with a smaller share of inliers all others are counted
  int64_t part;
  NoiseRule simulated;           // what the noise adds is taken from the sums, if it has numbers
};

// The sums of the patches as arrays.
struct PatchArrays {
  std::vector<double> normals, gradients, offsets, errors, places;  // (m, 6, 6), (m, 6), (m, 6), (m), (m, 3)
  std::vector<int64_t> counts, number;  // number: of the patch among those of the evidence

  PatchArrays() = default;
  explicit PatchArrays(const std::vector<PatchSums>& patches);
  // Leaves out the patches that give too much of the information on some motion. `all`: of the sum of the normals.
  // Returns whether there were any.
  bool drop(const Inverted& all);
  // Takes the expected gradients and errors of all patches of the evidence from those of these patches.
  void without(const std::vector<std::array<double, 7>>& expected);
  int64_t size() const { return (int64_t)counts.size(); }
};

struct Grade {
  int64_t points = 0, inliers = 0, used = 0;  // used: in the patches that are not left out
  double rms, noise, centre[3];
  Six total;                     // of the normals of the patches used
  double statistic = 0;          // g' N^+ g / noise^2 of all patches
  bool overlap = false, observable = false;
  PatchArrays patches;           // those used, where there is overlap but not every motion is observable
  bool measured = false;         // what follows is known: there is overlap, and every motion is observable
  bool bounded = true, beyond = false;  // standard deviations below the extent; the residuals ask for a step
  int64_t well_off = 0;          // of `part` points, those off the model by `beyond`, see `count_beyond`
  Estimated covariance;
  std::array<double, 6> bias{}, left{};  // of the pose, see `NoiseEffect`
  Six chance = {};
  double split;                  // NaN: not tested
  std::array<double, 2> size{};  // of `size_error`
};

Grade grade(const Store& store, const Code& code, const View& points, const double* T, const GradeRule& rule, Team& team,
            const Matches* matches);

}  // namespace avs
