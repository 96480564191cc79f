#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "small.hpp"

namespace avs {
namespace {

// G = S M' M S, of which the lower triangle counts, and g = S M' white, with S the diagonal matrix of the sizes.
void normal(const double* M, const double* white, const double* size, size_t m, size_t n, std::vector<double>& G,
            std::vector<double>& g) {
  G.assign(n * n, 0.0), g.assign(n, 0.0);
  for (size_t i = 0; i < m; ++i) {
    const double* row = M + n * i;
    for (size_t r = 0; r < n; ++r) {
      double* to = G.data() + n * r;
      const double factor = row[r];
      for (size_t c = 0; c <= r; ++c) to[c] += factor * row[c];
      g[r] += factor * white[i];
    }
  }
  for (size_t r = 0; r < n; ++r) {
    g[r] *= size[r];
    for (size_t c = 0; c <= r; ++c) G[n * r + c] *= size[r] * size[c];
  }
}

// A + 1 = L L' in the lower triangle of A; b := L^-1 b. Returns 1/2 |b|^2 - log det L, NaN where A is not finite.
double factored(double* A, double* b, size_t n) {
  double gain = 0, log_det = 0;
  for (size_t r = 0; r < n; ++r) {
    double* row = A + n * r;
    for (size_t c = 0; c <= r; ++c) {
      const double* other = A + n * c;
      double s = row[c] + (r == c);
      for (size_t i = 0; i < c; ++i) s -= row[i] * other[i];
      if (c < r) row[c] = s / other[c];
      else row[r] = std::sqrt(s);
    }
    if (!(row[r] > 0) || !std::isfinite(row[r])) return NAN;
    for (size_t i = 0; i < r; ++i) b[r] -= row[i] * b[i];
    b[r] /= row[r];
    gain += b[r] * b[r];
    log_det += log_of(row[r]);
  }
  return 0.5 * gain - log_det;
}

}  // namespace

void after_change(const double* late, const double impulse[6][3], double instant, size_t m, double* out) {
  for (size_t i = 0; i < m; ++i, late += 12, out += 6) {
    double s[3] = {};
    for (int j = 0; j < 6; ++j)
      for (int c = 0; c < 3; ++c) s[c] += late[j] * impulse[j][c];
    for (int c = 0; c < 3; ++c) out[c] = s[c], out[3 + c] = late[9 + c] - instant * late[6 + c];
  }
}

double log_ratio(const double* A, const double* b, size_t n) {
  std::vector<double> L(A, A + n * n), v(b, b + n);
  return factored(L.data(), v.data(), n);
}

double evidence(const double* M, const double* white, const double* size, size_t m, size_t n, double* mean, double* P) {
  std::vector<double> L, v;
  normal(M, white, size, m, n, L, v);
  const double value = factored(L.data(), v.data(), n);
  for (size_t c = 0; c < n; ++c) {  // L^-1 by columns, in the rows of P
    double* x = P + n * c;
    for (size_t r = 0; r < n; ++r) {
      double s = r == c;
      for (size_t i = c; i < r; ++i) s -= L[n * r + i] * x[i];
      x[r] = r < c ? 0 : s / L[n * r + r];
    }
  }
  for (size_t r = 0; r < n; ++r) {
    double s = 0;
    for (size_t i = r; i < n; ++i) s += P[n * r + i] * v[i];
    mean[r] = size[r] * s;
  }
  for (size_t r = 0; r < n; ++r)
    for (size_t c = r; c < n; ++c) {  // row r of L^-1 is needed by no later element
      double s = 0;
      for (size_t i = c; i < n; ++i) s += P[n * r + i] * P[n * c + i];
      L[n * r + c] = size[r] * size[c] * s;
    }
  for (size_t r = 0; r < n; ++r)
    for (size_t c = r; c < n; ++c) P[n * r + c] = P[n * c + r] = L[n * r + c];
  return value;
}

double mixed_evidence(const double* M, const double* white, const double* size, size_t m, size_t n, const double* factors,
                      size_t factor_count, const size_t (*kinds)[2], size_t kind_count) {
  std::vector<double> G, g, A, b, found;
  normal(M, white, size, m, n, G, g);
  for (size_t k = 0; k < kind_count; ++k) {
    const size_t first = kinds[k][0], count = kinds[k][1] - first;
    for (size_t f = 0; f < factor_count; ++f) {
      A.resize(count * count), b.resize(count);
      for (size_t r = 0; r < count; ++r) {
        b[r] = factors[f] * g[first + r];
        for (size_t c = 0; c <= r; ++c) A[count * r + c] = factors[f] * factors[f] * G[n * (first + r) + first + c];
      }
      found.push_back(factored(A.data(), b.data(), count));
    }
  }
  const double top = *std::max_element(found.begin(), found.end());
  double total = 0;
  for (const double one : found) total += exp_of(one - top);
  return top + log_of(total) - log_of((double)found.size());
}

}  // namespace avs
