// Primal-dual interior-point method with Nesterov-Todd scaling and Mehrotra's predictor and corrector.
// The algorithm is conelp of: L. Vandenberghe, "The CVXOPT linear and quadratic cone program solvers", 2010, without the
// self-dual embedding; the linear systems are solved stage by stage (``Stages``).
#include "interior_point.hpp"

#include <algorithm>
#include <cmath>

#include "vector.hpp"

namespace avs {
namespace {

constexpr int MOST = 60;                // iterations
constexpr double GAP = 1e-7;            // duality gap of a solution, relative to its cost
constexpr double ACCEPTED_GAP = 1e-5;   // the same where rounding ends the iterations
constexpr double RESIDUAL = 1e-8;
constexpr double ACCEPTED_RESIDUAL = 1e-6;
constexpr double STEP = 0.99;  // of the way to the boundary

struct Cone {
  size_t first;
  int size;
};

double tail(const double* v, int size) {
  double s = 0;
  for (int i = 1; i < size; ++i) s += v[i] * v[i];
  return s;
}

// v[0]^2 - |v[1:]|^2, without cancellation of squares.
double determinant(const double* v, int size) {
  const double t = std::sqrt(tail(v, size));
  return (v[0] - t) * (v[0] + t);
}

// Scaling of one cone: W = eta (2 v v' - J)^(1/2) with W y = W^-1 s.
struct Scaling {
  double eta;
  double w[4];
};

Scaling scaling(const double* s, const double* y, int size) {
  Scaling out{};
  if (size == 1) {
    out.eta = std::sqrt(s[0] / y[0]);
    out.w[0] = 1;
    return out;
  }
  const double ds = std::sqrt(determinant(s, size)), dy = std::sqrt(determinant(y, size));
  double product = 0;
  for (int i = 0; i < size; ++i) product += s[i] / ds * (y[i] / dy);
  const double gamma = std::sqrt(0.5 * (1 + product));
  for (int i = 0; i < size; ++i) out.w[i] = (s[i] / ds + (i ? -1 : 1) * (y[i] / dy)) / (2 * gamma);
  out.w[0] = std::sqrt(1 + tail(out.w, size));
  out.eta = std::sqrt(ds / dy);
  return out;
}

// out := W v, or W^-1 v for sign = -1.
void scale(const Scaling& at, int size, double sign, const double* v, double* out) {
  const double factor = sign > 0 ? at.eta : 1 / at.eta;
  if (size == 1) {
    out[0] = factor * v[0];
    return;
  }
  double along = 0;
  for (int i = 1; i < size; ++i) along += at.w[i] * v[i];
  const double v0 = v[0], share = sign * v0 + along / (1 + at.w[0]);
  out[0] = factor * (at.w[0] * v0 + sign * along);
  for (int i = 1; i < size; ++i) out[i] = factor * (v[i] + at.w[i] * share);
}

// out := a o b.
void product(const double* a, const double* b, int size, double* out) {
  double first = a[0] * b[0];
  for (int i = 1; i < size; ++i) first += a[i] * b[i];
  for (int i = size - 1; i > 0; --i) out[i] = a[0] * b[i] + b[0] * a[i];
  out[0] = first;
}

// out := the solution x of l o x = b.
void divide(const double* l, const double* b, int size, double* out) {
  if (size == 1) {
    out[0] = b[0] / l[0];
    return;
  }
  double along = 0;
  for (int i = 1; i < size; ++i) along += l[i] * b[i];
  const double first = (l[0] * b[0] - along) / determinant(l, size);
  for (int i = size - 1; i > 0; --i) out[i] = (b[i] - first * l[i]) / l[0];
  out[0] = first;
}

// The largest step along dv from v, which is inside the cone.
double reach(const double* v, const double* dv, int size) {
  const double far = 1e9;
  if (size == 1) return dv[0] < 0 ? -v[0] / dv[0] : far;
  const double a = dv[0] * dv[0] - tail(dv, size), c = determinant(v, size);
  double b = v[0] * dv[0];
  for (int i = 1; i < size; ++i) b -= v[i] * dv[i];
  const double root = b * b - a * c;
  double out = far;
  if (dv[0] < 0) out = -v[0] / dv[0];
  if (root >= 0) {
    const double q = -(b + std::copysign(std::sqrt(root), b));
    for (const double t : {a != 0 ? q / a : far, q != 0 ? c / q : far})
      if (t > 0) out = std::min(out, t);
  }
  return out;
}

class Method {
 public:
  Method(const Rows& rows, const std::vector<int>& cones, const std::array<double, 2>& cost)
      : rows_(rows), cost_(cost), stages_(rows.n), x_(rows.n), dx_(rows.n), g_(rows.n), rw_(rows.n) {
    size_t first = 0;
    for (int size : cones) {
      cones_.push_back({first, size});
      first += size;
    }
    scaling_.resize(cones.size());
    for (Vector* v : {&s_, &y_, &ds_, &dy_, &rz_, &l_, &e_, &t_, &u_}) v->assign(first, 0);
    for (Entry& e : x_.at) e.fill(0);
    for (Entry& e : dx_.at) e.fill(0);
  }

  Answer run() {
    Answer out;
    if (!begin()) return out;
    for (int k = 0; k < MOST; ++k) {
      out.iterations = k;
      const double gap = dot(s_, y_), h = x_.at[0][6], slack = x_.at[0][7];
      const double size = std::max(1.0, std::fabs(cost_[0] * h + cost_[1] * slack));
      const double worst = std::max(primal(), dual());
      if (!std::isfinite(gap + worst)) break;
      const bool good = gap <= ACCEPTED_GAP * size && worst <= ACCEPTED_RESIDUAL;
      if (good) keep(out);
      if (gap <= GAP * size && worst <= RESIDUAL) break;
      if (!advance(gap)) break;
    }
    return out;
  }

 private:
  void keep(Answer& out) const {
    out.solved = true;
    out.h = x_.at[0][6];
    out.slack = x_.at[0][7];
    out.w.resize(rows_.n);
    for (size_t k = 0; k < rows_.n; ++k)
      for (int i = 0; i < 3; ++i) out.w[k][i] = x_.at[k][STATE + i];
  }

  // rz := s - C x - d; returns its norm relative to that of d.
  double primal() {
    apply(rows_, x_, rz_);
    for (size_t i = 0; i < rz_.size(); ++i) rz_[i] = s_[i] - rz_[i] - rows_.d[i];
    return norm(rz_) / std::max(1.0, norm(rows_.d));
  }

  // Norm of c - C' y relative to that of c.
  double dual() {
    gather(rows_, y_, g_);
    std::array<double, 2> common;
    reduced(rows_, g_, rw_, common);
    double s = 0;
    for (const auto& w : rw_) s += w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    for (int i = 0; i < 2; ++i) s += (cost_[i] - common[i]) * (cost_[i] - common[i]);
    return std::sqrt(s / std::max(1.0, cost_[0] * cost_[0] + cost_[1] * cost_[1]));
  }

  // Blocks of C' W^-2 C, and their factors.
  bool assemble() {
    for (auto& block : stages_.blocks())
      for (Entry& e : block) e.fill(0);
    for (size_t c = 0; c < cones_.size(); ++c) {
      const Cone cone = cones_[c];
      const Scaling& at = scaling_[c];
      const double weight = 1 / (at.eta * at.eta);
      const Entry* C = &rows_.C[cone.first];
      auto& block = stages_.blocks()[rows_.stage[cone.first]];
      if (cone.size == 1) {
        add(block, C[0], weight);
        continue;
      }
      Entry u;
      for (int j = 0; j < WIDTH; ++j) {
        u[j] = at.w[0] * C[0][j];
        for (int i = 1; i < cone.size; ++i) u[j] -= at.w[i] * C[i][j];
      }
      add(block, u, 2 * weight);
      add(block, C[0], -weight);
      for (int i = 1; i < cone.size; ++i) add(block, C[i], weight);
    }
    return stages_.factor(rows_);
  }

  static void add(Stages::Block& block, const Entry& v, double weight) {
    for (int i = 0; i < WIDTH; ++i) {
      if (v[i] == 0) continue;
      const double f = weight * v[i];
      for (int j = 0; j <= i; ++j) block[i][j] += f * v[j];
    }
  }

  // A point inside all cones: v + (1 + its distance to them) e, where it is not inside already.
  void push(Vector& v) const {
    double most = -1e300;
    for (const Cone& c : cones_) most = std::max(most, std::sqrt(tail(&v[c.first], c.size)) - v[c.first]);
    if (most < -1e-8 * std::max(1.0, norm(v))) return;
    for (const Cone& c : cones_) v[c.first] += 1 + most;
  }

  bool begin() {
    for (Scaling& at : scaling_) at = {1, {1, 0, 0, 0}};
    if (!assemble()) return false;
    for (size_t i = 0; i < t_.size(); ++i) t_[i] = -rows_.d[i];
    gather(rows_, t_, g_);
    stages_.solve(rows_, g_, {0, 0}, x_);
    apply(rows_, x_, s_);
    for (size_t i = 0; i < s_.size(); ++i) s_[i] += rows_.d[i];
    for (Entry& e : g_) e.fill(0);
    stages_.solve(rows_, g_, cost_, dx_);
    apply(rows_, dx_, y_);
    push(s_);
    push(y_);
    return true;
  }

  // Direction for the scaled complementarity e and the fraction ``keep`` of the residuals.
  void direction(double keep) {
    for (size_t c = 0; c < cones_.size(); ++c) {
      const size_t i = cones_[c].first;
      double r[4];
      scale(scaling_[c], cones_[c].size, -1, &rz_[i], r);
      for (int j = 0; j < cones_[c].size; ++j) r[j] = e_[i + j] + keep * r[j];
      scale(scaling_[c], cones_[c].size, -1, r, &t_[i]);
      for (int j = 0; j < cones_[c].size; ++j) t_[i + j] += keep * y_[i + j];
    }
    gather(rows_, t_, g_);
    stages_.solve(rows_, g_, {-keep * cost_[0], -keep * cost_[1]}, dx_);
    apply(rows_, dx_, ds_);
    for (size_t c = 0; c < cones_.size(); ++c) {
      const size_t i = cones_[c].first;
      const int size = cones_[c].size;
      for (int j = 0; j < size; ++j) ds_[i + j] -= keep * rz_[i + j];
      scale(scaling_[c], size, -1, &ds_[i], &u_[i]);  // W^-1 ds
      for (int j = 0; j < size; ++j) t_[i + j] = e_[i + j] - u_[i + j];  // W dy
      scale(scaling_[c], size, -1, &t_[i], &dy_[i]);
    }
  }

  double step(const Vector& v, const Vector& dv) const {
    double out = 1 / STEP;
    for (const Cone& c : cones_) out = std::min(out, reach(&v[c.first], &dv[c.first], c.size));
    return STEP * out;
  }

  bool advance(double gap) {
    for (size_t c = 0; c < cones_.size(); ++c) {
      const size_t i = cones_[c].first;
      scaling_[c] = scaling(&s_[i], &y_[i], cones_[c].size);
      scale(scaling_[c], cones_[c].size, 1, &y_[i], &l_[i]);
      for (int j = 0; j < cones_[c].size; ++j) e_[i + j] = -l_[i + j];
    }
    if (!assemble()) return false;
    direction(1);
    const double affine = std::min(step(s_, ds_), step(y_, dy_));
    const double mu = gap / cones_.size(), left = 1 - affine, sigma = left * left * left;
    for (size_t c = 0; c < cones_.size(); ++c) {
      const size_t i = cones_[c].first;
      double a[4], b[4];
      product(&u_[i], &t_[i], cones_[c].size, a);
      product(&l_[i], &l_[i], cones_[c].size, b);
      for (int j = 0; j < cones_[c].size; ++j) a[j] = -a[j] - b[j];
      a[0] += sigma * mu;
      divide(&l_[i], a, cones_[c].size, &e_[i]);
    }
    direction(1 - sigma);
    const double forward = step(s_, ds_), dually = step(y_, dy_);
    if (!(forward > 1e-10 && dually > 1e-10)) return false;
    for (size_t k = 0; k < rows_.n; ++k)
      for (int j = 0; j < WIDTH; ++j) x_.at[k][j] += forward * dx_.at[k][j];
    for (size_t i = 0; i < s_.size(); ++i) {
      s_[i] += forward * ds_[i];
      y_[i] += dually * dy_[i];
    }
    return true;
  }

  const Rows& rows_;
  std::array<double, 2> cost_;
  Stages stages_;
  Motion x_, dx_;
  std::vector<Entry> g_;
  std::vector<std::array<double, 3>> rw_;
  std::vector<Cone> cones_;
  std::vector<Scaling> scaling_;
  Vector s_, y_, ds_, dy_, rz_, l_, e_, t_, u_;
};

}  // namespace

Answer minimise(const Rows& rows, const std::vector<int>& cones, const std::array<double, 2>& cost) {
  return Method(rows, cones, cost).run();
}

}  // namespace avs
