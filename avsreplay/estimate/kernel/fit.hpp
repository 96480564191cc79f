// The cost of the batch fit over the initial values, its linearisation and its minimum (batch.py).
#pragma once
#include <limits>
#include <vector>

#include "chart.hpp"
#include "elimination.hpp"
#include "motion.hpp"

namespace avs {

using Square = double[DIM][DIM];
using Rows = double[SEEN][DIM];

// A measured pose T_ac: time since the epoch, and the inverse Cholesky factor of its covariance.
struct Measured {
  double t;
  M3 place = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, speed = {};  // centre of mass by position and velocity at the epoch
  Quad q;
  V3 p;
  double shift[SEEN];  // added to the residual: the mean of the poses that a normal point stands for
  double root[SEEN][SEEN];
};

// A pseudo-measurement row . (chart - centre) = target that fixes one direction.
struct Pin {
  Chart centre;
  double row[DIM], target, one_sigma;
};

// A constant acceleration u since `onset`: of the body in {C} [rad/s2] and of its centre of mass in {A} [m/s2]. Its prior
// has the information `info` about zero; `row` . u = `target` is a pseudo-measurement of unit standard deviation.
struct Push {
  double onset = std::numeric_limits<double>::infinity();
  double u[SEEN] = {}, info[SEEN] = {}, row[SEEN] = {}, target = 0;
};
constexpr int PUSHED = SEEN + 1;  // derivatives by the acceleration and by its onset

class Problem {
 public:
  std::vector<Measured> poses;
  Chart mean;
  Square prior_info;
  Pin pin;
  bool pinned = false;
  // On the standard deviations of attitude, and of position given the attitude: they divide the rows of root d. A
  // direction that a pose does not determine thus stays the same (pose_noise.py).
  double factors[2] = {1, 1};
  bool redescend = true;  // Cauchy's weights, else Huber's
  double gate = std::numeric_limits<double>::infinity();  // chi-square from which a pose is an outlier
  Push push;

  // The linearisation at the present chart.
  Chart at;
  double cost;
  std::vector<double> d, weights;  // residuals (n, 6), M-estimator weights (n)
  std::vector<double> J, Ju;  // (n, 6, 20) by the error states at the epoch; (n, 6, 7) by the acceleration and its onset
  Square T;  // error states by chart steps

  void linearise(const Chart& chart);
  // Cost at another chart, from the residuals alone; `misfit`: its part without the prior.
  double cost_at(const Chart& chart, double* residuals = nullptr, double* misfit = nullptr) const;
  double trial_cost(const Chart& chart, double* residuals) const;
  // Weights and cost of the present residuals, with the present factors.
  void reweigh();
  // Normal equations A step = b in chart steps.
  void normal(Square A, double b[DIM]) const;
  // Residual and Jacobian (by the error states at the epoch) of a pose, of unit variance.
  void whitened(size_t k, double e[SEEN], Rows H) const;
  // Levenberg-Marquardt from the present linearisation; returns whether the stopping rule was met within `most` steps.
  bool descend(int most, double gain_tol, int& steps);
  // Weighted sum over the poses of the trace of root J P J' root', of the rows of attitude and of position; P in chart
  // steps.
  void absorbed(const Square P, double out[2]) const;
  // Kalman pass over the poses with process noise since an instant [s], from y and P in N = 20 chart steps, or in 27 unknowns
  // with acceleration and onset. The error states of attitude to velocity are in other coordinates than P where two
  // moments are nearly equal; `into` takes them to steps, of which they reach attitude to velocity alone.
  template <int N>
  void smooth(double y[N], double P[N][N], const double into[MOTION][MOTION], const double torque_density[3],
              double force_density, double since) const;
  // Residual and Jacobian of a pose as in `whitened`, by chart steps and the first N - 20 of acceleration and onset.
  template <int N>
  void in_steps(size_t k, double e[SEEN], double H[SEEN][N]) const;

 protected:
  // A motion on from one instant to another, of which the body is driven from the onset on.
  template <class Motion, class At>
  void go(Motion& motion, Body& body, const State& x, double from, double to, At at_onset) const;

 private:
  bool bent(const Square M, const Square A, double step[DIM], std::vector<double>& trial) const;
  double residual(const Measured& pose, const State& x, const Turn& turn, double d[SEEN]) const;
  double robust(double chi2, double* weight) const;
  double penalty(const Chart& chart) const;
};

// The minimum over initial values and a constant acceleration since a given onset, by Levenberg-Marquardt. An acceleration
// is fixed where `open` is false.
constexpr int JOINT = DIM + SEEN;
class Driven : public Problem {
 public:
  bool open[SEEN];
  double A[JOINT][JOINT], b[JOINT], left;  // normal equations, and the decrease of their cost to its minimum

  void linearise(const Chart& chart, const double u[SEEN]);
  // One step with this damping from the present linearisation; returns the damping of the next.
  double step(double damping);

 private:
  void normal();
  double cost_there(const double step[JOINT], double part, double* residuals);
};

// S^-1 of a flow: errors (dq_v, w) at its start with the same effect as a unit error at its end.
void backward(const Flow& flow, double out[6][6]);

// The inverse of A (3, 3).
M3 inverse(const double A[3][3]);

// The transition Phi of the error states over a flow; `path` takes position and velocity of the centre of mass there.
void errors_transition(const Flow& flow, const double join[3][2], const double path[6][6], Square Phi);

// Position and velocity of the centre of mass, moved by `path`.
void translate(State& x, const double path[6][6]);

// A chart h seconds later, the transition F of its steps, and the noise Q that disturbances of these densities add to
// them. `path` takes position and velocity of the centre of mass there. Without densities and Q it is the motion alone.
void transition(Chart& chart, double h, const double path[6][6], const double* torque_density, double force_density,
                Square F, double (*Q)[MOTION]);

// A Gaussian h seconds later, corrected by a pose there, whose time does not matter. P is in steps of `base`, along
// which the Jacobians are taken; `chart` is its mean. `told`: chi-square of
// the pose and log determinant of its covariance, both before the correction and relative to the noise of the pose.
void carry(Chart& chart, Chart& base, Square P, double h, const double path[6][6], const double torque_density[3],
           double force_density, const Measured& pose, const double factors[2], double weight, double told[2]);

// The rotation of a state, and its body with the derivative of sigma1..3 by the two that are states.
Turn turn_of(const State& x);
Body body_of(const State& x, double join[3][2]);

// The variance that the disturbance torque of a root density adds to the rate per second: diagonal of torque^2 B B'.
void torque_density(const State& x, double torque, double density[3]);

// Variances of the grasp point's position, velocity and half-angle attitude t seconds after the state x with covariance
// P, `flow` being the rotation since x.
void forecast(const State& x, const Square P, double force_density, double t, const Flow& flow, double variances[3]);

// Second moments of the grasp point's position, velocity and half-angle attitude about the motion `published`, at n
// ascending times: of a mixture of `count` charts, each with its weight, and its covariance in steps of `references`.
void mixture_forecast(const Chart* charts, const Chart* references, const Square* P, const double* weights,
                      const double (*torque_density)[3], size_t count, const Chart& published, double force_density,
                      const double* times, size_t n, const V3& origin, double (*out)[3]);

}  // namespace avs
