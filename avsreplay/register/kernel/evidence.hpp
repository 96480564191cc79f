// The quality of a pose: what its inliers tell, summed over patches of the model.
#pragma once
#include <cmath>

#include "cubes.hpp"
#include "loop.hpp"

namespace avs {

// An inlier before it is moved onto its face.
struct Sample {
  Match match;
  Footing at;
};

struct Evidence {
  int64_t points = 0, inliers = 0;
  double sum_d2 = 0, centre[3] = {0, 0, 0};  // centroid of the inliers
  double median = 0;                         // of |e|
  std::vector<int64_t> off;                  // numbers of the points that are no inliers, ascending
  std::vector<PatchSums> patches;            // in the order of their first points
  Numbers cubes;                             // of the patches, unless every point is one
  std::vector<Sample> samples;               // some of the inliers, none where every point is a patch
};

struct PatchRule {
  double gate, side;  // [m]; a patch is the points whose feet lie in one cube of this side
  int least;          // with no more patches than this every point is one
  bool facing;
  double noise = 0;  // [m] along the rays; above 0 points that noise moved over an edge add nothing to the patches
};

constexpr double CREDIBLE = 3;  // standard deviations beyond which a point is not one of the model with noise

// Whether a measured point within a distance from a place of a face of a mesh is closest to its plane.
bool is_clear(const Store& store, int32_t lane, const double* on, double distance);

// The closest points of a scan at a pose, a chunk at a time.
class Matcher {
 public:
  Matcher(const Store& s, const Code& code, const View& v, const double* T, const PatchRule& rule, const Matches* matches)
      : s_(s), code_(code), v_(v), sided_(rule.facing && s.mesh) {
    const Vec3 eye{T[3], T[7], T[11]};
    const bool hold = matches && matches->hold(v.n, eye, sided_);
    if (!hold) code.face(s, sided_ ? &eye : nullptr, 0, own_);
    look_ = {T, rule.gate, 0.f, Pass::plane, sided_, hold ? &matches->facing : &own_, hold ? NEARER * matches->gate : 0};
    kept_ = hold ? matches->kept.data() : nullptr;
  }
  Matcher(const Matcher&) = delete;
  Matcher& operator=(const Matcher&) = delete;

  // What is matched, and how.
  const Look& look() const { return look_; }

  // Whether a point near an edge can be of the face with which it is matched: noise along the ray moves it off the face by no more
  // than its part along the normal. A face that the camera sees at a grazing angle takes points of its neighbours otherwise, which
  // tell nothing of its place. `at` is read with noise alone.
  bool is_of_face(const Match& m, const Footing& at, double noise) const {
    if (noise <= 0 || !sided_ || is_clear(s_, at.lane, at.foot, CREDIBLE * noise)) return true;
    double range2 = 0, along = 0;
    for (int a = 0; a < 3; ++a) {
      const double ray = m.p[a] - look_.T[4 * a + 3];
      range2 += ray * ray, along += ray * m.n[a];
    }
    return std::fabs(m.e) * std::sqrt(range2) <= CREDIBLE * noise * std::fabs(along);
  }
  int64_t chunks() const { return (v_.n + CHUNK - 1) / CHUNK; }

  // The inliers of a chunk, in the order of the scan; returns how many. `off`: the numbers of the others in the chunk; `feet`:
  // where the feet of the inliers are.
  int inliers(int64_t chunk, Match* out, uint16_t* off = nullptr, Footing* feet = nullptr) const {
    const int64_t first = chunk * CHUNK, last = std::min(v_.n, first + CHUNK);
    const View part{v_.data + first * v_.row, last - first, v_.row, v_.column, v_.single};
    return code_.match(s_, part, 0, part.n, look_, kept_ ? kept_ + first : nullptr, out, off, feet);
  }

 private:
  static constexpr double NEARER = 0.999;  // of the gate of an alignment: neighbours this near are the nearest whatever the gate
  const Store& s_;
  const Code& code_;
  const View v_;
  const bool sided_;
  Facing own_;
  Look look_{};
  const Kept* kept_ = nullptr;
};

// Moves a point onto the plane of its face, which leaves J. Patches by the measured points would divide a face that lies near
// the boundary of two cubes by the sign of e, and the errors within each patch would then look correlated.
inline void onto_face(Match& m) {
  for (int a = 0; a < 3; ++a) m.p[a] -= m.e * m.n[a];
}

// T: rows of [R t], scan into {C}. Points that are not finite are left out. `matches`: of an alignment of the same scan
// that ended near T, or null; it changes the time, never the result.
Evidence evidence(const Store& store, const Code& code, const View& points, const double* T, const PatchRule& rule,
                  Team& team, const Matches* matches);
// The same; `stride`: every such inlier of a chunk is a sample, 0: none.
Evidence evidence(const Matcher& matcher, const Code& code, const View& points, const PatchRule& rule, Team& team, int64_t stride);

// Whether t of T may be the camera: of about `tested` points of the scan that have a closest point, at least this share has it on
// a face that faces t. A quarter of them decides where their share is far from the least one.
bool faces_camera(const Store& store, const Code& code, const View& points, const double* T, int64_t tested, double least_facing);

// Whether a scan, seen from the origin of {A}, is narrower than `least` of n points of the model (n, 3) at the pose T, along
// one of four directions of the image, 45 deg apart.
bool is_narrower(const View& points, const double* T, const double* model, int64_t n, double least);

// How the model surface that the camera should see is found.
struct SeenRule {
  double in_front, least_facing;          // least cosines of the angles to the direction of the scan, and of incidence
  double least_cosine, hidden;            // of incidence, of what is seen; [m] behind the nearest of its cell
  double per_cell;                        // points of the surface in a cell of the image, about
};
// The numbers of those of n points of the model (n, 3), with normals, that a camera at the origin of {A} that looks at the scan
// should see at the pose T, ascending: they face it, and no other point of a cell of the image is clearly nearer.
std::vector<int64_t> seen(const View& scan, const double* T, const double* model, const double* normals, int64_t n, const SeenRule& rule);

// Whether only faces that face the camera count: where t of T may be it (`known`), and of about `tested` points that have a
// closest point at least this share has it on a face that faces t.
struct Sight {
  bool known;
  int64_t tested;
  double least_facing;
};
// Points among `part` of a scan, evenly over its order, that are farther than `beyond` from the model at T but within the reach of
// the index. `off`: the numbers of the points that may be, ascending. `sided`: only faces that face t of T count.
int64_t count_beyond(const Store& store, const Code& code, const View& points, const double* T, bool sided, double beyond, int64_t part,
                     const std::vector<int64_t>& off);

// The distances of the points of a scan to the model at T, at most `most`; returns the work in ordinary searches.
int64_t distances(const Store& store, const Code& code, const View& points, const double* T, const Sight& sight, double most,
                  double* out);

}  // namespace avs
