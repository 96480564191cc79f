#include "constraints.hpp"

#include <algorithm>
#include <cmath>

namespace avs {
namespace {

Vector3 divided(const Vector3& a, double by) { return {a[0] / by, a[1] / by, a[2] / by}; }

class Maker {
 public:
  Maker(const ReferencePoints& at, const ConstraintFrame& frame, const ConstraintLimits& limits, PointRows& planes,
        PointRows& cones)
      : at_(at), frame_(frame), limits_(limits), planes_(planes), cones_(cones) {}

  void run() {
    for (int i = 0; i < 2; ++i)
      if (!std::isnan(limits_.tangent[i])) cone_or_outside(i);
    if (!std::isnan(limits_.keepout)) sphere();
    if (!std::isnan(limits_.clearance)) body();
    workspace();
  }

 private:
  // Whether a constraint is near at a point where the first (inside) or the second alternative is required. The last
  // point is the grasp point, which is the end condition.
  bool on(size_t k, int i, bool inside) const {
    if (k + 1 == at_.count || (at_.inside[ALTERNATIVES * k + i] != 0) != inside) return false;
    return (inside ? at_.first : at_.second)[k][i] < limits_.far;
  }

  void cone_or_outside(int i) {
    for (size_t k = 0; k < at_.count; ++k)
      if (on(k, i, true)) cone(k, limits_.tangent[i], at_.off[k][i]);
    const double length = limits_.range[i];
    for (size_t k = 0; k < at_.count; ++k)
      if (on(k, i, false)) fixed(planes_, k, {outward(k, length)}, -length - at_.off[k][i]);
  }

  void sphere() {
    for (size_t k = 0; k < at_.count; ++k)
      if (on(k, 2, true)) ball(k, limits_.release - at_.off[k][2]);
    for (size_t k = 0; k < at_.count; ++k) {
      if (!on(k, 2, false)) continue;
      const Vector3 out = (at_.y[k] - frame_.centre), normal = divided(out, std::max(norm(out), 1e-9));
      fixed(planes_, k, {normal}, -dot(normal, frame_.centre) - limits_.keepout - at_.off[k][2]);
    }
  }

  // The clearance to the surface, or the corridor with its range where the reference is inside it.
  void body() {
    for (size_t k = 0; k < at_.count; ++k)
      if (on(k, 3, true)) cone(k, limits_.tangent[1], at_.off[k][3]);
    for (size_t k = 0; k < at_.count; ++k)
      if (on(k, 3, true)) ball(k, limits_.range[1] - at_.off[k][3]);
    for (size_t k = 0; k < at_.count; ++k) {
      if (!on(k, 3, false)) continue;
      const double gap = std::fabs(at_.distance[k]) > 1e-9 ? at_.distance[k] : 1e-9;
      const Vector3 normal = divided((at_.y[k] - at_.foot[k]), gap);
      fixed(planes_, k, {normal}, -dot(normal, at_.foot[k]) - at_.clearance[k] - at_.off[k][3]);
    }
  }

  // The shell around the robot's base, which is fixed in {A}.
  void workspace() {
    for (size_t k = 0; k + 1 < at_.count && !std::isnan(limits_.reach_max); ++k) {
      const double constant = limits_.reach_max - at_.off[k][4];
      for (int i = 0; i < 4; ++i) {
        Vector3 vector{};
        if (i > 0) vector[i - 1] = 1;
        put(cones_, k, vector, -dot(vector, frame_.base) + (i == 0 ? constant : 0), 0, i == 0);
      }
      cones_.sizes.push_back(4);
    }
    for (size_t k = 0; k + 1 < at_.count && !std::isnan(limits_.reach_min); ++k) {
      const Vector3 out = (at_.r[k] - frame_.base), normal = divided(out, std::max(norm(out), 1e-9));
      put(planes_, k, normal, -dot(normal, frame_.base) - limits_.reach_min - at_.off[k][4], 0, true);
      planes_.sizes.push_back(1);
    }
  }

  // Unit vector in {C} along which a point has to be at least ``length`` away: towards the reference, and towards the
  // entry of the cone where the reference is too near.
  Vector3 outward(size_t k, double length) const {
    const Vector3& y = at_.y[k];
    const double distance = std::max(norm(y), 1e-9);
    const double missing = std::sqrt(std::max(1 - distance / std::max(length, 1e-9), 0.0));
    Vector3 out;
    for (int i = 0; i < 3; ++i) out[i] = y[i] / distance + limits_.toward_axis * missing * frame_.axis[i];
    return divided(out, std::max(norm(out), 1e-9));
  }

  // |across| <= tangent along + mouth - off
  void cone(size_t k, double tangent, double off) {
    const Vector3& e = frame_.axis;
    fixed(cones_, k, {{tangent * e[0], tangent * e[1], tangent * e[2]}, frame_.side, frame_.cross}, limits_.mouth - off);
  }

  // |y| <= radius
  void ball(size_t k, double radius) { fixed(cones_, k, {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, radius); }

  // A group of rows vector.y of coordinates in {C}; the first one has the constant and the slack.
  void fixed(PointRows& rows, size_t k, std::initializer_list<Vector3> vectors, double constant) {
    bool first = true;
    for (const Vector3& v : vectors) {
      const Matrix3& R = at_.R[k];
      const Vector3 in_a = {dot(v, R[0]), dot(v, R[1]), dot(v, R[2])};
      put(rows, k, in_a, -dot(in_a, at_.rho[k]) + (first ? constant : 0), dot(v, at_.dy[k]), first);
      first = false;
    }
    rows.sizes.push_back(static_cast<int64_t>(vectors.size()));
  }

  static void put(PointRows& rows, size_t k, const Vector3& vector, double offset, double rate, bool slack) {
    rows.interval.push_back(static_cast<int64_t>(k / 2));
    rows.fraction.push_back(k % 2 == 0 ? 0.5 : 1.0);
    rows.vector.insert(rows.vector.end(), vector.begin(), vector.end());
    rows.offset.push_back(offset);
    rows.rate.push_back(rate);
    rows.slack.push_back(slack ? 1.0 : 0.0);
  }

  const ReferencePoints& at_;
  const ConstraintFrame& frame_;
  const ConstraintLimits& limits_;
  PointRows &planes_, &cones_;
};

}  // namespace

void constraint_rows(const ReferencePoints& at, const ConstraintFrame& frame, const ConstraintLimits& limits,
                     PointRows& planes, PointRows& cones) {
  Maker(at, frame, limits, planes, cones).run();
}

// de Boor, "A Practical Guide to Splines", 1978, chapter IV: a tridiagonal system for the slopes at the nodes. Each
// pivot is positive, so it is eliminated without exchanges.
void spline(const double* x, const double* y, size_t n, size_t width, double* c) {
  const size_t stride = (n - 1) * width;
  double *c3 = c, *c2 = c + stride, *s = c + 2 * stride, *c0 = c + 3 * stride;  // slopes in place of the linear term
  std::vector<double> upper(n), last(width);
  const auto step = [x](size_t i) { return x[i + 1] - x[i]; };
  for (size_t i = 0; i + 1 < n; ++i)  // mean slopes in place of the cubic term
    for (size_t j = 0; j < width; ++j) c3[i * width + j] = (y[(i + 1) * width + j] - y[i * width + j]) / step(i);
  const auto rise = [&](size_t i, size_t j) { return c3[i * width + j]; };
  const double first = step(0) + step(1);
  upper[0] = first / step(1);
  for (size_t j = 0; j < width; ++j)
    s[j] = ((step(0) + 2 * first) * step(1) * rise(0, j) + step(0) * step(0) * rise(1, j)) / first / step(1);
  for (size_t i = 1; i + 1 < n; ++i) {
    const double a = step(i - 1), b = step(i), pivot = 2 * (a + b) - b * upper[i - 1];
    upper[i] = a / pivot;
    for (size_t j = 0; j < width; ++j)
      s[i * width + j] = (3 * (b * rise(i - 1, j) + a * rise(i, j)) - b * s[(i - 1) * width + j]) / pivot;
  }
  const double a = step(n - 3), b = step(n - 2), both = a + b, pivot = a - both * upper[n - 2];
  for (size_t j = 0; j < width; ++j) {
    const double right = (b * b * rise(n - 3, j) + (2 * both + b) * a * rise(n - 2, j)) / both;
    last[j] = (right - both * s[(n - 2) * width + j]) / pivot;
  }
  for (size_t i = n - 1; i-- > 0;) {
    const double h = step(i);
    for (size_t j = 0; j < width; ++j) {
      const size_t at = i * width + j;
      s[at] -= upper[i] * last[j];
      const double slope = rise(i, j), bend = (s[at] + last[j] - 2 * slope) / h;
      c3[at] = bend / h;
      c2[at] = (slope - s[at]) / h - bend;
      c0[at] = y[at];
      last[j] = s[at];
    }
  }
}

void piecewise(const double* c, const double* x, size_t n, size_t width, const double* times, size_t m, int order,
               size_t split, double* a, double* b) {
  const size_t stride = n * width;
  for (size_t i = 0; i < m; ++i) {
    const double t = times[i], guess = (t - x[0]) / (x[n] - x[0]) * static_cast<double>(n);
    size_t k = guess > 0 ? std::min(static_cast<size_t>(guess), n - 1) : 0;
    while (k > 0 && t < x[k]) --k;
    while (k + 1 < n && t >= x[k + 1]) ++k;
    const double s = t - x[k], s2 = s * s;
    const double *c3 = c + k * width, *c2 = c3 + stride, *c1 = c2 + stride, *c0 = c1 + stride;
    double *to_a = a + i * split, *to_b = b + i * (width - split);
    for (size_t j = 0; j < width; ++j) {
      const double value = order == 0 ? c0[j] + c1[j] * s + c2[j] * s2 + c3[j] * (s2 * s)
                                      : c1[j] + c2[j] * s * 2 + c3[j] * s2 * 3;
      (j < split ? to_a[j] : to_b[j - split]) = value;
    }
  }
}

}  // namespace avs
