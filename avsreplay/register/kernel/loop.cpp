#include "loop.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "step.hpp"

namespace avs {
namespace {

// The place and the nearest primitive of each point at its last search: the next search begins there, or is not made while
// the nearest primitive cannot have changed. This changes the time, never the result.
class Memory {
 public:
  Memory(const Store& s, int64_t n, bool allowed)
      : extent_(s.extent), grain_(s.grain), longest_(allowed ? MOST_OF_GRAIN * s.grain : 0), kept_((size_t)n, Kept{0, 0, 0, -1.f, -1.f, -1.f, -1, NO_CHILD}) {}

  Kept* data() { return kept_.data(); }
  std::vector<Kept> take() { return std::move(kept_); }

  // The distance beyond the nearest primitive to which others must be known, so that the neighbours remain the nearest during
  // the next steps. The ratio of successive lengths is taken to be that of the last two, between 0.1 and 0.5.
  float lead(double turn, double move) {
    const double length = move + 0.5 * turn * extent_, fall = std::min(std::max(length / last_, 0.1), 0.5);
    const double wanted = STEPS * length * fall / (1 - fall);
    last_ = length;
    return wanted < longest_ ? (float)std::max(wanted, LEAST_OF_GRAIN * grain_) : 0.f;
  }

  void forget_radii() {
    for (Kept& k : kept_) k.radius2 = k.block2 = k.pair2 = -1.f;
  }

 private:
  static constexpr double MOST_OF_GRAIN = 0.2, LEAST_OF_GRAIN = 0.005, STEPS = 4.0;
  double extent_, grain_, longest_, last_ = 0;
  std::vector<Kept> kept_;
};

// Which faces count. Decided anew where the eye has left the margin of the last decision.
class Sides {
 public:
  Sides(const Store& s, const Code& code, bool sided) : s_(s), code_(code), sided_(sided && s.mesh) {
    if (!sided_) code_.face(s_, nullptr, 0, facing_);
  }

  // Returns whether it was decided anew.
  bool look_from(const double* T) {
    if (!sided_) return false;
    const Vec3 eye{T[3], T[7], T[11]}, d{eye.x - facing_.eye.x, eye.y - facing_.eye.y, eye.z - facing_.eye.z};
    const double moved = std::sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
    if (known_ && moved <= facing_.margin) return false;
    code_.face(s_, &eye, known_ ? 2.0 * moved : 0.0, facing_);
    return known_ = true;
  }

  const Facing& facing() const { return facing_; }
  Facing take() { return std::move(facing_); }

 private:
  const Store& s_;
  const Code& code_;
  bool sided_, known_ = false;
  Facing facing_;
};

double worst() { return std::numeric_limits<double>::infinity(); }

// The pose about the model's centre, where the sums live.
void recentre(double* T, const Vec3& by) { T[3] += by.x, T[7] += by.y, T[11] += by.z; }

void apply(const Store& s, const Step& step, double* T) {
  recentre(T, {-s.centre.x, -s.centre.y, -s.centre.z});
  compose(step.D, T);
  recentre(T, s.centre);
}

// Decides between Newton's and Horn's step after the plane passes. A Newton step is kept if the sum of min(d^2, gate^2)
// over the scan falls; otherwise it is undone, Horn's step, which cannot raise the sum, is made in its place, and the next
// Newton steps are limited to a quarter of the one that failed (a trust region). Once that is below `eps_m`, only Horn's
// steps are made.
//
// Where feet pass from one primitive to another, the sum curves less than on each of them, so that a Newton step is a
// fixed share of the way and the next ones have its direction. Broyden's update of the inverse of the derivative, from the
// last step alone, corrects this. Where such a step fails, the Newton step is made in its place.
//
// The sum is not continuous where a face turns away from the camera. A rise that no curvature explains is such a jump, and
// does not count against a step, except the third in an alignment, so that steps cannot lead back and forth for ever.
class Newton {
 public:
  struct Choice {
    Step step;
    bool undo;     // go back to the pose before the last step first
    bool settled;  // the pose is stationary as far as Newton's step can tell
  };

  Choice choose(const Sums& sums, double outside, double gate, double longest, double eps_rad, double eps_m) {
    const Step horn = horn_step(sums);
    const double cost = sums.v[1] + outside * gate * gate;
    const bool comparable = used_ && gate == gate_;
    if (comparable && !(cost < cost_) && !is_jump(cost - cost_)) return instead();
    if (used_) longest_ *= LONGER;
    const bool second = used_;
    used_ = extended_ = false, gate_ = gate, cost_ = cost, horn_ = horn;
    Motion motion;
    const double most = std::min(longest, longest_);
    const bool none = longest_ <= eps_m || !newton_motion(sums, motion) || !to_step(motion, most, plain_);
    if (none || (plain_.turn < eps_rad && plain_.move < eps_m && plain_.length < longest_)) return {horn, false, true};
    Step step = plain_;
    used_ = true, extended_ = extend(motion, second) && to_step(motion, most, step);
    length_ = step.length, slope_ = motion.slope;
    return {step, false, false};
  }

 private:
  static constexpr double SHORTER = 0.25, LONGER = 2.0;
  static constexpr double LEAST_SHARE = 0.35;  // of the way that a Newton step is taken to be
  static constexpr double LEAST_COSINE = 0.7;  // between a Newton step and the last step
  static constexpr double FARTHEST = 2.0;      // an extended step over the last one
  static constexpr double JUMP = 4.0;          // a rise over the slope of the Newton step, with six times its curvature
  static constexpr int MOST_JUMPS = 2;

  bool is_jump(double rise) { return rise > JUMP * slope_ && jumps_++ < MOST_JUMPS; }

  // What is done in place of a step that raised the sum.
  Choice instead() {
    if (extended_) {
      extended_ = false, length_ = plain_.length;
      std::copy(newton_, newton_ + 6, made_);
      return {plain_, true, false};
    }
    used_ = false, longest_ = SHORTER * length_;
    return {horn_, true, false};
  }

  // Broyden's step from the Newton step and the last step, where both have about the same direction; no longer than the last
  // one, or than twice the last one where that had the direction of the step before it. Returns whether it was taken.
  bool extend(Motion& motion, bool second) {
    double now[6], step[6], along = 0, share = 0, made = 0, newton = 0, length = 0;
    for (int i = 0; i < 6; ++i) {
      now[i] = motion.d[i] * (i < 3 ? motion.radius : 1);
      along += made_[i] * now[i], share += made_[i] * (newton_[i] - now[i]);
      made += made_[i] * made_[i], newton += now[i] * now[i];
    }
    const double factor = along / std::max(share, LEAST_SHARE * made);
    for (int i = 0; i < 6; ++i) step[i] = now[i] + factor * (made_[i] - newton_[i] + now[i]), length += step[i] * step[i];
    const double most = FARTHEST * FARTHEST * made, shorter = length > most ? std::sqrt(most / length) : 1;
    const bool same = second && along > LEAST_COSINE * std::sqrt(made * newton) && share < made;
    in_line_ = same ? in_line_ + 1 : 0;
    const bool taken = same && shorter * shorter * length >= newton && (in_line_ > 1 || !(length > made));
    for (double& x : step) x *= shorter;
    std::copy(now, now + 6, newton_);
    std::copy(taken ? step : now, (taken ? step : now) + 6, made_);
    for (int i = 0; i < 6; ++i) motion.d[i] = made_[i] / (i < 3 ? motion.radius : 1);
    return taken;
  }

  double cost_ = 0, gate_ = 0, length_ = 0, slope_ = 0, longest_ = worst();
  double newton_[6] = {}, made_[6] = {};  // the last Newton step and the step made, turns in units of length
  Step horn_{}, plain_{};
  bool used_ = false, extended_ = false;
  int jumps_ = 0;    // rises that did not count
  int in_line_ = 0;  // successive steps with about the direction of the step before
};

// Every n / m-th point of a scan, at a place within its n / m points that follows no pattern of rows and columns.
std::vector<double> part(const View& v, int64_t m) {
  std::vector<double> few((size_t)(3 * m));
  uint32_t state = 1;
  for (int64_t k = 0; k < m; ++k) {
    state = state * 1664525u + 1013904223u;  // Numerical Recipes' generator
    const int64_t first = k * v.n / m, size = (k + 1) * v.n / m - first, i = first + (int64_t)((uint64_t)(state >> 8) * (uint64_t)size >> 24);
    copy_point(v, i, few.data() + 3 * k);
  }
  return few;
}

// The passes over one set of points.
class Passes {
 public:
  Passes(const Store& s, const Code& code, const Rule& rule, Team& team, Sides& sides, Outcome& o)
      : s_(s), code_(code), rule_(rule), team_(team), sides_(sides), o_(o) {}

  // `few`: the points are a part of the scan. Returns whether there were inliers to the end.
  bool run(const View& v, Memory& memory, bool plane, bool few) {
    Newton newton;
    double before[12];
    const int most = few ? rule_.n_max / 2 : rule_.n_max, last_plane = o_.passes + rule_.n_plane;
    while (o_.passes < most && o_.work() < most_work() && !o_.converged) {
      if (sides_.look_from(o_.T)) memory.forget_radii();
      const Pass kind = plane ? Pass::plane : rule_.newton ? Pass::newton : Pass::point;
      const Look look{o_.T, o_.gate, memory.lead(o_.turn, o_.move), kind, rule_.facing, &sides_.facing()};
      const Sums sums = run_pass(s_, code_, v, look, memory.data(), team_);
      o_.moved += v.n;
      if (!note(sums)) return false;
      const double gate = rule_.tighten > 0 ? std::min(o_.gate, std::max(rule_.floor, rule_.tighten * o_.rms)) : o_.gate;
      const bool steady = gate >= 0.99 * o_.gate;
      Step step{};
      if (plane && !plane_step(sums, rule_.gate, step)) return false;
      if (!plane) step = horn_step(sums);
      const bool small = step.turn < rule_.eps_rad && step.move < rule_.eps_m && steady;
      bool settled = !plane;
      if (kind == Pass::newton) {
        const double outside = (double)(v.n - o_.ignored - o_.inliers);
        const Newton::Choice c = newton.choose(sums, outside, o_.gate, rule_.gate, rule_.eps_rad, rule_.eps_m);
        settled = c.settled;
        if (c.undo) std::memcpy(o_.T, before, sizeof before);
        step = c.step;
      }
      o_.turn = step.turn, o_.move = step.move;
      o_.converged = small && settled && !few;
      if (o_.converged) return true;  // at the pose and with the rejection distance of the sums
      std::memcpy(before, o_.T, sizeof before);
      apply(s_, step, o_.T);
      o_.gate = gate;
      if (few && (small || (steady && !plane && within_error(step)))) return true;
      plane = plane && o_.passes < last_plane && !small && !(few && steady && within_error(step));
    }
    return true;
  }

  // Standard error of a mean over the inliers [m].
  double error() const { return o_.rms / std::sqrt((double)o_.inliers); }

 private:
  static constexpr int64_t MIN_INLIERS = 6;
  static constexpr double NEAR = 0.1;  // of the first rejection distance

  bool note(const Sums& sums) {
    ++o_.passes;
    o_.inliers = (int64_t)sums.v[0], o_.ignored = (int64_t)sums.v[2], o_.searched += (int64_t)sums.v[3];
    o_.compared += (int64_t)sums.v[50];
    o_.rms = o_.inliers ? std::sqrt(sums.v[1] / sums.v[0]) : std::numeric_limits<double>::quiet_NaN();
    return o_.inliers >= MIN_INLIERS;
  }

  // Near the surface, as the rejection distance tells, the passes are soon at their end and may take twice the work.
  int64_t most_work() const {
    const bool near = rule_.tighten > 0 && o_.gate < NEAR * rule_.gate;
    return near && rule_.most_work < std::numeric_limits<int64_t>::max() / 2 ? 2 * rule_.most_work : rule_.most_work;
  }

  // Whether a step is below the standard error of a mean over the inliers.
  bool within_error(const Step& step) const {
    return step.move + 0.25 * step.turn * s_.extent < error();
  }

  const Store& s_;
  const Code& code_;
  const Rule& rule_;
  Team& team_;
  Sides& sides_;
  Outcome& o_;
};

// Length of the first step over all points that is expected after the passes over few, in units of the error of a mean.
constexpr double FEW_MOVE = 3.0, FEW_TURN = 12.0;
constexpr int64_t SHARE = 4;  // the few points are at most one in four of a scan
// With a smaller share of the few points near the model some are outliers, which only passes over all points tell from it.
constexpr double LEAST_ROUGH = 0.8;

}  // namespace

void copy_point(const View& v, int64_t k, double* p) {
  for (int a = 0; a < 3; ++a) {
    const char* at = v.data + k * v.row + a * v.column;
    float x;
    v.single ? (void)std::memcpy(&x, at, sizeof x) : (void)std::memcpy(p + a, at, sizeof(double));
    if (v.single) p[a] = (double)x;
  }
}

bool Matches::hold(int64_t n, const Vec3& eye, bool looks) const {
  if ((int64_t)kept.size() != n || looks != sided) return false;
  const Vec3 d{eye.x - facing.eye.x, eye.y - facing.eye.y, eye.z - facing.eye.z};
  return !sided || std::sqrt(d.x * d.x + d.y * d.y + d.z * d.z) <= facing.margin;
}

Sums run_pass(const Store& s, const Code& code, const View& v, const Look& look, Kept* kept, Team& team) {
  const int64_t chunks = (v.n + CHUNK - 1) / CHUNK;
  std::vector<Sums> part((size_t)chunks);
  team.each(chunks, [&](int64_t k) {
    code.pass(s, v, k * CHUNK, std::min(v.n, (k + 1) * CHUNK), look, kept, part[(size_t)k]);
  });
  Sums total{};
  for (const Sums& p : part)
    for (size_t k = 0; k < std::size(total.v); ++k) total.v[k] += p.v[k];
  return total;
}

Outcome icp(const Store& s, const Code& code, const View& v, const double* T, const Rule& rule, Team& team,
            Matches& matches) {
  Sides sides(s, code, rule.facing);
  Outcome o{};
  const auto begin = [&] {
    std::memcpy(o.T, T, sizeof o.T);
    o.gate = rule.gate, o.turn = o.move = worst(), o.rms = std::numeric_limits<double>::quiet_NaN();
  };
  begin();
  Passes passes(s, code, rule, team, sides, o);
  bool plane = rule.n_plane > 0;
  const int64_t size = std::min(rule.few, v.n / SHARE);
  if (rule.few > 0 && 2 * size >= rule.few) {
    const std::vector<double> points = part(v, size);
    const View few{reinterpret_cast<const char*>(points.data()), size, 3 * (int64_t)sizeof(double), sizeof(double), false};
    Memory memory(s, few.n, rule.keep);
    const bool good = passes.run(few, memory, plane, true);
    o.few_passes = o.passes;
    if (good) {
      plane = false;
      const double error = passes.error();
      const bool ended = o.passes < rule.n_max / 2;  // by the error of the part, not by the limit of passes
      if (ended && rule.poor > 0 && o.rms > rule.poor && (double)o.inliers >= LEAST_ROUGH * (double)size) return o;
      o.turn = std::max(o.turn, FEW_TURN * error / s.extent), o.move = std::max(o.move, FEW_MOVE * error);
    } else {
      begin();
    }
  }
  Memory memory(s, v.n, rule.keep);
  passes.run(v, memory, plane, false);
  matches = {memory.take(), sides.take(), o.gate, rule.facing && s.mesh};
  return o;
}

}  // namespace avs
