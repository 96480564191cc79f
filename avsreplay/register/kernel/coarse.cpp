#include "coarse.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "step.hpp"
#include "symmetric.hpp"

namespace avs {
namespace {

constexpr double MARGIN = 0.15;     // of the diagonal, around the box; a place beyond it is in the nearest cell of the border
constexpr double DAMPING = 1e-4;    // of the mean information: what is not observable is not moved
constexpr int64_t LEAST_MATCHED = 6;

// b = (H + damping)^-1 b by Cholesky's decomposition.
bool solve(double (&H)[6][6], double* b) {
  for (int j = 0; j < 6; ++j) {
    for (int k = 0; k < j; ++k) H[j][j] -= H[j][k] * H[j][k];
    if (!(H[j][j] > 0)) return false;
    H[j][j] = std::sqrt(H[j][j]);
    for (int i = j + 1; i < 6; ++i) {
      for (int k = 0; k < j; ++k) H[i][j] -= H[i][k] * H[j][k];
      H[i][j] /= H[j][j];
    }
  }
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < i; ++k) b[i] -= H[i][k] * b[k];
    b[i] /= H[i][i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) b[i] -= H[k][i] * b[k];
    b[i] /= H[i][i];
  }
  return true;
}

// Rotation by 2 atan(|d| / 2) about d, in rows of [R t]: the angle |d| where it is small, without a transcendental function.
void turn(const double* d, double* D) {
  const double n = 1 / std::sqrt(1 + 0.25 * dot(d, d)), w = n, x = 0.5 * n * d[0], y = 0.5 * n * d[1], z = 0.5 * n * d[2];
  D[0] = 1 - 2 * (y * y + z * z), D[1] = 2 * (x * y - w * z), D[2] = 2 * (x * z + w * y);
  D[4] = 2 * (x * y + w * z), D[5] = 1 - 2 * (x * x + z * z), D[6] = 2 * (y * z - w * x);
  D[8] = 2 * (x * z - w * y), D[9] = 2 * (y * z + w * x), D[10] = 1 - 2 * (x * x + y * y);
}

}  // namespace

Field::Field(const double* points, const double* normals, int64_t n, int across)
    : samples_((size_t)n) {
  double high[3];
  for (int a = 0; a < 3; ++a) {
    low_[a] = high[a] = points[a];
    for (int64_t k = 1; k < n; ++k) {
      low_[a] = std::min(low_[a], points[3 * k + a]);
      high[a] = std::max(high[a], points[3 * k + a]);
    }
  }
  double extent = 0;
  for (int a = 0; a < 3; ++a) extent += (high[a] - low_[a]) * (high[a] - low_[a]);
  extent = std::max(std::sqrt(extent), std::numeric_limits<double>::min());
  cell_ = extent / across;
  for (int a = 0; a < 3; ++a) {
    low_[a] -= MARGIN * extent;
    size_[a] = (int64_t)std::ceil((high[a] + MARGIN * extent - low_[a]) / cell_);
    middle_[a] = low_[a] + 0.5 * (double)size_[a] * cell_;
  }
  for (int64_t k = 0; k < 3 * n; ++k)
    samples_[(size_t)(k / 3)].p[k % 3] = (float)(points[k] - middle_[k % 3]), samples_[(size_t)(k / 3)].n[k % 3] = (float)normals[k];
  cells_.resize((size_t)(size_[0] * size_[1] * size_[2]));
  for (int64_t k = 0; k < n; ++k) {
    int64_t c[3];
    for (int a = 0; a < 3; ++a) c[a] = std::clamp((int64_t)((points[3 * k + a] - low_[a]) / cell_), (int64_t)0, size_[a] - 1);
    offer(cells_[(size_t)((c[0] * size_[1] + c[1]) * size_[2] + c[2])], (int16_t)k, middle(c[0], c[1], c[2]));
  }
  for (int octant = 0; octant < 8; ++octant) sweep(octant & 1 ? -1 : 1, octant & 2 ? -1 : 1, octant & 4 ? -1 : 1);
}

Vec3 Field::middle(int64_t x, int64_t y, int64_t z) const {
  const double half[3] = {0.5 * (double)size_[0], 0.5 * (double)size_[1], 0.5 * (double)size_[2]};
  return {((double)x + 0.5 - half[0]) * cell_, ((double)y + 0.5 - half[1]) * cell_, ((double)z + 0.5 - half[2]) * cell_};
}

double Field::squared(int16_t id, const Vec3& p) const {
  const float* q = samples_[(size_t)id].p;
  return (q[0] - p.x) * (q[0] - p.x) + (q[1] - p.y) * (q[1] - p.y) + (q[2] - p.z) * (q[2] - p.z);
}

void Field::offer(FieldCell& near, int16_t id, const Vec3& p) const {
  if (id < 0 || id == near.front || id == near.back) return;
  const auto opposite = [&](int16_t i, int16_t j) {
    const float *a = samples_[(size_t)i].n, *b = samples_[(size_t)j].n;
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < 0;
  };
  const double d2 = squared(id, p);
  if (near.front < 0 || d2 < squared(near.front, p)) {
    const int16_t old = near.front;
    near.front = id;
    if (old >= 0 && opposite(old, id)) near.back = old;  // nearer than the old back
    if (near.back >= 0 && !opposite(near.back, id)) near.back = -1;
  } else if (opposite(id, near.front) && (near.back < 0 || d2 < squared(near.back, p))) {
    near.back = id;
  }
}

// Offers the samples of its three predecessors in this order to every cell.
void Field::sweep(int sx, int sy, int sz) {
  const int s[3] = {sx, sy, sz};
  const int64_t stride[3] = {size_[1] * size_[2], size_[2], 1};
  int64_t c[3];
  for (int64_t i = 0; i < size_[0]; ++i)
    for (int64_t j = 0; j < size_[1]; ++j)
      for (int64_t k = 0; k < size_[2]; ++k) {
        c[0] = sx > 0 ? i : size_[0] - 1 - i, c[1] = sy > 0 ? j : size_[1] - 1 - j, c[2] = sz > 0 ? k : size_[2] - 1 - k;
        const int64_t here = c[0] * stride[0] + c[1] * stride[1] + c[2];
        const Vec3 p = middle(c[0], c[1], c[2]);
        for (int a = 0; a < 3; ++a) {
          if (c[a] - s[a] < 0 || c[a] - s[a] >= size_[a]) continue;
          const FieldCell from = cells_[(size_t)(here - s[a] * stride[a])];
          offer(cells_[(size_t)here], from.front, p);
          offer(cells_[(size_t)here], from.back, p);
        }
      }
}

CoarseScan::CoarseScan(const double* from, int64_t n) : points(n), padded((n + 7) / 8 * 8), mean{0, 0, 0} {
  x.resize((size_t)(3 * padded));
  for (int64_t k = 0; k < 3 * n; ++k) mean[k % 3] += from[k];
  for (double& m : mean) m /= (double)std::max<int64_t>(n, 1);
  for (int64_t k = 0; k < n; ++k)
    for (int64_t a = 0; a < 3; ++a) x[(size_t)(a * padded + k)] = (float)(from[3 * k + a] - mean[a]);
}

double Field::refine(const Code& code, const CoarseScan& scan, const CoarseRule& rule, double* T) const {
  const FieldTable table{samples_.data(), cells_.data(), {(float)(low_[0] - middle_[0]), (float)(low_[1] - middle_[1]), (float)(low_[2] - middle_[2])},
                         (float)cell_, {(int32_t)size_[0], (int32_t)size_[1], (int32_t)size_[2]}};
  const double *c = middle_, *q = scan.mean;
  double gate = rule.gate, cost = 1;
  for (int pass = 0; pass <= rule.passes; ++pass) {
    const bool last = pass == rule.passes;  // gives the cost only
    float moved[12], eye[3];
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) moved[4 * a + b] = (float)T[4 * a + b];
      moved[4 * a + 3] = (float)(dot(T + 4 * a, q) + T[4 * a + 3] - c[a]), eye[a] = (float)(T[4 * a + 3] - c[a]);
    }
    FieldSums sums;
    code.field_pass(table, {scan.x.data(), scan.points, scan.padded, moved, eye, (float)gate, (float)rule.beyond, rule.facing, last}, sums);
    cost = sums.unexplained / (double)std::max<int64_t>(scan.points, 1);
    if (last || sums.matched < (double)LEAST_MATCHED) break;
    double H[6][6], *b = sums.gradient;
    for (int i = 0, t = 0; i < 6; ++i)
      for (int j = 0; j <= i; ++j, ++t) H[i][j] = sums.info[t];
    const double turns = (H[0][0] + H[1][1] + H[2][2]) / 3, shifts = (H[3][3] + H[4][4] + H[5][5]) / 3;
    for (int i = 0; i < 6; ++i) H[i][i] += DAMPING * (i < 3 ? turns : shifts);
    if (!solve(H, b)) break;
    double D[12];
    turn(b, D);
    for (int a = 0; a < 3; ++a)
      D[4 * a + 3] = c[a] + b[3 + a] - (D[4 * a] * c[0] + D[4 * a + 1] * c[1] + D[4 * a + 2] * c[2]);
    compose(D, T);
    gate = std::max(rule.floor, rule.fall * gate);
  }
  return cost;
}

std::vector<int64_t> different(const double* T, int64_t n, const double* middle, int64_t most, double trace, double near) {
  std::vector<int64_t> kept;
  std::vector<double> at((size_t)(3 * n));  // R' (middle - t)
  for (int64_t k = 0; k < n; ++k)
    for (int64_t i = 0; i < 3; ++i)
      for (int64_t j = 0; j < 3; ++j) at[(size_t)(3 * k + i)] += T[16 * k + 4 * j + i] * (middle[j] - T[16 * k + 4 * j + 3]);
  for (int64_t k = 0; k < n && (int64_t)kept.size() < most; ++k) {
    const bool same = std::any_of(kept.begin(), kept.end(), [&](int64_t other) {
      const double *a = T + 16 * k, *b = T + 16 * other, *p = at.data() + 3 * k, *q = at.data() + 3 * other;
      const double d[3] = {p[0] - q[0], p[1] - q[1], p[2] - q[2]};
      return dot(a, b) + dot(a + 4, b + 4) + dot(a + 8, b + 8) > trace && dot(d, d) < near * near;
    });
    if (!same) kept.push_back(k);
  }
  return kept;
}

}  // namespace avs
