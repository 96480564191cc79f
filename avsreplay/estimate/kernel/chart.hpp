// The chart of the batch fit (chart.py): a state in {C} with the logarithm M of its second mass moments.
#pragma once
#include "small.hpp"
#include "update.hpp"

namespace avs {

// Attitude of the fixture, rate in {C}, its position and velocity in {A}, M, arm from the centre of mass to it in {C},
// and the principal axes R_cb. An array of 34 numbers in Python.
struct Chart {
  Quad q;
  V3 w, t, u;
  M3 M;
  V3 arm;
  M3 R_cb;
};
constexpr int CHART = 34;
static_assert(sizeof(Chart) == CHART * sizeof(double), "a chart is copied as an array");

// The chart displaced by a step y; M is shortened to the largest norm for which the inertia ratios are below 1.
Chart moved(const Chart& c, const double y[DIM]);

// The step y from `from` to c.
void minus(const Chart& c, const Chart& from, double y[DIM]);

// The chart of a state; |sigma| must be below 1.
Chart chart_of(const State& x);

// The state of a chart.
State state_of(const Chart& c);

// The least difference of two principal values of M.
double least_gap(const Chart& c);

// Jacobian T of state_of: error states d = T y of a small step y.
void errors_of(const Chart& c, double T[DIM][DIM]);

// Inertia over its trace and principal moments (ascending) of a body, with their standard deviations, and the sums of the
// variances of arm and rate. An array of 26 numbers in Python.
struct BodyNumbers {
  double inertia[3][3], inertia_1s[3][3], moments[3], moments_1s[3], arm_variance, rate_variance;
};

// The numbers of a chart with the covariance P of its error states. The inertia is a nonlinear function of M: its
// deviations are those of ten sigma points, at most `largest` standard deviations of M away.
BodyNumbers numbers_of(const Chart& c, const double P[DIM][DIM], double largest);

}  // namespace avs
