// Covariances of poses and of states: roots, definiteness, the moments of a mixture, and a step of a belief.
#pragma once
#include "fit.hpp"

namespace avs {

// Lower triangular root with root C root' = 1; false where C is not positive definite.
bool inverse_root(const double C[SEEN][SEEN], double root[SEEN][SEEN]);

// Whether no eigenvalue of P, in units of its variances, is below `least`; false where a variance is not positive.
bool above(const Square P, double least);

// Chart and P (20, 20) of one Gaussian with the moments of a mixture; its mean is that of the first component, and what
// the weights have moved it from the mean of the quadrature.
void join(const Chart* charts, const Square* P, const double* weights, const double* quadrature, int count, Chart& mean,
          Square moments);

// The state h seconds later, the transition Phi of its errors and their covariance P there, with the disturbance noise
// for h > 0. `path` takes position and velocity of the centre of mass there.
void propagate(State& x, Square P, double h, const double path[6][6], const double torque_density[3],
               double force_density, Square Phi);

// The truth in the order of its principal axes that is nearest to an estimate: its number among the rotations R_nb (with the
// quaternions q_bn of their inverses), and e' P^-1 e of the error states e there, of all and of each block (records.BLOCKS);
// `chart`: of the error in the chart, which does not depend on the order. NaN where the part of P is singular; then the
// errors are compared by their variances.
constexpr int BLOCK_COUNT = 7;
struct Errors {
  int best;
  double size, chart, block[BLOCK_COUNT];
};
Errors errors_squared(const State& truth, const State& x, const Square P, const M3* R_nb, const Quad* q_bn, int count);

}  // namespace avs
