// The likelihood ratio of a change of the velocities within the last intervals between scans (scan_window.py).
#include <cmath>
#include <cstring>
#include <vector>

#include "small.hpp"
#include "update.hpp"

namespace avs {
namespace {

constexpr double PART[2] = {0.875, 0.125};  // parts of an interval that the change has acted for

constexpr double MOST_LOG_ODDS = 600;  // log of a likelihood ratio, larger ones are cut

// One change: the log of its likelihood ratio, and the second moments of the estimate's error, effect effect'.
struct Candidate {
  double log_ratio, effect[DIM][4];
};

// Log evidence of white unknowns v in size A v = b, over none, and the second moments of their effect F size v. These are a
// product of factors, so that they are no less than 0 where some directions of the state are not determined and F is large.
void evidence(const double A[SEEN][SEEN], const double b[SEEN], const double F[DIM][SEEN], int first, double size,
              Candidate& out) {
  double L[3][3], D[3], det = 1, v[3];
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c <= r; ++c) {
      double s = (r == c) + size * size * A[first + r][first + c];
      for (int i = 0; i < c; ++i) s -= L[r][i] * D[i] * L[c][i];
      if (c < r) L[r][c] = s / D[c];
      else det *= D[r] = std::max(s, 1.0);  // exactly at least 1
    }
  for (int r = 0; r < 3; ++r) {
    v[r] = size * b[first + r];
    for (int i = 0; i < r; ++i) v[r] -= L[r][i] * v[i];
  }
  for (int r = 2; r >= 0; --r) {
    v[r] /= D[r];
    for (int i = r + 1; i < 3; ++i) v[r] -= L[i][r] * v[i];
  }
  double gain = 0;
  for (int r = 0; r < 3; ++r) gain += 0.5 * size * b[first + r] * v[r];
  out.log_ratio = gain - 0.5 * log_of(det);
  for (int k = 0; k < DIM; ++k) {
    const double* f = F[k] + first;
    out.effect[k][3] = size * (f[0] * v[0] + f[1] * v[1] + f[2] * v[2]);
    double x[3];
    for (int r = 0; r < 3; ++r) {
      x[r] = f[r];
      for (int i = 0; i < r; ++i) x[r] -= L[r][i] * x[i];
      out.effect[k][r] = size * x[r] / std::sqrt(D[r]);
    }
  }
}

}  // namespace

double change_ratio(const Used* scans, int count, const double one_sigma[2], const std::vector<double>& sizes, double scale,
                    double share, double most, double P[DIM][DIM]) {
  std::vector<Candidate> found;
  for (int k = 0; k < count; ++k) {
    const double wider = scale * (1 + (count - 1 - k) * share);  // errors that the scans from k on have in common
    for (const double part : PART) {
      double F[DIM][SEEN], A[SEEN][SEEN] = {}, b[SEEN] = {};
      for (int r = 0; r < DIM; ++r)
        for (int c = 0; c < SEEN; ++c)  // rate and velocity change; attitude and position follow for part of the interval
          F[r][c] = scans[k].Phi[r][c < 3 ? 3 + c : 6 + c] * (r < 3 || (r >= 6 && r < 9) ? part : 1.0);
      for (int j = k; j < count; ++j) {
        const Used& scan = scans[j];
        double M[SEEN][SEEN] = {}, white[SEEN][SEEN + 1] = {};  // of unit variance: M, then the innovation
        if (j > k) {
          double before[DIM][SEEN];
          std::memcpy(before, F, sizeof F);
          std::memset(F, 0, sizeof F);
          for (int r = 0; r < DIM; ++r)
            for (int i = 0; i < DIM; ++i)
              for (int c = 0; c < SEEN; ++c) F[r][c] += scan.Phi[r][i] * before[i][c];
        }
        for (int r = 0; r < SEEN; ++r)
          for (int i = 0; i < DIM; ++i)
            for (int c = 0; c < SEEN; ++c) M[r][c] += scan.H[r][i] * F[i][c];
        for (int r = 0; r < SEEN; ++r)
          for (int i = 0; i <= r; ++i) {
            for (int c = 0; c < SEEN; ++c) white[r][c] += scan.root[r][i] * M[i][c];
            white[r][SEEN] += scan.root[r][i] * scan.alpha[i];
          }
        for (int r = 0; r < SEEN; ++r)
          for (int i = 0; i < SEEN; ++i) {
            b[r] += white[i][r] * white[i][SEEN] / wider;
            for (int c = 0; c < SEEN; ++c) A[r][c] += white[i][r] * white[i][c] / wider;
          }
        for (int r = 0; r < DIM; ++r)  // what the update leaves of the error
          for (int i = 0; i < SEEN; ++i)
            for (int c = 0; c < SEEN; ++c) F[r][c] -= scan.Kt[i][r] * M[i][c];
      }
      for (int kind = 0; kind < 2; ++kind) {
        double largest = 0;
        for (const auto& row : F)
          for (int c = 3 * kind; c < 3 * kind + 3; ++c) largest = std::max(largest, std::fabs(row[c]));
        for (const double size : sizes) {
          if (!(largest * size * one_sigma[kind] <= most)) continue;
          Candidate one;
          evidence(A, b, F, 3 * kind, size * one_sigma[kind], one);
          found.push_back(one);
        }
      }
    }
  }
  std::memset(P, 0, DIM * DIM * sizeof(double));
  if (found.empty()) return 0;
  double top = found[0].log_ratio, total = 0;
  for (const Candidate& one : found) top = std::max(top, one.log_ratio);
  top = std::min(top, MOST_LOG_ODDS);
  const double none = exp_of(-top);
  for (Candidate& one : found) total += one.log_ratio = exp_of(std::min(one.log_ratio - top, 0.0));
  for (const Candidate& one : found) {
    const double weight = (one.log_ratio - none) / total;  // a change as likely as before the scans adds nothing
    if (!(weight > 0)) continue;
    for (int r = 0; r < DIM; ++r)
      for (int c = 0; c <= r; ++c)
        for (int i = 0; i < 4; ++i) P[r][c] += weight * one.effect[r][i] * one.effect[c][i];
  }
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < r; ++c) P[c][r] = P[r][c];
  return exp_of(top) * total / (double)found.size();
}

}  // namespace avs
