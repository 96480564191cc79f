#include "coarse.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "step.hpp"

namespace avs {
namespace {

constexpr double MARGIN = 0.15;     // of the diagonal, around the box; beyond it the border's cells answer
constexpr double DAMPING = 1e-4;    // of the mean information: what is not observable is not moved
constexpr int64_t LEAST_MATCHED = 6;

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

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
  for (int64_t k = 0; k < 3 * n; ++k)
    samples_[(size_t)(k / 3)].p[k % 3] = (float)points[k], samples_[(size_t)(k / 3)].n[k % 3] = (float)normals[k];
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
  }
  cells_.resize((size_t)(size_[0] * size_[1] * size_[2]));
  for (int64_t k = 0; k < n; ++k) {
    int64_t c[3];
    for (int a = 0; a < 3; ++a) c[a] = std::clamp((int64_t)((points[3 * k + a] - low_[a]) / cell_), (int64_t)0, size_[a] - 1);
    offer(cells_[(size_t)((c[0] * size_[1] + c[1]) * size_[2] + c[2])], (int16_t)k, middle(c[0], c[1], c[2]));
  }
  for (int octant = 0; octant < 8; ++octant) sweep(octant & 1 ? -1 : 1, octant & 2 ? -1 : 1, octant & 4 ? -1 : 1);
}

Vec3 Field::middle(int64_t x, int64_t y, int64_t z) const {
  return {low_[0] + ((double)x + 0.5) * cell_, low_[1] + ((double)y + 0.5) * cell_, low_[2] + ((double)z + 0.5) * cell_};
}

double Field::squared(int16_t id, const Vec3& p) const {
  const float* q = samples_[(size_t)id].p;
  return (q[0] - p.x) * (q[0] - p.x) + (q[1] - p.y) * (q[1] - p.y) + (q[2] - p.z) * (q[2] - p.z);
}

void Field::offer(Near& near, int16_t id, const Vec3& p) const {
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

// Hands every cell what its three predecessors in this order know.
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
          const Near from = cells_[(size_t)(here - s[a] * stride[a])];
          offer(cells_[(size_t)here], from.front, p);
          offer(cells_[(size_t)here], from.back, p);
        }
      }
}

const Field::Near& Field::at(const double* p) const {
  int64_t c[3];
  for (int a = 0; a < 3; ++a) {
    const double x = (p[a] - low_[a]) / cell_;
    c[a] = x > 0 ? (x < (double)size_[a] ? (int64_t)x : size_[a] - 1) : 0;
  }
  return cells_[(size_t)((c[0] * size_[1] + c[1]) * size_[2] + c[2])];
}

// The distance is to the piece of the plane, about a cell wide, that the sampled point stands for.
bool Field::match(const double* p, const double* eye, bool facing, Match& m) const {
  const Near& near = at(p);
  for (const int16_t id : {near.front, near.back}) {
    if (id < 0) break;
    const Sample& s = samples_[(size_t)id];
    const double n[3] = {s.n[0], s.n[1], s.n[2]}, d[3] = {s.p[0] - p[0], s.p[1] - p[1], s.p[2] - p[2]};
    if (facing && n[0] * (eye[0] - s.p[0]) + n[1] * (eye[1] - s.p[1]) + n[2] * (eye[2] - s.p[2]) <= 0) continue;
    const double e = dot(n, d), all = dot(d, d), beside = std::max(0.0, all - e * e - cell_ * cell_);
    m = {&s, e, e * e + beside};
    return true;
  }
  return false;
}

double Field::refine(const double* points, int64_t m, const CoarseRule& rule, double* T) const {
  double gate = rule.gate, cost = 1;
  for (int pass = 0; pass <= rule.passes; ++pass) {
    double H[6][6] = {}, b[6] = {}, unexplained = 0, c[3] = {};
    int64_t matched = 0;
    const double eye[3] = {T[3], T[7], T[11]};
    for (int a = 0; a < 3; ++a) c[a] = 0.5 * (low_[a] + low_[a] + (double)size_[a] * cell_);
    for (int64_t k = 0; k < m; ++k) {
      const double* x = points + 3 * k;
      double p[3];
      for (int a = 0; a < 3; ++a) p[a] = T[4 * a] * x[0] + T[4 * a + 1] * x[1] + T[4 * a + 2] * x[2] + T[4 * a + 3];
      Match found;
      if (!match(p, eye, rule.facing, found)) {
        unexplained += 1;
        continue;
      }
      unexplained += std::min(1.0, found.d2 / (rule.beyond * rule.beyond));
      if (pass == rule.passes || found.d2 > gate * gate) continue;  // the last pass gives the cost only
      const float* n = found.sample->n;
      const double r[3] = {p[0] - c[0], p[1] - c[1], p[2] - c[2]};
      const double J[6] = {r[1] * n[2] - r[2] * n[1], r[2] * n[0] - r[0] * n[2], r[0] * n[1] - r[1] * n[0], n[0], n[1], n[2]};
      for (int i = 0; i < 6; ++i) {
        for (int j = 0; j <= i; ++j) H[i][j] += J[i] * J[j];
        b[i] += J[i] * found.e;
      }
      ++matched;
    }
    cost = unexplained / (double)std::max<int64_t>(m, 1);
    if (pass == rule.passes || matched < LEAST_MATCHED) break;
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

}  // namespace avs
