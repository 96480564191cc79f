// Primitives split at medians into blocks of eight, and the tree of bounds over them.
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "build.hpp"

namespace avs {
namespace {

Vec3 unit(const Vec3& a) { return (1.0 / std::sqrt(dot(a, a))) * a; }
double axis_of(const Vec3& a, int k) { return k == 0 ? a.x : k == 1 ? a.y : a.z; }

Vec3 vertex(const Surface& s, int64_t i) { return {s.vertices[3 * i], s.vertices[3 * i + 1], s.vertices[3 * i + 2]}; }

struct Corners {
  Vec3 a, b, c;
};

Corners corners(const Surface& s, int32_t face) {
  const int32_t* f = s.faces + 3 * (int64_t)face;
  return {vertex(s, f[0]), vertex(s, f[1]), vertex(s, f[2])};
}

// Corners turned so that ab is the longest side; the winding stays.
Triangle triangle(Corners t) {
  const double ab = dot(t.b - t.a, t.b - t.a), bc = dot(t.c - t.b, t.c - t.b), ca = dot(t.a - t.c, t.a - t.c);
  if (bc > ab && bc >= ca)
    t = {t.b, t.c, t.a};
  else if (ca > ab && ca > bc)
    t = {t.c, t.a, t.b};
  Triangle r;
  r.a = t.a;
  r.length = std::sqrt(dot(t.b - t.a, t.b - t.a));
  r.u = unit(t.b - t.a);
  const Vec3 ac = t.c - t.a;
  Vec3 w = ac - dot(ac, r.u) * r.u;
  w = unit(w - dot(w, r.u) * r.u);  // a second time, because rounding left a part of it
  r.w = w;
  r.cx = dot(ac, r.u), r.cy = dot(ac, r.w);
  return r;
}

void split(std::vector<int32_t>& order, const std::vector<Vec3>& at, size_t first, size_t last) {
  const size_t n = last - first;
  if (n <= (size_t)LANES) {
    std::sort(order.begin() + first, order.begin() + last);
    return;
  }
  double lo[3], hi[3];
  for (int k = 0; k < 3; ++k) lo[k] = std::numeric_limits<double>::infinity(), hi[k] = -lo[k];
  for (size_t i = first; i < last; ++i)
    for (int k = 0; k < 3; ++k) {
      const double x = axis_of(at[order[i]], k);
      lo[k] = std::min(lo[k], x), hi[k] = std::max(hi[k], x);
    }
  int axis = 0;
  for (int k = 1; k < 3; ++k)
    if (hi[k] - lo[k] > hi[axis] - lo[axis]) axis = k;
  const size_t mid = first + (size_t)LANES * left_part((uint32_t)((n + LANES - 1) / LANES));
  const auto less = [&](int32_t a, int32_t b) {
    const double x = axis_of(at[a], axis), y = axis_of(at[b], axis);
    return x < y || (x == y && a < b);
  };
  std::nth_element(order.begin() + first, order.begin() + mid, order.begin() + last, less);
  split(order, at, first, mid);
  split(order, at, mid, last);
}

void put(float (&to)[3][LANES], int lane, const Vec3& v) {
  to[0][lane] = (float)v.x, to[1][lane] = (float)v.y, to[2][lane] = (float)v.z;
}

void add_point(Store& s, const Surface& from, size_t block, int lane, int32_t i) {
  const Vec3 p = vertex(from, i), q = p - s.centre;
  s.points.push_back(p);
  s.normals.push_back({0, 0, 0});
  s.id.push_back(i);
  PointBlock& b = s.point_blocks[block];
  b.x[lane] = (float)q.x, b.y[lane] = (float)q.y, b.z[lane] = (float)q.z;
}

void add_triangle(Store& s, const Surface& from, size_t block, int lane, int32_t i) {
  const Triangle t = triangle(corners(from, from.kept[i]));
  s.triangles.push_back(t);
  s.id.push_back(from.kept[i]);
  TriangleBlock& b = s.triangle_blocks[block];
  put(b.a, lane, t.a - s.centre), put(b.u, lane, t.u), put(b.w, lane, t.w);
  b.length[lane] = (float)t.length, b.cx[lane] = (float)t.cx, b.cy[lane] = (float)t.cy;
}

void grow(Box& b, const Vec3& p, float slack) {
  for (int k = 0; k < 3; ++k) {
    const float x = (float)axis_of(p, k);
    b.lo[k] = std::min(b.lo[k], x - slack), b.hi[k] = std::max(b.hi[k], x + slack);
  }
}

Box no_box() {
  constexpr float inf = std::numeric_limits<float>::infinity();
  return {{inf, inf, inf, 0}, {-inf, -inf, -inf, 0}};
}

Box box_of(const Store& s, uint32_t block) {
  Box b = no_box();
  for (size_t lane = (size_t)LANES * block; lane < (size_t)LANES * (block + 1); ++lane) {
    if (!s.mesh) {
      grow(b, s.points[lane] - s.centre, s.slack);
      continue;
    }
    const Triangle& t = s.triangles[lane];
    const Vec3 a = t.a - s.centre;
    grow(b, a, s.slack);
    grow(b, a - (-t.length) * t.u, s.slack);
    grow(b, (a - (-t.cx) * t.u) - (-t.cy) * t.w, s.slack);
  }
  return b;
}

// What the parent of a node stores of it.
struct Bounds {
  Box box = no_box();
  float n_lo[3], n_hi[3], h_lo, h_hi;

  Bounds() {
    constexpr float inf = std::numeric_limits<float>::infinity();
    for (int k = 0; k < 3; ++k) n_lo[k] = inf, n_hi[k] = -inf;
    h_lo = inf, h_hi = -inf;
  }

  void add(const Bounds& b) {
    for (int k = 0; k < 3; ++k) {
      box.lo[k] = std::min(box.lo[k], b.box.lo[k]), box.hi[k] = std::max(box.hi[k], b.box.hi[k]);
      n_lo[k] = std::min(n_lo[k], b.n_lo[k]), n_hi[k] = std::max(n_hi[k], b.n_hi[k]);
    }
    h_lo = std::min(h_lo, b.h_lo), h_hi = std::max(h_hi, b.h_hi);
  }
};

Bounds bounds_of(const Store& s, uint32_t block) {
  Bounds b;
  b.box = s.boxes[block];
  if (!s.mesh) return b;
  for (size_t lane = (size_t)LANES * block; lane < (size_t)LANES * (block + 1); ++lane) {
    const Triangle& t = s.triangles[lane];
    const Vec3 normal = t.n();
    for (int k = 0; k < 3; ++k) {
      const float n = (float)axis_of(normal, k);
      b.n_lo[k] = std::min(b.n_lo[k], n), b.n_hi[k] = std::max(b.n_hi[k], n);
    }
    const float h = (float)dot(normal, t.a - s.centre);
    b.h_lo = std::min(b.h_lo, h), b.h_hi = std::max(b.h_hi, h);
  }
  return b;
}

void set_child(Store& s, uint32_t node, int k, uint32_t child, const Bounds& b) {
  Node& n = s.nodes[node];
  n.child[k] = child;
  for (int a = 0; a < 3; ++a) n.lo[a][k] = b.box.lo[a], n.hi[a][k] = b.box.hi[a];
  if (!s.mesh) return;
  NodeSides& f = s.sides[node];
  for (int a = 0; a < 3; ++a) f.n_lo[a][k] = b.n_lo[a], f.n_hi[a][k] = b.n_hi[a];
  f.h_lo[k] = b.h_lo, f.h_hi[k] = b.h_hi;
}

// The part of a node's range that is one child's.
struct Part {
  uint32_t first, last;
};

void collect(uint32_t first, uint32_t last, uint32_t capacity, std::vector<Part>& parts) {
  if (last - first <= capacity) {
    parts.push_back({first, last});
    return;
  }
  const uint32_t mid = first + capacity * (((last - first + capacity - 1) / capacity + 1) / 2);
  collect(first, mid, capacity, parts), collect(mid, last, capacity, parts);
}

Bounds make_node(Store& s, uint32_t first, uint32_t last) {
  const uint32_t node = (uint32_t)s.nodes.size();
  s.nodes.emplace_back();
  if (s.mesh) s.sides.emplace_back();
  std::vector<Part> parts;
  collect(first, last, child_capacity(last - first), parts);
  Bounds all;
  for (int k = 0; k < LANES; ++k) {
    if (k >= (int)parts.size()) {
      set_child(s, node, k, NO_CHILD, Bounds());
      continue;
    }
    const Part p = parts[(size_t)k];
    const uint32_t child = p.last - p.first == 1 ? p.first | IS_BLOCK : (uint32_t)s.nodes.size();
    const Bounds b = p.last - p.first == 1 ? bounds_of(s, p.first) : make_node(s, p.first, p.last);
    set_child(s, node, k, child, b);
    all.add(b);
  }
  return all;
}

double median_diagonal(const Store& s) {
  std::vector<double> d(s.blocks);
  for (uint32_t k = 0; k < s.blocks; ++k) {
    const Box& b = s.boxes[k];
    double sum = 0;
    for (int a = 0; a < 3; ++a) sum += ((double)b.hi[a] - b.lo[a]) * ((double)b.hi[a] - b.lo[a]);
    d[k] = std::sqrt(sum);
  }
  std::nth_element(d.begin(), d.begin() + d.size() / 2, d.end());
  return d[d.size() / 2];
}

void set_frame(Store& s, const Surface& from) {
  Vec3 lo = vertex(from, 0), hi = lo;
  for (int64_t i = 1; i < from.n_vertices; ++i) {
    const Vec3 p = vertex(from, i);
    lo = {std::min(lo.x, p.x), std::min(lo.y, p.y), std::min(lo.z, p.z)};
    hi = {std::max(hi.x, p.x), std::max(hi.y, p.y), std::max(hi.z, p.z)};
  }
  s.centre = {0.5 * (lo.x + hi.x), 0.5 * (lo.y + hi.y), 0.5 * (lo.z + hi.z)};
  s.extent = std::sqrt(dot(hi - lo, hi - lo));
  // About 20 roundings of 6e-8 of the largest coordinate, doubled.
  s.slack = (float)(2e-6 * (s.extent + s.reach));
  s.tie = 1e-10 * (s.extent + s.reach), s.tie2 = s.tie * s.tie;
}

void build_blocks(Store& s, const Surface& from) {
  s.mesh = from.n_kept > 0;
  set_frame(s, from);
  const size_t n = (size_t)(s.mesh ? from.n_kept : from.n_vertices);
  std::vector<Vec3> at(n);
  for (size_t i = 0; i < n; ++i) {
    if (!s.mesh) {
      at[i] = vertex(from, (int64_t)i);
      continue;
    }
    const Corners t = corners(from, from.kept[i]);
    at[i] = {(t.a.x + t.b.x + t.c.x) / 3.0, (t.a.y + t.b.y + t.c.y) / 3.0, (t.a.z + t.b.z + t.c.z) / 3.0};
  }
  std::vector<int32_t> order(n);
  std::iota(order.begin(), order.end(), 0);
  split(order, at, 0, n);
  s.blocks = (uint32_t)((n + LANES - 1) / LANES);
  const size_t lanes = (size_t)LANES * s.blocks;
  s.id.reserve(lanes);
  s.mesh ? s.triangles.reserve(lanes) : (s.points.reserve(lanes), s.normals.reserve(lanes));
  s.mesh ? s.triangle_blocks.resize(s.blocks) : s.point_blocks.resize(s.blocks);
  for (size_t i = 0; i < lanes; ++i) {
    const int32_t k = order[std::min(i, n - 1)];  // the last block is filled up with the last primitive
    s.mesh ? add_triangle(s, from, i / LANES, (int)(i % LANES), k) : add_point(s, from, i / LANES, (int)(i % LANES), k);
  }
  s.last_valid = (uint8_t)(0xff >> ((size_t)LANES * s.blocks - n));
  s.boxes.resize(s.blocks);
  for (uint32_t k = 0; k < s.blocks; ++k) s.boxes[k] = box_of(s, k);
  make_node(s, 0, s.blocks);
  s.grain = median_diagonal(s);
}

// A cloud's, each from the point's neighbours.
void build_normals(Store& s, const Code& code, Team& team) {
  const int64_t lanes = (int64_t)s.points.size();
  team.each((lanes + CHUNK - 1) / CHUNK, [&](int64_t k) {
    code.normals(s, k * CHUNK, std::min(lanes, (k + 1) * CHUNK), s.normals.data());
  });
}

}  // namespace

std::size_t Store::bytes() const {
  return id.size() * sizeof id[0] + points.size() * sizeof(Vec3) + triangles.size() * sizeof(Triangle) +
         normals.size() * sizeof(Vec3) + point_blocks.size() * sizeof(PointBlock) +
         triangle_blocks.size() * sizeof(TriangleBlock) + boxes.size() * sizeof(Box) + 
         nodes.size() * sizeof(Node) + sides.size() * sizeof(NodeSides) + clear.size() * sizeof clear[0] +
         (top.size() + bricks.size() + lists.size()) * sizeof(uint32_t);
}

void build(Store& s, const Surface& surface, double reach, bool clearances, const Code& code, Team& team) {
  s.reach = reach;
  build_blocks(s, surface);
  if (!s.mesh) build_normals(s, code, team);
  build_cells(s, code, team);
  if (s.mesh && clearances) build_clearances(s, code, team);
}

}  // namespace avs
