// Integrals of the primer-vector law (eq:u).
#pragma once
#include <cstddef>

namespace avs {

// Integrals of w = P/|P| and of (1 - s) w over s in [0, 1] for n vectors P(s) from P0 to P1, each n x 3. Where the
// direction of P hardly changes (``turn``: |P1 - P0| over |P0| + |P1|), eight Gauss nodes (position, weight) replace
// the closed form. ``least`` is the floor of divisors.
void primer_integrals(const double* P0, const double* P1, size_t n, const double (*nodes)[8], double turn, double least,
                      double* first, double* second);

}  // namespace avs
