// The innovation of a measured pose, and what the noise adaptation takes from the pose after the update.
#pragma once
#include "fit.hpp"

namespace avs {

// Whether A, of which the lower triangle is used, is positive definite.
bool definite(const double A[SEEN][SEEN]);

// Jacobian of a pose at zero error: [-2A(q)[c x] 0 I 0 0 A(q) 0; I 0 0 0 0 0 I].
void pose_jacobian(const State& x, double H[SEEN][DIM]);

// H P H' of a pose.
void pose_covariance(const Square P, const double H[SEEN][DIM], double out[SEEN][SEEN]);

// S = H P H' + R, symmetric, and e' S^-1 e of the innovation e.
double innovation(const Square P, const double H[SEEN][DIM], const double e[SEEN], const double R[SEEN][SEEN],
                  double S[SEEN][SEEN]);

// tr B of B = total^-1 part.
double trace_of_ratio(const double part[SEEN][SEEN], const double total[SEEN][SEEN]);

// tr B^2 + (tr B)^2 of B = total^-1 part.
double squared_traces(const double part[SEEN][SEEN], const double total[SEEN][SEEN]);

// Squares of e and the trace of C of the position given the attitude, and of the attitude, in units of R.
void block_squares(const double R[SEEN][SEEN], const double e[SEEN], const double C[SEEN][SEEN], double squares[2],
                   double known[2]);

// The fixture of a state at another place s of {C}, and P of the errors of that state.
void shift(State& x, const double s[3]);
void shift(State& x, Square P, const double s[3]);

}  // namespace avs
