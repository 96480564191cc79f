// Rows of the geometric constraints at a reference path, and the motion of the target between its samples.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "vector.hpp"

namespace avs {

constexpr int ALTERNATIVES = 5;  // cone, corridor, sphere, body, workspace
using Pairs = std::array<double, ALTERNATIVES>;

// Scalar rows vector.(r) + offset + rate (h/h_ref - 1) + slack at instants of the reference; sizes of their groups.
struct PointRows {
  std::vector<int64_t> interval, sizes;
  std::vector<double> fraction, vector, offset, rate, slack;
};

// Limits; a constraint that is not set is NaN.
struct ConstraintLimits {
  std::array<double, 2> tangent, range;  // of the cone and the corridor
  double mouth, keepout, release, clearance, reach_max, reach_min;
  double far;          // a constraint with a larger margin is left out
  double toward_axis;  // weight of the fixture's axis in the direction away from the grasp point
};

// The target in {C} and the base of the robot in {A}.
struct ConstraintFrame {
  Vector3 axis, side, cross, centre, base;
};

// One point of the reference for each middle and end of an interval.
struct ReferencePoints {
  size_t count;
  const Vector3 *y, *dy;       // position in {C}, and its change with the relative change of the end time
  const Vector3 *r, *rho;      // position and origin of {C} in {A}
  const Matrix3* R;            // R_ac
  const Pairs *first, *second; // margins of the two alternatives
  const Pairs* off;            // tightening of the constraints
  const Vector3* foot;         // closest points of the surface in {C}
  const double *distance, *clearance;
  const uint8_t* inside;       // (count, 5): the first alternative is required
};

// Rows that must not be negative, and groups whose first row bounds the norm of the others.
void constraint_rows(const ReferencePoints& at, const ConstraintFrame& frame, const ConstraintLimits& limits,
                     PointRows& planes, PointRows& cones);

// Coefficients (4, n - 1, width), highest power first, of the cubic spline through n >= 4 values (n, width) at ascending x
// whose third derivative is continuous also at the second node from each end ("not a knot").
void spline(const double* x, const double* y, size_t n, size_t width, double* c);

// Value (order 0) or derivative (order 1) of cubic pieces at m instants: coefficients c (4, n, width), highest power
// first, of t - x[k] in [x[k], x[k + 1]]; the first ``split`` values of an instant go to ``a``, the others to ``b``.
void piecewise(const double* c, const double* x, size_t n, size_t width, const double* times, size_t m, int order,
               size_t split, double* a, double* b);

}  // namespace avs
