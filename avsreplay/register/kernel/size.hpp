// One least-squares step of the size of a target, fitted with its pose to the points of a scan, see register/size.py.
#pragma once
#include "loop.hpp"

namespace avs {

struct SizeRule {
  double most;               // [m] points farther from the model are left out
  int64_t least;             // points that are needed
  double normal_quantile;    // median |e| over standard deviation
  double cauchy;             // width of the weights in standard deviations
  double least_information;  // least share of the effect of the size that no pose explains
};

struct SizeStep {
  bool found = false;
  double size = 0, pose[6], centre[3];  // of the size; of the pose about the centre
};

// points: (n, 3) in {C}; eye: the camera, or null, where all faces count.
SizeStep size_step(const Store& store, const Code& code, const double* points, int64_t n, const Vec3* eye, const SizeRule& rule);

}  // namespace avs
