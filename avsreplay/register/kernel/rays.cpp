#include "rays.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include "interrupt.hpp"
#include "loop.hpp"

namespace avs {
namespace {

constexpr double LEAST_COMPONENT = 1e-30;  // of a direction, so that its inverse is finite
constexpr double NEVER = std::numeric_limits<double>::infinity();
constexpr int STACK = 96;  // at most 10 levels of 8 children

struct Ray {
  double from[3];     // the eye, relative to the model's centre
  double inverse[3];  // of the direction
  Vec3 eye, d;

  Ray(const Store& s, const Vec3& at, const double* direction) : eye(at), d{direction[0], direction[1], direction[2]} {
    const double relative[3] = {at.x - s.centre.x, at.y - s.centre.y, at.z - s.centre.z};
    for (int k = 0; k < 3; ++k) {
      from[k] = relative[k];
      inverse[k] = 1.0 / (std::fabs(direction[k]) < LEAST_COMPONENT ? LEAST_COMPONENT : direction[k]);
    }
  }

  // Where the ray enters the boxes of the children of a node, infinite if it passes them.
  void enters(const Node& n, double slack, double (&first)[LANES]) const {
    double last[LANES];
    for (int i = 0; i < LANES; ++i) first[i] = 0, last[i] = NEVER;
    for (int k = 0; k < 3; ++k)
      for (int i = 0; i < LANES; ++i) {
        const double low = ((double)n.lo[k][i] - slack - from[k]) * inverse[k], high = ((double)n.hi[k][i] + slack - from[k]) * inverse[k];
        const double in = low < high ? low : high, out = low < high ? high : low;
        first[i] = in > first[i] ? in : first[i], last[i] = out < last[i] ? out : last[i];
      }
    for (int i = 0; i < LANES; ++i) first[i] = first[i] <= last[i] ? first[i] : NEVER;
  }

  // Range of the point of a face on the ray if it is below `best`, else `best`. A side belongs to both of its faces.
  double meets(const Triangle& t, double tie, double best) const {
    const Vec3 n = t.n(), to{t.a.x - eye.x, t.a.y - eye.y, t.a.z - eye.z};
    const double slope = n.x * d.x + n.y * d.y + n.z * d.z, range = (n.x * to.x + n.y * to.y + n.z * to.z) / slope;
    if (!(range > 0 && range < best)) return best;
    const Vec3 p{range * d.x - to.x, range * d.y - to.y, range * d.z - to.z};
    const double x = p.x * t.u.x + p.y * t.u.y + p.z * t.u.z, y = p.x * t.w.x + p.y * t.w.y + p.z * t.w.z, least = -tie * t.length;
    const bool inside = y >= -tie && x * t.cy - y * t.cx >= least && (t.length - x) * t.cy - y * (t.length - t.cx) >= least;
    return inside ? range : best;
  }
};

double first_face(const Store& s, const Ray& ray, int64_t& compared) {
  struct Todo {
    uint32_t child;
    double from;
  } stack[STACK];
  int depth = 0;
  double best = NEVER;
  stack[depth++] = {0, 0.0};
  while (depth) {
    const Todo t = stack[--depth];
    if (!(t.from < best)) continue;
    ++compared;
    if (t.child & IS_BLOCK) {
      const uint32_t block = t.child & ~IS_BLOCK;
      const unsigned valid = block + 1 == s.blocks ? s.last_valid : 0xffu;
      for (uint32_t k = 0; k < (uint32_t)LANES; ++k)
        if (valid >> k & 1) best = ray.meets(s.triangles[LANES * block + k], s.tie, best);
      continue;
    }
    const Node& n = s.nodes[t.child];
    double from[LANES];
    ray.enters(n, s.slack, from);
    int nearest = depth;
    for (int k = 0; k < LANES; ++k) {
      if (n.child[k] == NO_CHILD || !(from[k] < best)) continue;
      stack[depth] = {n.child[k], from[k]};
      if (from[k] < stack[nearest].from) nearest = depth;
      ++depth;
    }
    if (nearest < depth) std::swap(stack[depth - 1], stack[nearest]);
  }
  return best;
}

}  // namespace

int64_t cast(const Store& s, const Vec3& eye, const double* directions, int64_t n, double* ranges) {
  int64_t compared = 0;
  for (int64_t k = 0; k < n; ++k) {
    poll(k);
    ranges[k] = first_face(s, Ray(s, eye, directions + 3 * k), compared);
  }
  return work_of(n, compared);
}

}  // namespace avs
