#include "size.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "symmetric.hpp"

namespace avs {
namespace {

constexpr double LEAST_DETERMINED = 1e-12;  // of the largest eigenvalue of J'J; motions below it are not made

// What lies near the model.
struct Rows {
  std::vector<double> q, normal, e;
  int64_t size() const { return (int64_t)e.size(); }
};

Rows rows_near(const Store& s, const Code& code, const double* points, int64_t n, const Vec3* eye, double most) {
  std::vector<double> foot((size_t)(3 * n)), d2((size_t)n), normal((size_t)(3 * n));
  std::vector<int32_t> id((size_t)n);
  const double still[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
  const View v{reinterpret_cast<const char*>(points), n, 3 * (int64_t)sizeof(double), sizeof(double), false};
  Facing facing;
  code.face(s, eye, 0, facing);
  code.closest(s, v, 0, n, still, facing, eye != nullptr, std::min(most, s.reach), {foot.data(), d2.data(), id.data(), normal.data()});
  Rows near;
  for (size_t k = 0; k < (size_t)n; ++k) {
    if (!std::isfinite(d2[k])) continue;
    const double *p = points + 3 * k, *f = foot.data() + 3 * k, *m = normal.data() + 3 * k;
    near.q.insert(near.q.end(), p, p + 3), near.normal.insert(near.normal.end(), m, m + 3);
    near.e.push_back(m[0] * (p[0] - f[0]) + m[1] * (p[1] - f[1]) + m[2] * (p[2] - f[2]));
  }
  return near;
}

double median_magnitude(const std::vector<double>& e) {
  std::vector<double> x;
  for (const double value : e) x.push_back(std::fabs(value));
  const auto at = x.begin() + (int64_t)(x.size() / 2);
  std::nth_element(x.begin(), at, x.end());
  return x.size() % 2 ? *at : 0.5 * (*at + *std::max_element(x.begin(), at));
}

// Adds weight J [J, a, e] of one point, J = [r x n, n] with r from the centre and a = n . r.
void add(const double (&r)[3], const double* n, double e, double weight, double (&N)[6][8], double (&of_a)[2]) {
  const double J[6] = {r[1] * n[2] - r[2] * n[1], r[2] * n[0] - r[0] * n[2], r[0] * n[1] - r[1] * n[0], n[0], n[1], n[2]};
  const double a = n[0] * r[0] + n[1] * r[1] + n[2] * r[2];
  for (int i = 0; i < 6; ++i) {
    const double x = weight * J[i];
    for (int j = 0; j < 6; ++j) N[i][j] += x * J[j];
    N[i][6] += x * a, N[i][7] += x * e;
  }
  of_a[0] += weight * a * a, of_a[1] += weight * a * e;
}

// The least steps of the pose for both right-hand sides.
void solve(const double (&N)[6][8], double (&x)[2][6]) {
  double A[6][6], V[6][6], most = 0;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) A[i][j] = N[i][j];
  eigen(A, V, 6, 1e-32);
  for (int k = 0; k < 6; ++k) most = std::max(most, A[k][k]);
  for (int c = 0; c < 2; ++c)
    for (int k = 0; k < 6; ++k) {
      double along = 0;
      for (int i = 0; i < 6; ++i) along += V[i][k] * N[i][6 + c];
      if (A[k][k] > LEAST_DETERMINED * most)
        for (int i = 0; i < 6; ++i) x[c][i] += V[i][k] * along / A[k][k];
    }
}

}  // namespace

SizeStep size_step(const Store& s, const Code& code, const double* points, int64_t n, const Vec3* eye, const SizeRule& rule) {
  const Rows near = rows_near(s, code, points, n, eye, rule.most);
  SizeStep out;
  if (near.size() < rule.least) return out;
  const double noise = std::max(median_magnitude(near.e) / rule.normal_quantile, std::numeric_limits<double>::min());
  for (int a = 0; a < 3; ++a) {
    out.centre[a] = 0;
    for (int64_t k = 0; k < near.size(); ++k) out.centre[a] += near.q[(size_t)(3 * k + a)];
    out.centre[a] /= (double)near.size();
  }
  double N[6][8] = {}, of_a[2] = {}, x[2][6] = {};
  for (size_t k = 0; k < near.e.size(); ++k) {
    const double* q = near.q.data() + 3 * k;
    const double r[3] = {q[0] - out.centre[0], q[1] - out.centre[1], q[2] - out.centre[2]}, t = near.e[k] / (rule.cauchy * noise);
    add(r, near.normal.data() + 3 * k, near.e[k], 1 / (1 + t * t), N, of_a);
  }
  solve(N, x);
  double free = of_a[0], score = of_a[1];  // of what no pose explains
  for (int i = 0; i < 6; ++i) free -= N[i][6] * x[0][i], score -= N[i][6] * x[1][i];
  if (!(free > rule.least_information * of_a[0])) return out;
  out.found = true, out.size = score / free;
  for (int i = 0; i < 6; ++i) out.pose[i] = x[1][i] - out.size * x[0][i];
  return out;
}

}  // namespace avs
