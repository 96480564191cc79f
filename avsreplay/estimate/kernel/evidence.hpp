// Evidence of Gaussian unknowns that are linear in white data (scan_window.py).
#pragma once
#include <cstddef>
#include <vector>

namespace avs {

// Log evidence of n unknowns u ~ N(0, size^2) in white = M u + N(0, 1), M (m, n), over none; their mean (n) and covariance
// (n, n). Returns NaN where M is not finite.
double evidence(const double* M, const double* white, const double* size, size_t m, size_t n, double* mean, double* P);

// The same over none, without mean and covariance, of unknowns of unit size, from A = M' M (n, n) and b = M' white (n).
double log_ratio(const double* A, const double* b, size_t n);

// Log of the mean of the evidences of several kinds of unknowns, each a range of columns [first, last) of M, at several
// factors on their size.
double mixed_evidence(const double* M, const double* white, const double* size, size_t m, size_t n, const double* factors,
                      size_t factor_count, const size_t (*kinds)[2], size_t kind_count);

// For each of k variances, of n unknowns with that variance each: the same over none, and the fall of the chi-square, from
// A = M' M (n, n), which is overwritten, and b = M' white (n).
void impulse_odds(double* A, std::vector<double> b, const double* variances, size_t k, double* odds, double* fall);

// The inverse (n, n) of a lower triangular L (n, n).
void lower_inverse(const double* L, size_t n, double* out);

// Derivatives (m, 6) of m white data by a change of (rate, velocity) at an instant, from those by the errors of attitude,
// rate, position and velocity at the start (m, 12); a unit of the rate then equals the errors `impulse` of attitude and
// rate at the start.
void after_change(const double* late, const double impulse[6][3], double instant, size_t m, double* out);

}  // namespace avs
