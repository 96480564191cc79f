#include "loop.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "step.hpp"

namespace avs {
namespace {

constexpr int64_t MIN_INLIERS = 6;

// Decides pass by pass whether neighbours are remembered; it shows in the time, never in the result. They are once a
// step moves no point by more than a part of a cell, and no longer where most were searched for all the same, until
// the steps are half as long.
class Memory {
 public:
  Memory(const Store& s, int64_t n, bool allowed) : extent_(s.extent), longest_(allowed ? (s.mesh ? MESH_UNDER : CLOUD_UNDER) * s.cell : 0), n_(n) {}

  Kept* for_step(double turn, double move) {
    length_ = move + 0.5 * turn * extent_;
    judged_ = filled_;
    filled_ = length_ < longest_;
    if (!filled_) return nullptr;
    if (kept_.empty()) kept_.assign((size_t)n_, Kept{0, 0, 0, -1.f, -1});
    return kept_.data();
  }

  void was_searched(int64_t searched) {
    if (judged_ && searched > (int64_t)(TOO_OFTEN * (double)n_)) longest_ = 0.5 * length_;
  }

 private:
  static constexpr double MESH_UNDER = 0.3, CLOUD_UNDER = 0.04, TOO_OFTEN = 0.6;
  double extent_, longest_, length_ = 0;
  int64_t n_;
  bool filled_ = false, judged_ = false;  // this pass fills the memory; the one before did, so this one can use it
  std::vector<Kept> kept_;
};

double worst() { return std::numeric_limits<double>::infinity(); }


// The pose about the model's centre, where the sums live.
void recentre(double* T, const Vec3& by) { T[3] += by.x, T[7] += by.y, T[11] += by.z; }

bool advance(const Store& s, const Sums& sums, bool plane, Outcome& o) {
  Step step{};
  if (plane) {
    if (!plane_step(sums, step)) return false;
  } else {
    step = horn_step(sums);
  }
  recentre(o.T, {-s.centre.x, -s.centre.y, -s.centre.z});
  compose(step.D, o.T);
  recentre(o.T, s.centre);
  o.turn = step.turn, o.move = step.move;
  return true;
}

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
  Outcome o{};
  std::memcpy(o.T, T, sizeof o.T);
  o.gate = rule.gate, o.turn = o.move = worst(), o.rms = std::numeric_limits<double>::quiet_NaN();
  bool plane = rule.n_plane > 0;
  while (o.passes < rule.n_max && !o.converged) {
    Kept* kept = memory.for_step(o.turn, o.move);
    const Look look{o.T, o.gate * o.gate, plane ? Pass::plane : Pass::point, rule.facing};
    const Sums sums = run_pass(s, code, v, look, kept, team);
    if (kept) memory.was_searched((int64_t)sums.v[3]);
    ++o.passes;
    o.inliers = (int64_t)sums.v[0], o.ignored = (int64_t)sums.v[2], o.searched += (int64_t)sums.v[3];
    o.rms = o.inliers ? std::sqrt(sums.v[1] / sums.v[0]) : std::numeric_limits<double>::quiet_NaN();
    if (o.inliers < MIN_INLIERS || !advance(s, sums, plane, o)) break;
    const double gate = rule.tighten > 0 ? std::min(o.gate, std::max(rule.floor, rule.tighten * o.rms)) : o.gate;
    const bool small = o.turn < rule.eps_rad && o.move < rule.eps_m && gate >= 0.99 * o.gate;
    o.gate = gate;
    o.converged = small && !plane;
    plane = plane && o.passes < rule.n_plane && !small;
  }
  return o;
}

}  // namespace avs
