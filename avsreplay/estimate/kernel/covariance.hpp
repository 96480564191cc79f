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

}  // namespace avs
