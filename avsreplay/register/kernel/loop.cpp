#include "loop.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "step.hpp"

namespace avs {
namespace {

constexpr int64_t MIN_INLIERS = 6;

// Where each point was and what was nearest to it: where its next search begins, or, while it provably cannot have
// changed, its neighbour. This shows in the time, never in the result.
class Memory {
 public:
  Memory(const Store& s, int64_t n, bool allowed)
      : extent_(s.extent), longest_(allowed ? MOST_OF_GRAIN * s.grain : 0), kept_((size_t)n, Kept{0, 0, 0, -1.f, -1}) {}

  Kept* data() { return kept_.data(); }

  // How much farther than the nearest primitive the others must be known for the neighbours to outlast the next steps.
  float lead(double turn, double move) const {
    const double wanted = STEPS * (move + 0.5 * turn * extent_);
    return wanted < longest_ ? (float)wanted : 0.f;
  }

  void forget_radii() {
    for (Kept& k : kept_) k.radius2 = -1.f;
  }

 private:
  static constexpr double MOST_OF_GRAIN = 0.2, STEPS = 4.0;
  double extent_, longest_;
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

// Decides between Newton's and Horn's step after the plane passes. A Newton step stands while the sum of min(d^2, gate^2)
// over the scan falls; else it is undone and Horn's step, which cannot raise the sum, is made in its place. After a few
// such failures only Horn's steps are made.
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
    if (comparable && !(cost < cost_)) {
      ++failures_, used_ = false;
      return {horn_, true, false};
    }
    used_ = false, gate_ = gate, cost_ = cost, horn_ = horn;
    Step step;
    if (failures_ >= MOST_FAILURES || !newton_step(sums, longest, step)) return {horn, false, true};
    if (step.turn < eps_rad && step.move < eps_m) return {horn, false, true};
    used_ = true;
    return {step, false, false};
  }

 private:
  static constexpr int MOST_FAILURES = 3;
  double cost_ = 0, gate_ = 0;
  Step horn_{};
  int failures_ = 0;
  bool used_ = false;
};

}  // namespace

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

Outcome icp(const Store& s, const Code& code, const View& v, const double* T, const Rule& rule, Team& team) {
  Memory memory(s, v.n, rule.keep);
  Sides sides(s, code, rule.facing);
  Outcome o{};
  std::memcpy(o.T, T, sizeof o.T);
  o.gate = rule.gate, o.turn = o.move = worst(), o.rms = std::numeric_limits<double>::quiet_NaN();
  Newton newton;
  double before[12];
  bool plane = rule.n_plane > 0;
  while (o.passes < rule.n_max && !o.converged) {
    if (sides.look_from(o.T)) memory.forget_radii();
    const Pass kind = plane ? Pass::plane : rule.newton ? Pass::newton : Pass::point;
    const Look look{o.T, o.gate, memory.lead(o.turn, o.move), kind, rule.facing, &sides.facing()};
    const Sums sums = run_pass(s, code, v, look, memory.data(), team);
    ++o.passes;
    o.inliers = (int64_t)sums.v[0], o.ignored = (int64_t)sums.v[2], o.searched += (int64_t)sums.v[3];
    o.rms = o.inliers ? std::sqrt(sums.v[1] / sums.v[0]) : std::numeric_limits<double>::quiet_NaN();
    if (o.inliers < MIN_INLIERS) break;
    const double gate = rule.tighten > 0 ? std::min(o.gate, std::max(rule.floor, rule.tighten * o.rms)) : o.gate;
    const bool steady = gate >= 0.99 * o.gate;
    Step step{};
    if (plane && !plane_step(sums, rule.gate, step)) break;
    if (!plane) step = horn_step(sums);
    const bool small = step.turn < rule.eps_rad && step.move < rule.eps_m && steady;
    bool settled = !plane;
    if (kind == Pass::newton) {
      const double outside = (double)(v.n - o.ignored - o.inliers);
      const Newton::Choice c = newton.choose(sums, outside, o.gate, rule.gate, rule.eps_rad, rule.eps_m);
      settled = c.settled;
      if (c.undo) std::memcpy(o.T, before, sizeof before);
      if (!(small && settled)) step = c.step;
    }
    o.converged = small && settled;
    std::memcpy(before, o.T, sizeof before);
    apply(s, step, o.T);
    o.turn = step.turn, o.move = step.move;
    o.gate = gate;
    plane = plane && o.passes < rule.n_plane && !small;
  }
  return o;
}

}  // namespace avs
