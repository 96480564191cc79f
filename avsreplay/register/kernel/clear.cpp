// How far from each face the closest point is a linear function of the measured one.
//
// A ball that touches the surface in the middle of a face, on either side, and contains no other surface is clear: a point of its
// diameter there is closest to the face. The largest clear radius is the distance to the medial axis. It is small near sharp edges,
// on thin parts and on strongly curved ones, whether or not the mesh has an edge there.
#include <algorithm>
#include <cmath>

#include "build.hpp"

namespace avs {
namespace {

constexpr double TOUCHING = 0.98;  // of the radius: what is nearer to the middle of a ball is inside
constexpr int SMALL = 3;             // level below which the middle of a face tells of all of it
constexpr double APART = 0.9;      // of the distance from the sides of a face: balls inside it must be clear as well
constexpr double OPPOSITE = -0.7;  // cosine of two faces that no camera sees at once, or only from far aside
constexpr double CORNERS[4][3] = {{1 / 3.0, 1 / 3.0, 1 / 3.0}, {2 / 3.0, 1 / 6.0, 1 / 6.0}, {1 / 6.0, 2 / 3.0, 1 / 6.0}, {1 / 6.0, 1 / 6.0, 2 / 3.0}};

struct Ball {
  double at[3], n[3];  // where it touches the face
  double most;         // [m] larger balls are taken as this one
};

Ball ball_on(const Triangle& t, const double* weights, double most) {
  const double x = weights[1] * t.length + weights[2] * t.cx, y = weights[2] * t.cy;
  const Vec3 n = t.n();
  return {{t.a.x + x * t.u.x + y * t.w.x, t.a.y + x * t.u.y + y * t.w.y, t.a.z + x * t.u.z + y * t.w.z}, {n.x, n.y, n.z}, most};
}

double side_distance(const Triangle& t, double x, double y) {
  const std::array<double, 3> d = side_distances(t, x, y);
  return std::min(d[0], std::min(d[1], d[2]));
}

class Balls {
 public:
  Balls(const Store& s, const Code& code) : s_(s), code_(code) { code.face(s, nullptr, 0, all_); }

  // Whether the balls of a radius on both sides are clear; `sided`: but for a face that faces the other way.
  bool clear(const Ball& b, double radius, bool sided) const {
    const double r = std::min(radius, b.most), still[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
    for (const double side : {-1.0, 1.0}) {
      const double p[3] = {b.at[0] + side * r * b.n[0], b.at[1] + side * r * b.n[1], b.at[2] + side * r * b.n[2]};
      const View v{reinterpret_cast<const char*>(p), 1, 3 * (int64_t)sizeof(double), sizeof(double), false};
      double foot[3], d2, normal[3];
      int32_t id;
      code_.closest(s_, v, 0, 1, still, all_, false, TOUCHING * r, {foot, &d2, &id, normal});
      if (!std::isfinite(d2)) continue;
      if (!sided || normal[0] * b.n[0] + normal[1] * b.n[1] + normal[2] * b.n[2] > OPPOSITE) return false;
    }
    return true;
  }

  // The number of the largest level up to `most` at which all balls are clear.
  int level(const Ball* balls, int n, int most, bool sided) const {
    int least = 0;
    while (least < most) {
      const int middle = (least + most + 1) / 2;
      const bool good = std::all_of(balls, balls + n, [&](const Ball& b) { return clear(b, clear_radius(s_, middle), sided); });
      good ? least = middle : most = middle - 1;
    }
    return least;
  }

 private:
  const Store& s_;
  const Code& code_;
  Facing all_;
};

uint32_t clearance(const Store& s, const Balls& balls, const Triangle& t) {
  const double far = clear_radius(s, CLEAR_LEVELS);
  const Ball middle = ball_on(t, CORNERS[0], far);
  uint32_t levels = (uint32_t)balls.level(&middle, 1, CLEAR_LEVELS, false);
  if (side_distance(t, (t.length + t.cx) / 3, t.cy / 3) < clear_radius(s, SMALL)) return levels;
  Ball inside[4];
  for (int k = 0; k < 4; ++k) {
    const double *w = CORNERS[k], apart = side_distance(t, w[1] * t.length + w[2] * t.cx, w[2] * t.cy);
    inside[k] = ball_on(t, w, APART * apart);
  }
  const int most = balls.level(inside, 4, CLEAR_LEVELS, true);
  levels |= (uint32_t)most << 4;
  for (int side = 0; side < 3; ++side) {
    Ball on[2];
    for (int k = 0; k < 2; ++k) {
      double w[3] = {};
      w[side] = (1 + k) / 3.0, w[(side + 1) % 3] = (2 - k) / 3.0;
      on[k] = ball_on(t, w, far);
    }
    levels |= (uint32_t)balls.level(on, 2, most, true) << (8 + 4 * side);
  }
  return levels;
}

}  // namespace

void build_clearances(Store& s, const Code& code, Team& team) {
  const Balls balls(s, code);
  s.clear.resize(s.triangles.size());
  team.each((int64_t)s.blocks, [&](int64_t block) {
    for (int64_t lane = LANES * block; lane < LANES * (block + 1); ++lane)
      s.clear[(size_t)lane] = clearance(s, balls, s.triangles[(size_t)lane]);
  });
}

}  // namespace avs
