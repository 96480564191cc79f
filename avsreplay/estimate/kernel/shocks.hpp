// The two passes over a linear Gaussian model in time (events/linear.py).
#pragma once
#include <cstddef>

namespace avs {

// A state of n numbers at `count` knots; see LinearModel in events/linear.py.
struct TimeModel {
  size_t count, n;
  const double *F, *b, *Q, *z, *H, *R, *m0, *P0;
  const bool* used;
};

// What the passes give; see Passed there. `mean` and `covariance` are those before the measurement of a knot.
struct TimePasses {
  double likelihood;
  double *mean, *covariance, *score, *information, *error, *weight;
};

// Forward, and back unless `score` is null. Throws std::invalid_argument where a variance is not positive.
void pass_over(const TimeModel& model, TimePasses& out);

}  // namespace avs
