// Planes of the nearest points, and normal equations of distances between corresponding points.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "symmetric.hpp"

namespace avs {

// Least principal direction of points, the sum of their squared distances from the plane, and their number.
struct Plane {
  double normal[3] = {0, 0, 0};
  double square = 0;
  int64_t count = 0;
};

// The plane of the points `near` (squared distance, number) whose normals `sides` agree with `own`; `end` is no point.
inline Plane plane_of(const std::vector<std::pair<double, int64_t>>& near, const double* points, const double* sides,
                      const double* own, double least_cosine, int64_t end) {
  Plane plane;
  const double* used[100];
  double mean[3] = {0, 0, 0}, A[3][3] = {}, V[3][3];
  for (const auto& [d2, number] : near) {
    if (number == end || !(dot(sides + 3 * number, own) > least_cosine)) continue;
    used[plane.count] = points + 3 * number;
    for (int a = 0; a < 3; ++a) mean[a] += used[plane.count][a];
    ++plane.count;
  }
  if (plane.count == 0) return plane;
  for (double& x : mean) x /= (double)plane.count;
  for (int64_t k = 0; k < plane.count; ++k) {
    const double off[3] = {used[k][0] - mean[0], used[k][1] - mean[1], used[k][2] - mean[2]};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) A[a][b] += off[a] * off[b];
  }
  eigen(A, V, 3, 1e-30);
  const int first = A[1][1] < A[0][0] ? 1 : 0, least = A[2][2] < A[first][first] ? 2 : first;
  for (int a = 0; a < 3; ++a) plane.normal[a] = V[a][least];
  plane.square = std::max(A[least][least], 0.0);
  return plane;
}

// Sums over the corresponding points from[k] and to[k], k in [begin, end): J'WJ (6, 6) and J'We (6) of steps [theta; v] of
// the first points, with e the distance along the mean of both normals and Tukey's weights times those of the points.
// totals: sum of the squares of Tukey's function, and of the weights.
inline void add_pairs(const double* p, const double* n, const double* weight, const int64_t* from, const int64_t* to,
                      int64_t begin, int64_t end, double gate, double* N, double* g, double* e, double* totals) {
  double M[21] = {}, r[6] = {};
  for (int64_t k = begin; k < end; ++k) {
    const double *pa = p + 3 * from[k], *pb = p + 3 * to[k], *na = n + 3 * from[k], *nb = n + 3 * to[k];
    const double apart[3] = {pb[0] - pa[0], pb[1] - pa[1], pb[2] - pa[2]};
    double u[3] = {na[0] + nb[0], na[1] + nb[1], na[2] + nb[2]};
    const double length = std::sqrt(dot(u, u));
    for (double& x : u) x /= length;
    e[k] = dot(u, apart);
    const double inside = std::max(1.0 - e[k] / gate * (e[k] / gate), 0.0), own = weight[from[k]] * weight[to[k]];
    const double w = inside * inside * own;
    totals[0] += own * (1.0 - inside * inside * inside), totals[1] += own;
    const double J[6] = {pa[1] * u[2] - pa[2] * u[1], pa[2] * u[0] - pa[0] * u[2], pa[0] * u[1] - pa[1] * u[0], u[0], u[1], u[2]};
    double* m = M;
    for (int a = 0; a < 6; ++a) {
      const double wa = w * J[a];
      r[a] += wa * e[k];
      for (int b = a; b < 6; ++b) *m++ += wa * J[b];
    }
  }
  const double* m = M;
  for (int a = 0; a < 6; ++a)
    for (int b = a; b < 6; ++b) N[6 * a + b] = N[6 * b + a] = *m++;
  std::copy(r, r + 6, g);
}

}  // namespace avs
