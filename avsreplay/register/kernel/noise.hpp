// What the noise of a scan adds, in the mean, to the sums of its patches and to its pose.
#pragma once
#include "covariance.hpp"
#include "evidence.hpp"

namespace avs {

constexpr double SIGMA_PER_MEDIAN = 1.4826;  // standard deviation over median |e| for a normal e

struct NoiseRule {
  std::vector<double> numbers;  // of a standard normal distribution
  int64_t many;                 // points that are simulated, about
  int64_t least, most, small;   // points of the scan for each of them, at least and at most; at least below `quiet`
  double quiet;                 // [m] noise below which a part of them decides whether the others are simulated
};

struct NoiseEffect {
  double bias[6] = {};  // d, T_ac_true = T_ac Exp(d): what chance does not explain of it
  double left[6] = {};  // the rest of the estimate
  Six chance = {};      // covariance of `bias` from the choice of points and of their noise
  std::vector<std::array<double, 7>> patches;  // expected gradient and error of each patch; empty: the noise adds nothing
};

// The samples with noise of both signs, as large as their own, are matched again. Where noise moves the closest point to another
// face, the sums of both do not cancel: their mean is what the noise adds to the patches, and the step of the pose that they ask
// for is its bias. A part of the samples decides whether this is worth while. `look`: of the scan; `all`: of the information of all its
// patches; `noise`: standard deviation of the distances along the normals.
NoiseEffect noise_effect(const Store& store, const Code& code, const Look& look, const Evidence& evidence, double side,
                         const Inverted& all, double noise, const NoiseRule& rule);

}  // namespace avs
