// Triangular roots of sums of squares of rows: the observability Gramian.
#pragma once
#include <cstddef>

namespace avs {

// T := the upper triangular root of T' T + B' B, for T (n, n) upper triangular and B (m, n), which is overwritten; by
// Householder's reflections. Signs of the rows of T are arbitrary.
void add_rows(double* T, double* B, size_t m, size_t n);

// B := L^-1 B for the Cholesky factor L of R (m, m) and B (m, n); false where R is not positive definite.
bool whiten(const double* R, double* B, size_t m, size_t n);

}  // namespace avs
