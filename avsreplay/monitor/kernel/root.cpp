#include "root.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace avs {

void add_rows(double* T, double* B, size_t m, size_t n) {
  std::vector<double> v(m), sum(n);
  for (size_t k = 0; k < n; ++k) {
    double* top = T + n * k;
    double largest = std::fabs(top[k]), squares = 0;
    bool zero = true;
    for (size_t i = 0; i < m; ++i) {
      zero = zero && B[n * i + k] == 0;
      largest = std::max(largest, std::fabs(B[n * i + k]));
    }
    if (zero) continue;
    if (!(largest > 0)) largest = 1;  // not a number
    for (size_t i = 0; i < m; ++i) squares += (B[n * i + k] / largest) * (B[n * i + k] / largest);
    squares += (top[k] / largest) * (top[k] / largest);
    const double end = -std::copysign(largest * std::sqrt(squares), top[k]), factor = (end - top[k]) / end;
    for (size_t c = k; c < n; ++c) sum[c] = top[c];
    for (size_t i = 0; i < m; ++i) {
      v[i] = B[n * i + k] / (top[k] - end);
      for (size_t c = k + 1; c < n; ++c) sum[c] += v[i] * B[n * i + c];
    }
    for (size_t c = k + 1; c < n; ++c) top[c] -= factor * sum[c];
    for (size_t i = 0; i < m; ++i)
      for (size_t c = k + 1; c < n; ++c) B[n * i + c] -= factor * sum[c] * v[i];
    top[k] = end;
  }
}

bool whiten(const double* R, double* B, size_t m, size_t n) {
  std::vector<double> L(m * m);
  for (size_t r = 0; r < m; ++r) {
    for (size_t c = 0; c <= r; ++c) {
      double s = R[m * r + c];
      for (size_t i = 0; i < c; ++i) s -= L[m * r + i] * L[m * c + i];
      if (c < r) L[m * r + c] = s / L[m * c + c];
      else if (s > 0 && std::isfinite(s)) L[m * r + r] = std::sqrt(s);
      else return false;
    }
    for (size_t i = 0; i < r; ++i)
      for (size_t c = 0; c < n; ++c) B[n * r + c] -= L[m * r + i] * B[n * i + c];
    for (size_t c = 0; c < n; ++c) B[n * r + c] /= L[m * r + r];
  }
  return true;
}

}  // namespace avs
