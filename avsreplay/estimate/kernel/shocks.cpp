// Kalman filter and the smoothing recursion of de Jong; matrices of transitions are mostly zeros, which are skipped.
#include "shocks.hpp"

#include <cmath>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "update.hpp"

namespace avs {
namespace {

using Buffer = std::vector<double>;

// out (n, m) += A (n, n) B (n, m), or A' B.
void add_product(const double* A, const double* B, size_t n, size_t m, bool transposed, double* out) {
  for (size_t r = 0; r < n; ++r)
    for (size_t i = 0; i < n; ++i) {
      const double f = A[r * n + i];
      if (f == 0) continue;
      const double* from = B + (transposed ? r : i) * m;
      double* to = out + (transposed ? i : r) * m;
      for (size_t c = 0; c < m; ++c) to[c] += f * from[c];
    }
}

void transpose(const double* A, size_t n, double* out) {
  for (size_t r = 0; r < n; ++r)
    for (size_t c = 0; c < n; ++c) out[c * n + r] = A[r * n + c];
}

// C := A C A', or A' C A, of a symmetric C.
void congruence(const double* A, size_t n, bool transposed, double* C, Buffer& one, Buffer& two) {
  std::fill(one.begin(), one.end(), 0.0);
  add_product(A, C, n, n, transposed, one.data());
  transpose(one.data(), n, two.data());
  std::fill(C, C + n * n, 0.0);
  add_product(A, two.data(), n, n, transposed, C);
}

void symmetrise(double* C, size_t n) {
  for (size_t r = 0; r < n; ++r)
    for (size_t c = 0; c < r; ++c) C[r * n + c] = C[c * n + r] = 0.5 * (C[r * n + c] + C[c * n + r]);
}

// W := S^-1 by Cholesky; returns the sum of the logarithms of the diagonal.
double inverse(const double S[SEEN][SEEN], double W[SEEN][SEEN]) {
  double L[SEEN][SEEN] = {}, inv[SEEN][SEEN] = {}, logs = 0;
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c <= r; ++c) {
      double s = S[r][c];
      for (int i = 0; i < c; ++i) s -= L[r][i] * L[c][i];
      if (r == c) {
        if (!(s > 0)) throw std::invalid_argument("a covariance of a measurement must be positive");
        L[r][r] = std::sqrt(s);
        logs += std::log(L[r][r]);
      } else {
        L[r][c] = s / L[c][c];
      }
    }
  for (int r = 0; r < SEEN; ++r) {
    inv[r][r] = 1 / L[r][r];
    for (int c = 0; c < r; ++c) {
      double s = 0;
      for (int i = c; i < r; ++i) s -= L[r][i] * inv[i][c];
      inv[r][c] = s / L[r][r];
    }
  }
  for (int r = 0; r < SEEN; ++r)
    for (int c = 0; c < SEEN; ++c) {
      W[r][c] = 0;
      for (int i = r > c ? r : c; i < SEEN; ++i) W[r][c] += inv[i][r] * inv[i][c];
    }
  return logs;
}

// out (n, SEEN) := A (n, n) H' for H (SEEN, n), with zeros of H skipped.
void by_rows(const double* A, const double* H, size_t n, double* out) {
  std::fill(out, out + n * SEEN, 0.0);
  for (size_t c = 0; c < SEEN; ++c)
    for (size_t i = 0; i < n; ++i) {
      const double f = H[c * n + i];
      if (f == 0) continue;
      for (size_t r = 0; r < n; ++r) out[r * SEEN + c] += f * A[r * n + i];
    }
}

struct Seen {
  Buffer gain;  // (n, SEEN) P H' S^-1
  double W[SEEN][SEEN], white[SEEN];
};

// The measurement of one knot, taken into mean and covariance.
double take(const TimeModel& model, size_t k, double* m, double* C, Seen& seen, Buffer& CH) {
  const size_t n = model.n;
  const double *H = model.H + k * SEEN * n, *R = model.R + k * SEEN * SEEN, *z = model.z + k * SEEN;
  by_rows(C, H, n, CH.data());
  double S[SEEN][SEEN], v[SEEN];
  for (size_t a = 0; a < SEEN; ++a) {
    v[a] = z[a];
    for (size_t i = 0; i < n; ++i) v[a] -= H[a * n + i] * m[i];
    for (size_t c = 0; c < SEEN; ++c) {
      double s = R[a * SEEN + c];
      for (size_t i = 0; i < n; ++i) s += H[a * n + i] * CH[i * SEEN + c];
      S[a][c] = s;
    }
  }
  const double logs = inverse(S, seen.W);
  double square = 0;
  for (size_t a = 0; a < SEEN; ++a) {
    seen.white[a] = 0;
    for (size_t c = 0; c < SEEN; ++c) seen.white[a] += seen.W[a][c] * v[c];
    square += seen.white[a] * v[a];
  }
  seen.gain.assign(n * SEEN, 0.0);
  for (size_t r = 0; r < n; ++r)
    for (size_t a = 0; a < SEEN; ++a)
      for (size_t c = 0; c < SEEN; ++c) seen.gain[r * SEEN + c] += CH[r * SEEN + a] * seen.W[a][c];
  for (size_t r = 0; r < n; ++r) {
    for (size_t a = 0; a < SEEN; ++a) m[r] += seen.gain[r * SEEN + a] * v[a];
    for (size_t c = 0; c < n; ++c) {
      double s = 0;
      for (size_t a = 0; a < SEEN; ++a) s += seen.gain[r * SEEN + a] * CH[c * SEEN + a];
      C[r * n + c] -= s;
    }
  }
  symmetrise(C, n);
  return -0.5 * square - logs;
}

// The measurement of one knot on the way back: r and N from after to before it.
void give(const TimeModel& model, size_t k, const Seen& seen, double* r, double* N, Buffer& NM, TimePasses& out) {
  const size_t n = model.n;
  const double* H = model.H + k * SEEN * n;
  double *error = out.error + k * SEEN, *weight = out.weight + k * SEEN * SEEN;
  std::fill(NM.begin(), NM.end(), 0.0);
  for (size_t i = 0; i < n; ++i)
    for (size_t j = 0; j < n; ++j) {
      const double f = N[i * n + j];
      if (f == 0) continue;
      for (size_t a = 0; a < SEEN; ++a) NM[i * SEEN + a] += f * seen.gain[j * SEEN + a];
    }
  for (size_t a = 0; a < SEEN; ++a) {
    error[a] = seen.white[a];
    for (size_t i = 0; i < n; ++i) error[a] -= seen.gain[i * SEEN + a] * r[i];
    for (size_t c = 0; c < SEEN; ++c) {
      double s = seen.W[a][c];
      for (size_t i = 0; i < n; ++i) s += seen.gain[i * SEEN + a] * NM[i * SEEN + c];
      weight[a * SEEN + c] = s;
    }
  }
  // N += H' (weight H - NM') - NM H
  Buffer X(SEEN * n, 0.0);
  for (size_t a = 0; a < SEEN; ++a)
    for (size_t i = 0; i < n; ++i) {
      X[a * n + i] -= NM[i * SEEN + a];
      for (size_t c = 0; c < SEEN; ++c) X[a * n + i] += weight[a * SEEN + c] * H[c * n + i];
    }
  for (size_t a = 0; a < SEEN; ++a)
    for (size_t i = 0; i < n; ++i) {
      const double f = H[a * n + i];
      if (f == 0) continue;
      r[i] += f * error[a];
      for (size_t j = 0; j < n; ++j) {
        N[i * n + j] += f * X[a * n + j];
        N[j * n + i] -= f * NM[j * SEEN + a];
      }
    }
  symmetrise(N, n);
}

}  // namespace

void pass_over(const TimeModel& model, TimePasses& out) {
  const size_t n = model.n, square = n * n;
  Buffer one(square), two(square), m(model.m0, model.m0 + n), C(model.P0, model.P0 + square), next(n), CH(n * SEEN);
  std::vector<Seen> seen(model.count);
  out.likelihood = 0;
  for (size_t k = 0; k < model.count; ++k) {
    if (k) {
      const double* F = model.F + k * square;
      std::memcpy(next.data(), model.b + k * n, n * sizeof(double));
      add_product(F, m.data(), n, 1, false, next.data());
      m = next;
      congruence(F, n, false, C.data(), one, two);
      for (size_t i = 0; i < square; ++i) C[i] += model.Q[k * square + i];
    }
    std::memcpy(out.mean + k * n, m.data(), n * sizeof(double));
    std::memcpy(out.covariance + k * square, C.data(), square * sizeof(double));
    if (model.used[k]) out.likelihood += take(model, k, m.data(), C.data(), seen[k], CH);
  }
  if (!out.score) return;
  Buffer r(n, 0.0), N(square, 0.0);
  for (size_t k = model.count; k-- > 0;) {
    if (k + 1 < model.count) {
      const double* F = model.F + (k + 1) * square;
      std::fill(next.begin(), next.end(), 0.0);
      add_product(F, r.data(), n, 1, true, next.data());
      r = next;
      congruence(F, n, true, N.data(), one, two);
    }
    if (model.used[k]) give(model, k, seen[k], r.data(), N.data(), CH, out);
    std::memcpy(out.score + k * n, r.data(), n * sizeof(double));
    std::memcpy(out.information + k * square, N.data(), square * sizeof(double));
  }
}

}  // namespace avs
