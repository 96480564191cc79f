#include "noise.hpp"

#include <algorithm>
#include <cmath>

namespace avs {
namespace {

constexpr size_t LEAST_SAMPLES = 30;
constexpr double LEAST_COSINE = 0.2;         // of incidence, where the noise along the ray is measured
constexpr double CLEAR = 3.0;                // standard deviations by which noise moves a point
constexpr double LEAST_OF_GATE = 1e-6;       // smaller noise is that of an exact scan
constexpr size_t CAST = 300;                 // rays that are cast to measure the noise, about
constexpr double MOST_NOISE = 0.05;          // of the extent: a point farther from where its ray meets the model is not noise
constexpr size_t PILOT = 5;                  // one of so many samples decides whether there is a bias
constexpr double LEAST_BIAS = 3.0, BY_CHANCE = 1.6;  // chi-square of a bias that is worth while; most of one by chance, over its mean
constexpr double LEAST_SPREAD = 3000.0;      // of the contributions of all points, with which a bias is likely whatever the part shows
constexpr double SECOND_ROUND = 0.3;         // square of its chi-square over the points: change by a second round, about

void cross(const double* a, const double* b, double* out) {
  out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}

double squared(const double (&x)[6]) {
  double sum = 0;
  for (const double value : x) sum += value * value;
  return sum;
}

double trace(const Six& A) {
  double sum = 0;
  for (int i = 0; i < 6; ++i) sum += A.v[i][i];
  return sum;
}

// A place of the model without noise, the direction of the noise, and its size.
struct Place {
  double on[3], n[3], u[3], range, noise;
  int32_t lane;
  bool near_edge;
};

// A rigid motion p -> R p + t.
struct Motion3 {
  double R[3][3], t[3];

  // Exp(-d); the series are exact for what a bias can be.
  static Motion3 undoing(const double* d) {
    const double k[3] = {-d[0], -d[1], -d[2]}, a2 = dot(k, k);
    const double a = 1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42)), b = 0.5 * (1 - a2 / 12 * (1 - a2 / 30 * (1 - a2 / 56)));
    Motion3 m;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) m.R[i][j] = b * (k[i] * k[j] - (i == j ? a2 : 0)) + (i == j ? 1 : 0);
    m.R[0][1] -= a * k[2], m.R[0][2] += a * k[1], m.R[1][0] += a * k[2], m.R[1][2] -= a * k[0], m.R[2][0] -= a * k[1], m.R[2][1] += a * k[0];
    for (int i = 0; i < 3; ++i) m.t[i] = -(m.R[i][0] * d[3] + m.R[i][1] * d[4] + m.R[i][2] * d[5]);
    return m;
  }
  void apply(const double* p, double* out) const {
    for (int i = 0; i < 3; ++i) out[i] = R[i][0] * p[0] + R[i][1] * p[1] + R[i][2] * p[2] + t[i];
  }
  void back(const double* p, double* out) const {
    for (int i = 0; i < 3; ++i) out[i] = R[0][i] * (p[0] - t[0]) + R[1][i] * (p[1] - t[1]) + R[2][i] * (p[2] - t[2]);
  }
};

class Simulation {
 public:
  Simulation(const Store& s, const Code& code, const Look& look, double side, const Numbers& cubes)
      : s_(s), code_(code), look_(look), eye_{look.T[3], look.T[7], look.T[11]}, per_m_(1 / side), cubes_(cubes) {}

  // Standard deviation of the noise; 0 where it is not known, or that of an exact scan. `cast`: from where rays meet the model,
  // which the noise does not change; otherwise from the planes of the closest faces.
  double sigma(const std::vector<Sample>& samples, bool cast) {
    std::vector<double> off;
    const size_t stride = cast ? std::max<size_t>(1, samples.size() / CAST) : 1;
    const double most = MOST_NOISE * s_.extent;
    for (size_t k = 0; k < samples.size(); k += stride) {
      Place q;
      const double c = look_at(samples[k].match, q);
      if (!cast || !look_.sided) {
        if (std::fabs(c) > LEAST_COSINE) off.push_back(std::fabs(q.noise));
        continue;
      }
      const Hit hit = code_.first_face(s_, {eye_[0], eye_[1], eye_[2]}, q.u, q.range - most, q.range + most);
      if (hit.lane >= 0) off.push_back(std::fabs(q.range - hit.range));
    }
    if (off.size() < LEAST_SAMPLES) return 0;
    const auto middle = off.begin() + (int64_t)(off.size() / 2);
    std::nth_element(off.begin(), middle, off.end());
    sigma_ = SIGMA_PER_MEDIAN * *middle;
    return sigma_ > LEAST_OF_GATE * look_.gate ? sigma_ : 0;
  }

  // Takes one sample in so many, from a first one on: where it would be without noise, and its noise.
  void take(const std::vector<Sample>& samples, size_t first, size_t stride, const std::vector<double>& numbers) {
    places_.clear();
    for (size_t k = first; k < samples.size(); k += stride) {
      const Match& m = samples[k].match;
      Place q;
      look_at(m, q);
      double off = q.noise;
      q.lane = samples[k].at.lane;
      for (int a = 0; a < 3; ++a) q.n[a] = m.n[a], q.on[a] = m.p[a] - off * q.u[a];
      q.near_edge = !(look_.sided && is_clear(s_, q.lane, q.on, CLEAR * sigma_));
      if (q.near_edge && look_.sided) {
        const Hit hit = code_.first_face(s_, {eye_[0], eye_[1], eye_[2]}, q.u, q.range - CREDIBLE * sigma_, q.range + CREDIBLE * sigma_);
        if (hit.lane < 0) continue;
        const Vec3 n = s_.triangles[(size_t)hit.lane].n();
        q.n[0] = n.x, q.n[1] = n.y, q.n[2] = n.z, off = q.range - hit.range, q.lane = hit.lane;
        for (int a = 0; a < 3; ++a) q.on[a] = m.p[a] - off * q.u[a];
      }
      if (!(std::fabs(off) < CREDIBLE * sigma_)) continue;
      q.noise = sigma_ * numbers[k % numbers.size()];
      places_.push_back(q);
    }
  }

  // The gradient (6,) of a scan with noise that is measured where `truth` moves the model from the pose of the scan. `chance`: the
  // sum of its squares over the places; `patches`: what is added to them; or null.
  void gradient(const Motion3* truth, double (&out)[6], Six* chance, std::vector<std::array<double, 7>>* patches) {
    points_.clear(), begin_.clear();
    for (const Place& q : places_) {
      double on[3], moment[3];
      const double* u = q.u;
      std::copy(q.on, q.on + 3, on);
      if (truth && !moved(*truth, q, on)) continue;
      if (q.near_edge) {
        for (const double sign : {1.0, -1.0}) {
          for (int a = 0; a < 3; ++a) points_.push_back(on[a] + sign * q.noise * u[a] - eye_[a]);
          begin_.push_back({0, 0, 0, -1.f, -1.f, -1.f, q.lane, NO_CHILD});
        }
        continue;
      }
      const double e = q.n[0] * (on[0] - q.on[0]) + q.n[1] * (on[1] - q.on[1]) + q.n[2] * (on[2] - q.on[2]);
      cross(on, q.n, moment);
      for (int a = 0; a < 3; ++a) out[a] -= 2 * e * moment[a], out[3 + a] -= 2 * e * q.n[a];
      cross(u, q.n, moment);
      const double lever = 2 * q.noise * q.noise * dot(u, q.n);
      for (int a = 0; a < 3; ++a) out[a] -= lever * moment[a];
    }
    const double at[12] = {1, 0, 0, eye_[0], 0, 1, 0, eye_[1], 0, 0, 1, eye_[2]};
    const Look look{at, look_.gate, 0.f, Pass::plane, look_.sided, look_.facing};
    const int64_t n = (int64_t)points_.size() / 3;
    double pair[6] = {};
    for (int64_t first = 0; first < n; first += CHUNK) {
      const View part{reinterpret_cast<const char*>(points_.data() + 3 * first), std::min<int64_t>(CHUNK, n - first), 3 * (int64_t)sizeof(double), sizeof(double), false};
      Match found[CHUNK];
      Footing feet[CHUNK];
      uint16_t off[CHUNK];
      const int many = code_.match(s_, part, 0, part.n, look, begin_.data() + first, found, off, feet);
      for (int64_t i = 0, in = 0, out_of = 0; i < part.n; ++i) {
        if (out_of < part.n - many && off[out_of] == i)
          ++out_of;
        else
          force(found[in], feet[in], pair, patches), ++in;
        if (i % 2 == 0) continue;
        for (int a = 0; a < 6; ++a) {
          out[a] += pair[a];
          for (int b = 0; chance && b < 6; ++b) chance->v[a][b] += pair[a] * pair[b];
        }
        std::fill(pair, pair + 6, 0.0);
      }
    }
  }

 private:
  // The direction of the noise, and the noise of a sample along it; returns the cosine of incidence.
  double look_at(const Match& m, Place& q) const {
    for (int a = 0; a < 3; ++a) q.u[a] = look_.sided ? m.p[a] - eye_[a] : m.n[a];
    q.range = std::sqrt(dot(q.u, q.u));
    for (double& x : q.u) x /= q.range;
    const double c = dot(q.u, m.n);
    q.noise = m.e / c;
    return c;
  }

  // The place at the true pose, seen from the pose of the scan, where it is on the same ray; false where the ray is along the face.
  bool moved(const Motion3& truth, const Place& q, double (&on)[3]) const {
    double eye[3], to[3];
    truth.apply(q.on, to);
    if (look_.sided) {
      truth.apply(eye_, eye);
      double d[3] = {to[0] - eye[0], to[1] - eye[1], to[2] - eye[2]}, from[3] = {q.on[0] - eye[0], q.on[1] - eye[1], q.on[2] - eye[2]};
      const double slope = dot(q.n, d), along = dot(q.n, from) / slope;
      if (!(std::fabs(slope) > 0 && std::isfinite(along))) return false;
      for (int a = 0; a < 3; ++a) to[a] = eye[a] + along * d[a];
    } else {
      const double e = q.n[0] * (to[0] - q.on[0]) + q.n[1] * (to[1] - q.on[1]) + q.n[2] * (to[2] - q.on[2]);
      for (int a = 0; a < 3; ++a) to[a] -= e * q.n[a];
    }
    truth.back(to, on);
    return true;
  }

  // Adds the gradient of one point.
  void force(Match& m, const Footing& at, double (&out)[6], std::vector<std::array<double, 7>>* patches) const {
    const double F[3] = {at.foot[0] - m.p[0], at.foot[1] - m.p[1], at.foot[2] - m.p[2]};
    double moment[3];
    cross(m.p, F, moment);
    for (int a = 0; a < 3; ++a) out[a] += moment[a], out[3 + a] += F[a];
    if (patches) add(m, *patches);
  }

  void add(Match& m, std::vector<std::array<double, 7>>& patches) const {
    onto_face(m);
    const uint32_t k = cubes_.find(cube_of(m.p, per_m_));
    if (k == Numbers::NONE) return;
    double moment[3];
    cross(m.p, m.n, moment);
    std::array<double, 7>& to = patches[k];
    for (int a = 0; a < 3; ++a) to[(size_t)a] += m.e * moment[a], to[(size_t)(3 + a)] += m.e * m.n[a];
    to[6] += m.e;
  }

  const Store& s_;
  const Code& code_;
  const Look look_;
  const double eye_[3], per_m_;
  const Numbers& cubes_;
  std::vector<Place> places_;
  std::vector<double> points_;
  std::vector<Kept> begin_;  // the faces with which their searches begin
  double sigma_ = 0;
};

}  // namespace

NoiseEffect noise_effect(const Store& s, const Code& code, const Look& look, const Evidence& e, double side, const Inverted& all,
                         double noise, const NoiseRule& rule) {
  NoiseEffect out;
  if (e.samples.size() < LEAST_SAMPLES || rule.numbers.empty()) return out;
  const bool quiet = noise < rule.quiet;
  Simulation scan(s, code, look, side, e.cubes);
  if (!(scan.sigma(e.samples, !quiet) > 0)) return out;
  // W' g and W' C W, with g the gradient, C its covariance by chance and W W' the inverse of the information.
  double step[6] = {}, weight = 0;  // weight: of a point of one sign
  Six chance = {};
  std::vector<std::array<double, 7>>* patches = nullptr;
  const auto simulate = [&](const Motion3* truth) {
    double gradient[6] = {};
    Six squares = {}, half = {};
    scan.gradient(truth, gradient, &squares, patches);
    std::fill(step, step + 6, 0.0), chance = {};
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) {
        step[i] += weight * all.root.v[k][i] * gradient[k];
        for (int j = 0; j < 6; ++j) half.v[i][j] += weight * weight * all.root.v[k][i] * squares.v[k][j];
      }
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k)
        for (int j = 0; j < 6; ++j) chance.v[i][j] += half.v[i][k] * all.root.v[k][j];
  };
  const auto prepare = [&](size_t first, size_t stride) {
    weight = 0.5 * (double)e.inliers / (double)((e.samples.size() - first + stride - 1) / stride);
    scan.take(e.samples, first, stride, rule.numbers);
  };
  const double unit = 1 / (noise * noise);
  const size_t every = quiet ? std::max<size_t>(1, (size_t)(rule.small * (int64_t)e.samples.size() / e.inliers)) : 1;
  if (quiet) {
    prepare(every * PILOT / 2, every * PILOT);
    simulate(nullptr);
    const double by_chance = unit * trace(chance), spread = by_chance * 0.5 * (double)e.inliers / weight;
    if (unit * squared(step) <= BY_CHANCE * by_chance + LEAST_BIAS && spread <= LEAST_SPREAD) return out;
  }
  out.patches.resize(e.patches.size());
  patches = &out.patches;
  prepare(0, every);
  simulate(nullptr);
  patches = nullptr;
  const double x = unit * squared(step);
  Six V, squares = chance;
  double all_steps[6];
  std::copy(step, step + 6, all_steps);
  if (quiet ? x * x > SECOND_ROUND * (double)e.inliers : x > LEAST_BIAS) {
    double d[6] = {};
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) d[i] += all.root.v[i][k] * step[k];
    const Motion3 truth = Motion3::undoing(d);
    simulate(&truth);
    for (int i = 0; i < 6; ++i) all_steps[i] += step[i];
  }
  eigen(squares.v, V.v, 6, 1e-32);
  double certain = 0, whole = 0;
  for (int k = 0; k < 6; ++k) {
    double along = 0, direction[6] = {};
    for (int i = 0; i < 6; ++i) along += V.v[i][k] * all_steps[i];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) direction[i] += all.root.v[i][j] * V.v[j][k];
    const double square = along * along, variance = std::max(squares.v[k][k], 0.0);
    const double share = square > variance ? 1 - variance / square : 0;
    certain += share * square, whole += square;
    for (int i = 0; i < 6; ++i) {
      out.bias[i] += share * along * direction[i], out.left[i] += (1 - share) * along * direction[i];
      for (int j = 0; j < 6 && !quiet; ++j) out.chance.v[i][j] += variance * direction[i] * direction[j];
    }
  }
  for (std::array<double, 7>& patch : out.patches)
    for (double& value : patch) value *= weight * (whole > 0 ? certain / whole : 0);
  return out;
}

}  // namespace avs
