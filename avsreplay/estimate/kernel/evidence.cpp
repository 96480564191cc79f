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
    if (std::all_of(row, row + n, [](double one) { return one == 0; })) continue;  // of a scan before the change
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

// A symmetric A := Q' A Q, of which the diagonal d (n) and the elements e (n - 1) beside it are not zero, and b := Q' b, by
// Householder's reflections (Golub and Van Loan, Matrix Computations, section 8.3.1).
void tridiagonal(double* A, std::vector<double>& b, std::vector<double>& d, std::vector<double>& e) {
  const size_t n = b.size();
  std::vector<double> v(n), p(n);
  d.resize(n), e.assign(n, 0.0);
  for (size_t k = 0; k < n; ++k) {
    const double* column = A + n * k;
    d[k] = column[k];
    if (k + 1 == n) break;
    double beyond = 0, vb = 0, vp = 0;
    for (size_t i = k + 2; i < n; ++i) beyond += column[i] * column[i];
    e[k] = column[k + 1];
    if (beyond == 0) continue;
    e[k] = -std::copysign(std::sqrt(column[k + 1] * column[k + 1] + beyond), column[k + 1]);
    for (size_t i = k + 1; i < n; ++i) v[i] = column[i] - (i == k + 1 ? e[k] : 0), p[i] = 0;
    const double beta = 2 / (v[k + 1] * v[k + 1] + beyond);
    for (size_t r = k + 1; r < n; ++r) {
      const double* row = A + n * r;
      const double f = beta * v[r];
      for (size_t c = k + 1; c < n; ++c) p[c] += f * row[c];
      vb += v[r] * b[r];
    }
    for (size_t i = k + 1; i < n; ++i) vp += v[i] * p[i];
    for (size_t i = k + 1; i < n; ++i) {
      p[i] -= 0.5 * beta * vp * v[i];
      b[i] -= beta * vb * v[i];
    }
    for (size_t r = k + 1; r < n; ++r) {
      double* row = A + n * r;
      const double fv = v[r], fp = p[r];
      for (size_t c = k + 1; c < n; ++c) row[c] -= fv * p[c] + fp * v[c];
    }
  }
}

// Logarithm of a product of positive numbers that may be out of range.
class LogProduct {
 public:
  void times(double factor) {
    int power;
    mantissa_ = std::frexp(mantissa_ * factor, &power);
    powers_ += power;
  }
  double log() const { return log_of(2 * mantissa_) + (powers_ - 1) * 0.69314718055994530942; }

 private:
  double mantissa_ = 0.5;
  long powers_ = 1;
};

}  // namespace

void impulse_odds(double* A, std::vector<double> b, const double* variances, size_t k, double* odds, double* fall) {
  std::vector<double> d, e;
  tridiagonal(A, b, d, e);
  for (size_t i = 0; i < k; ++i) {  // by elimination in 1 + variance A
    const double s = variances[i];
    LogProduct determinant;
    double pivot = 1, z = 0, sum = 0;
    for (size_t r = 0; r < b.size(); ++r) {
      const double f = r ? s * e[r - 1] / pivot : 0;
      z = b[r] - f * z;
      pivot = 1 + s * d[r] - (r ? f * s * e[r - 1] : 0);
      determinant.times(pivot);
      sum += z * z / pivot;
    }
    fall[i] = s * sum;
    odds[i] = 0.5 * (fall[i] - determinant.log());
  }
}

void lower_inverse(const double* L, size_t n, double* out) {
  std::fill(out, out + n * n, 0.0);
  for (size_t r = 0; r < n; ++r) {
    double* row = out + n * r;
    for (size_t i = 0; i < r; ++i) {
      const double f = L[n * r + i];
      for (size_t c = 0; c <= i; ++c) row[c] -= f * out[n * i + c];
    }
    for (size_t c = 0; c < r; ++c) row[c] /= L[n * r + r];
    row[r] = 1 / L[n * r + r];
  }
}

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
