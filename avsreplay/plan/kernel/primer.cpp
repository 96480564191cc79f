// The closed form uses J_k = int s^k / |P| ds; plain sums in a fixed order.
#include "primer.hpp"

#include <algorithm>
#include <cmath>

#include "vector.hpp"

namespace avs {
namespace {

void by_nodes(const double* P0, const double* D, const double (*nodes)[8], double* first, double* second) {
  for (int i = 0; i < 3; ++i) first[i] = second[i] = 0.0;
  for (int k = 0; k < 8; ++k) {
    const double s = nodes[0][k];
    double P[3];
    for (int i = 0; i < 3; ++i) P[i] = P0[i] + s * D[i];
    const double length = std::sqrt(dot(P, P)), r = length > 0.0 ? length : 1.0;
    for (int i = 0; i < 3; ++i) {
      const double w = P[i] / r * nodes[1][k];
      first[i] += w;
      second[i] += w * (1.0 - s);
    }
  }
}

void closed(const double* P0, const double* P1, const double* D, double r0, double r1, double length, double least,
            double* first, double* second) {
  const double along = dot(P0, P1);
  const double cross[3] = {P0[1] * P1[2] - P0[2] * P1[1], P0[2] * P1[0] - P0[0] * P1[2],
                           P0[0] * P1[1] - P0[1] * P1[0]};
  const double opposed = 2.0 * dot(cross, cross) / std::max(r0 * r1 - along, least);
  const double gap = std::max(along > 0.0 ? 2.0 * (r0 * r1 + along) : opposed, least);
  const double total = r0 + r1 + length;
  const double log = std::log(std::max(total * total, least) / gap) / length * length;
  double e[3], across[3];
  for (int i = 0; i < 3; ++i) e[i] = D[i] / length;
  const double u0 = dot(P0, e), u1 = dot(P1, e);
  for (int i = 0; i < 3; ++i) across[i] = P0[i] - u0 * e[i];
  const double i1 = r1 - r0, i2 = 0.5 * (u1 * r1 - u0 * r0 - dot(across, across) * log);
  const double square = length * length, s_e = (i2 - u0 * i1) / square, s_n = (i1 - u0 * log) / square;
  for (int i = 0; i < 3; ++i) {
    first[i] = (i1 * e[i] + log * across[i]) / length;
    second[i] = first[i] - (s_e * e[i] + s_n * across[i]);
  }
}

}  // namespace

void primer_integrals(const double* P0, const double* P1, size_t n, const double (*nodes)[8], double turn, double least,
                      double* first, double* second) {
  for (size_t k = 0; k < 3 * n; k += 3) {
    const double *a = P0 + k, *b = P1 + k;
    const double D[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
    const double r0 = std::sqrt(dot(a, a)), r1 = std::sqrt(dot(b, b)), length = std::sqrt(dot(D, D));
    if (length < turn * (r0 + r1) || length == 0.0)
      by_nodes(a, D, nodes, first + k, second + k);
    else
      closed(a, b, D, r0, r1, length, least, first + k, second + k);
  }
}

}  // namespace avs
