// Which blocks can hold the nearest primitive of some place in a box. Exact up to a margin on the safe side.
// Included inside a namespace named after the instruction set.
//
// A primitive t goes when some pivot k is nearer all over the box. Points: |q-t|^2 - |q-k|^2 is linear in q, so its least
// value over the box is known in closed form. Triangles: with f the foot of the box's centre c on t and g the unit
// direction from f to c, convexity gives |q - t| >= |c - f| + g.(q - c), while |q - k| is convex in q and largest at a
// corner: t goes when the bound beats k's distance at all eight corners.

static inline Query at(const double* c, const Store& s) { return query(s, c[0], c[1], c[2]); }

static inline void corner(const Filter& f, int k, double* out) {
  for (int a = 0; a < 3; ++a) out[a] = f.centre[a] + (k >> a & 1 ? f.half : -f.half);
}

template <class Kind>
static float measure(const Store& s, const Query& q, const uint32_t* list, uint32_t n, float* d2) {
  F8 m = f8(3e38f);
  for (uint32_t k = 0; k < n; ++k) {
    const F8 d = Kind::distance2(s, list[k], q);
    store8(d2 + LANES * k, d);
    m = min8(m, d);
  }
  return least(m);
}

static inline uint32_t lane_of(const uint32_t* list, const float* d2, uint32_t n, float least_d2) {
  for (uint32_t k = 0; k < LANES * n; ++k)
    if (d2[k] == least_d2) return LANES * list[k / LANES] + k % LANES;
  return LANES * list[0];
}

struct Pivots {
  uint32_t lane[9];
  int n = 0;

  void add(uint32_t l) {
    for (int k = 0; k < n; ++k)
      if (lane[k] == l) return;
    lane[n++] = l;
  }
};

struct PointPivots {
  float p[9][3];
  int n;
};

static inline PointPivots describe(const Store& s, const Filter& f, const Pivots& v, Points) {
  PointPivots r{{}, v.n};
  for (int k = 0; k < v.n; ++k) {
    const Vec3& p = s.points[v.lane[k]];
    r.p[k][0] = (float)(p.x - f.centre[0]), r.p[k][1] = (float)(p.y - f.centre[1]), r.p[k][2] = (float)(p.z - f.centre[2]);
  }
  return r;
}

static inline F8 abs8(F8 a) { return max8(a, f8(0.f) - a); }

// Lanes of the block that no pivot beats all over the box.
static inline unsigned unbeaten(const Store& s, const Filter& f, const PointPivots& v, uint32_t block, Points) {
  const PointBlock& b = s.point_blocks[block];
  const F8 x = load8(b.x) - f8((float)(f.centre[0] - s.centre.x)), y = load8(b.y) - f8((float)(f.centre[1] - s.centre.y)),
           z = load8(b.z) - f8((float)(f.centre[2] - s.centre.z));
  const F8 half = f8((float)f.half + s.slack);
  unsigned beaten = 0;
  for (int k = 0; k < v.n && beaten != 255u; ++k) {
    const F8 kx = f8(v.p[k][0]), ky = f8(v.p[k][1]), kz = f8(v.p[k][2]);
    const F8 ux = x - kx, uy = y - ky, uz = z - kz;
    const F8 sx = x + kx, sy = y + ky, sz = z + kz;
    const F8 reach = (abs8(ux) + abs8(uy) + abs8(uz)) * half;
    const F8 margin = (abs8(sx) + abs8(sy) + abs8(sz)) * f8(s.slack);  // rounded coordinates
    beaten |= bits(reach + reach + margin < ux * sx + uy * sy + uz * sz);
  }
  return ~beaten & 255u;
}

struct TrianglePivots {
  float corner[9][8];
  int n;
};

static inline TrianglePivots describe(const Store& s, const Filter& f, const Pivots& v, Triangles) {
  TrianglePivots r{{}, v.n};
  for (int c = 0; c < 8; ++c) {
    double at_corner[3];
    corner(f, c, at_corner);
    const Query q = at(at_corner, s);
    for (int k = 0; k < v.n; ++k) r.corner[k][c] = (float)std::sqrt(Triangles::foot(s, v.lane[k], q).d2) + 4.f * s.slack;
  }
  return r;
}

static inline unsigned unbeaten(const Store& s, const Filter& f, const TrianglePivots& v, uint32_t block, Triangles) {
  const TriangleBlock& b = s.triangle_blocks[block];
  const Triangles::Local r = Triangles::local(b, at(f.centre, s));
  const F8 dx = r.x - r.fx, dy = r.y - r.fy;
  const F8 d = sqrt8(dx * dx + dy * dy + r.z * r.z), inv = f8((float)f.half) / max8(d, f8(1e-30f));
  F8 g[3];
  for (int a = 0; a < 3; ++a) g[a] = (dx * load8(b.u[a]) + dy * load8(b.w[a]) + r.z * load8(b.n[a])) * inv;
  F8 bound[8];
  for (int c = 0; c < 8; ++c) {
    bound[c] = d - inv * f8(8.f * s.slack);  // the direction is known to slack / d
    for (int a = 0; a < 3; ++a) bound[c] = c >> a & 1 ? bound[c] + g[a] : bound[c] - g[a];
  }
  // Too near for a direction: the bound says nothing.
  unsigned beaten = 0;
  const unsigned clear = bits(f8(s.slack) < d);
  for (int k = 0; k < v.n && beaten != clear; ++k) {
    F8::Mask all = f8(v.corner[k][0]) < bound[0];
    for (int c = 1; c < 8; ++c) all = both(all, f8(v.corner[k][c]) < bound[c]);
    beaten |= bits(all) & clear;
  }
  return ~beaten & 255u;
}

constexpr uint32_t CORNER_PIVOTS_UNDER = 96;  // blocks; longer lists are first cut down by the centre's pivot

template <class Kind, class Described>
static Filtered filter_kind(const Store& s, const Filter& f) {
  const float m = measure<Kind>(s, at(f.centre, s), f.in, f.n, f.scratch);
  const float d = std::sqrt(m), radius = (float)(f.half * 1.7320509);
  // A place in the box is at most d + radius from the surface, so its nearest primitive at most d + 2 radius from c.
  const float limit = d + 2.f * radius + 4.f * s.slack, limit2 = limit * limit * 1.00001f;
  Pivots pivots;
  pivots.add(lane_of(f.in, f.scratch, f.n, m));
  uint32_t n = 0;
  for (uint32_t k = 0; k < f.n; ++k)
    if (bits(load8(f.scratch + LANES * k) < f8(limit2))) f.out[n++] = f.in[k];
  if (n == 1) return {n, d};
  if (n < CORNER_PIVOTS_UNDER) {
    for (int c = 0; c < 8; ++c) {
      double p[3];
      corner(f, c, p);
      const float mc = measure<Kind>(s, at(p, s), f.out, n, f.scratch);
      pivots.add(lane_of(f.out, f.scratch, n, mc));
    }
  }
  const Described described = describe(s, f, pivots, Kind{});
  uint32_t kept = 0;
  for (uint32_t k = 0; k < n; ++k)
    if (unbeaten(s, f, described, f.out[k], Kind{})) f.out[kept++] = f.out[k];
  return {kept, d};
}
