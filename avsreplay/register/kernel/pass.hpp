// One chunk of a pass: move, search, sum. Included inside a namespace named after the instruction set.
//
// The chunk is taken in sweeps so that the cache misses of many points overlap: moved points and their cells first, then
// the lists, then the blocks a few points ahead of the search.
static_assert(CHUNK % 4 == 0, "sums run over four points at a time");

enum Treat : uint8_t { IGNORED, SEARCHED, IN_BLOCK, KEPT };  // only the kept neighbour's block, or only the neighbour

struct Chunk {
  alignas(32) double p[3][CHUNK];   // moved, relative to the model's centre
  alignas(32) double f[3][CHUNK];   // foot, the same
  alignas(32) double n[3][CHUNK];   // normal, or v of the stiffness
  alignas(32) double sign[CHUNK], whole[CHUNK];  // of the stiffness
  alignas(32) double d2[CHUNK];
  alignas(32) double take[CHUNK];   // 1: an inlier, 0: not
  double c[3][CHUNK];               // moved, in {C}
  const uint32_t* list[CHUNK];      // of the cell of a point that is searched for, or null
  Treat search[CHUNK];
};

static inline bool finite(const double* p) { return std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]); }

template <class Number>
static inline void read(const View& v, int64_t i, double* p) {
  for (int k = 0; k < 3; ++k) {
    Number x;
    std::memcpy(&x, v.data + i * v.row + k * v.column, sizeof x);
    p[k] = (double)x;
  }
}

static inline void read(const View& v, int64_t i, double* p) { v.single ? read<float>(v, i, p) : read<double>(v, i, p); }

static inline void move(const double* T, const double* p, double* q) {
  for (int k = 0; k < 3; ++k) q[k] = T[4 * k] * p[0] + T[4 * k + 1] * p[1] + T[4 * k + 2] * p[2] + T[4 * k + 3];
}

static inline Treat treat(const Kept& k, const double* q) {
  const double x = q[0] - k.x, y = q[1] - k.y, z = q[2] - k.z, moved2 = x * x + y * y + z * z;
  return moved2 < (double)k.radius2 ? KEPT : moved2 < (double)k.block2 ? IN_BLOCK : SEARCHED;
}

static void gather(const Store& s, const View& v, int64_t first, int n, const double* T, const Kept* kept, Chunk& c,
                   Sums& out) {
  for (int i = 0; i < n; ++i) {
    double p[3], q[3];
    read(v, first + i, p);
    c.search[i] = finite(p) ? SEARCHED : IGNORED;
    c.list[i] = nullptr;
    if (c.search[i] == IGNORED) {
      out.v[2] += 1;
      continue;
    }
    move(T, p, q);
    for (int k = 0; k < 3; ++k) c.c[k][i] = q[k];
    if (kept) c.search[i] = treat(kept[first + i], q);
    if (c.search[i] != SEARCHED) continue;
    if (const uint32_t* word = word_at(s, q[0], q[1], q[2])) {
      c.list[i] = word;
      fetch(word);
    }
  }
  for (int i = 0; i < n; ++i) {
    c.list[i] = list_of(s, c.list[i]);
    if (c.list[i]) fetch(c.list[i]);
  }
}

template <class Kind>
static inline void enter(const Store& s, Chunk& c, int i, const Best& best, bool inlier, Pass kind) {
  const Foot& f = best.foot;
  c.take[i] = inlier ? 1 : 0;
  c.d2[i] = inlier ? f.d2 : 0;
  c.p[0][i] = inlier ? c.c[0][i] - s.centre.x : 0, c.f[0][i] = inlier ? f.x - s.centre.x : 0;
  c.p[1][i] = inlier ? c.c[1][i] - s.centre.y : 0, c.f[1][i] = inlier ? f.y - s.centre.y : 0;
  c.p[2][i] = inlier ? c.c[2][i] - s.centre.z : 0, c.f[2][i] = inlier ? f.z - s.centre.z : 0;
  if (kind == Pass::point) return;
  Stiffness k{{0, 0, 0}, 0, 0};
  if (inlier) k = kind == Pass::plane ? Stiffness{Kind::normal(s, (uint32_t)best.lane), 1, 0} : Kind::stiffness(s, (uint32_t)best.lane, f.feature);
  c.n[0][i] = k.v.x, c.n[1][i] = k.v.y, c.n[2][i] = k.v.z, c.sign[i] = k.sign, c.whole[i] = k.whole;
}

static inline Best none() { return {{0, 0, 0, 0, 0, FACE}, -1}; }

template <class Kind>
static inline Best keep_one(const Scope& o, const Query& q, const Kept& kept, Treat treat) {
  if (kept.lane < 0) return none();
  if (treat == KEPT) return {Kind::foot(o.s, (uint32_t)kept.lane, q), kept.lane};
  Search<Kind> search(o, q);
  search.run_block((uint32_t)kept.lane / LANES);
  return search.best();
}

// Square of a length, with room for rounding; negative where it is not positive.
static inline float squared(float room) { return room > 0.f ? room * room * 0.9999f : -1.f; }

template <class Kind>
static inline Best search_one(const Scope& o, const Query& q, const uint32_t* list, int32_t seed, Kept* kept) {
  Search<Kind> search(o, q);
  search.run(list, seed);
  if (kept) {
    typename Search<Kind>::Room room{0.f, 0.f};
    if (o.lead > 0.f) room = search.room();
    *kept = {q.x, q.y, q.z, squared(room.lane), squared(room.block), search.best().lane};
  }
  return search.best();
}

// A kept neighbour that no longer faces the eye is searched for again.
template <class Kind>
static inline bool is_kept(const Scope& o, Treat treat, const Kept* kept) {
  return treat >= IN_BLOCK && (!o.eye || kept->lane < 0 || Kind::faces(o.s, (uint32_t)kept->lane, *o.eye));
}

constexpr int AHEAD = 4;

// What the search of a point will read first.
template <class Kind>
static inline void fetch_ahead(const Store& s, Treat treat, const uint32_t* list, const Kept* kept) {
  if (kept && kept->lane >= 0) {
    Kind::prefetch_exact(s, (uint32_t)kept->lane);
    if (treat != KEPT) Kind::prefetch_block(s, (uint32_t)kept->lane / LANES);
  }
  if (!list) return;
  const uint32_t n = *list & (MOST_BLOCKS - 1);
  for (uint32_t k = 1; k <= n && k <= 2; ++k) Kind::prefetch_block(s, list[k] & (MOST_BLOCKS - 1));
}

template <class Kind>
static void search(const Scope& o, int64_t first, int n, Pass kind, Kept* kept, Chunk& c, Sums& out) {
  int32_t last = -1;
  for (int i = 0; i < n; ++i) {
    if (i + AHEAD < n) fetch_ahead<Kind>(o.s, c.search[i + AHEAD], c.list[i + AHEAD], kept ? kept + first + i + AHEAD : nullptr);
    if (c.search[i] == IGNORED) {
      enter<Kind>(o.s, c, i, none(), false, kind);
      continue;
    }
    const Query q = query(o.s, c.c[0][i], c.c[1][i], c.c[2][i]);
    Kept* memory = kept ? kept + first + i : nullptr;
    Best best;
    if (is_kept<Kind>(o, c.search[i], memory)) {
      best = keep_one<Kind>(o, q, *memory, c.search[i]);
    } else {
      const int32_t own = memory ? memory->lane : -1;
      best = search_one<Kind>(o, q, c.list[i], own < 0 && !c.list[i] ? last : own, memory);
      out.v[3] += 1;
    }
    last = best.lane;
    enter<Kind>(o.s, c, i, best, best.lane >= 0 && best.foot.d2 < o.bound2, kind);
  }
}

static void clear_tail(int n, Chunk& c) {
  for (int i = n; i < (n + 3) / 4 * 4; ++i) {
    c.take[i] = c.d2[i] = c.sign[i] = c.whole[i] = 0;
    for (int k = 0; k < 3; ++k) c.p[k][i] = c.f[k][i] = c.n[k][i] = 0;
  }
}

static void sum_point(int n, const Chunk& c, Sums& out) {
  D4 a[18] = {};
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 f[3] = {load4(c.f[0] + i), load4(c.f[1] + i), load4(c.f[2] + i)};
    a[0] = a[0] + load4(c.take + i), a[1] = a[1] + load4(c.d2 + i);
    for (int k = 0; k < 3; ++k) a[2 + k] = a[2 + k] + p[k], a[5 + k] = a[5 + k] + f[k];
    for (int k = 0; k < 9; ++k) a[8 + k] = a[8 + k] + p[k / 3] * f[k % 3];
  }
  out.v[0] = sum_in_order(a[0]), out.v[1] = sum_in_order(a[1]);
  for (int k = 0; k < 15; ++k) out.v[4 + k] = sum_in_order(a[2 + k]);
}

static void sum_newton(int n, const Chunk& c, Sums& out) {
  D4 a[31] = {};
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 m[3] = {load4(c.n[0] + i), load4(c.n[1] + i), load4(c.n[2] + i)};
    const D4 j[6] = {p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2], p[0] * m[1] - p[1] * m[0], m[0], m[1], m[2]};
    const D4 sign = load4(c.sign + i), whole = load4(c.whole + i);
    int t = 0;
    for (int r = 0; r < 6; ++r) {
      const D4 row = sign * j[r];
      for (int q = 0; q <= r; ++q, ++t) a[t] = a[t] + row * j[q];
    }
    a[t] = a[t] + whole, ++t;
    for (int r = 0; r < 3; ++r, ++t) a[t] = a[t] + whole * p[r];
    for (int r = 0; r < 3; ++r)
      for (int q = 0; q <= r; ++q, ++t) a[t] = a[t] + whole * p[r] * p[q];
  }
  for (int k = 0; k < 31; ++k) out.v[19 + k] = sum_in_order(a[k]);
}

static void sum_plane(int n, const Chunk& c, Sums& out) {
  D4 a[33] = {};
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 m[3] = {load4(c.n[0] + i), load4(c.n[1] + i), load4(c.n[2] + i)};
    const D4 e = (load4(c.f[0] + i) - p[0]) * m[0] + (load4(c.f[1] + i) - p[1]) * m[1] + (load4(c.f[2] + i) - p[2]) * m[2];
    const D4 j[6] = {p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2], p[0] * m[1] - p[1] * m[0], m[0], m[1], m[2]};
    a[0] = a[0] + load4(c.take + i), a[1] = a[1] + load4(c.d2 + i);
    for (int k = 0; k < 3; ++k) a[2 + k] = a[2 + k] + p[k];
    int t = 5;
    for (int r = 0; r < 6; ++r)
      for (int q = 0; q <= r; ++q, ++t) a[t] = a[t] + j[r] * j[q];
    for (int r = 0; r < 6; ++r, ++t) a[t] = a[t] + j[r] * e;
    a[t] = a[t] + e * e;
  }
  out.v[0] = sum_in_order(a[0]), out.v[1] = sum_in_order(a[1]);
  for (int k = 0; k < 31; ++k) out.v[4 + k] = sum_in_order(a[2 + k]);
}

static inline Scope scope_of(const Store& s, const Facing& facing, bool sided, double bound, float lead) {
  return {s, facing, sided && s.mesh ? &facing.eye : nullptr, bound * bound, (float)bound, lead};
}

template <class Kind>
static void pass_kind(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, Kept* kept,
                      Sums& out) {
  Chunk c;
  const int n = (int)(last - first);
  for (double& x : out.v) x = 0;
  gather(s, v, first, n, look.T, kept, c, out);
  const Vec3 eye{look.T[3], look.T[7], look.T[11]};
  Scope o = scope_of(s, *look.facing, false, look.gate, look.lead);
  if (look.sided && s.mesh) o.eye = &eye;
  search<Kind>(o, first, n, look.kind, kept, c, out);
  clear_tail(n, c);
  look.kind == Pass::plane ? sum_plane(n, c, out) : sum_point(n, c, out);
  if (look.kind == Pass::newton) sum_newton(n, c, out);
}

template <class Kind>
static void match_kind(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, const Kept* kept,
                       Match* out) {
  Chunk c;
  Sums counts{};
  const int n = (int)(last - first);
  gather(s, v, first, n, look.T, kept, c, counts);
  const Vec3 eye{look.T[3], look.T[7], look.T[11]};
  Scope o = scope_of(s, *look.facing, false, look.gate, 0.f);
  if (look.sided && s.mesh) o.eye = &eye;
  int32_t last_lane = -1;
  for (int i = 0; i < n; ++i) {
    const Kept* memory = kept ? kept + first + i : nullptr;
    if (i + AHEAD < n) fetch_ahead<Kind>(s, c.search[i + AHEAD], c.list[i + AHEAD], memory ? memory + AHEAD : nullptr);
    Match& m = out[first + i];
    m.inlier = false;
    if (c.search[i] == IGNORED) continue;
    const Query q = query(s, c.c[0][i], c.c[1][i], c.c[2][i]);
    const int32_t own = memory ? memory->lane : -1;
    const Best best = is_kept<Kind>(o, c.search[i], memory)
                          ? keep_one<Kind>(o, q, *memory, c.search[i])
                          : search_one<Kind>(o, q, c.list[i], own < 0 && !c.list[i] ? last_lane : own, nullptr);
    last_lane = best.lane;
    if (best.lane < 0 || !(best.foot.d2 < o.bound2)) continue;
    const Vec3 normal = Kind::normal(s, (uint32_t)best.lane);
    m = {{q.x, q.y, q.z}, {normal.x, normal.y, normal.z}, 0, best.foot.d2, true};
    m.e = normal.x * (q.x - best.foot.x) + normal.y * (q.y - best.foot.y) + normal.z * (q.z - best.foot.z);
  }
}

template <class Kind>
static void closest_kind(const Store& s, const View& v, int64_t first, int64_t last, const Facing& facing, bool sided,
                         double bound, const Feet& out) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const Scope o = scope_of(s, facing, sided, bound, 0.f);
  int32_t seed = -1;
  for (int64_t i = first; i < last; ++i) {
    double p[3];
    read(v, i, p);
    Best best = none();
    if (finite(p)) {
      const Query q = query(s, p[0], p[1], p[2]);
      const uint32_t* list = list_of(s, word_at(s, q.x, q.y, q.z));
      best = search_one<Kind>(o, q, list, list ? -1 : seed, nullptr);
    }
    seed = best.lane;
    const bool found = best.lane >= 0;
    const Vec3 n = found ? Kind::normal(s, (uint32_t)best.lane) : Vec3{nan, nan, nan};
    const Vec3 f = found ? Vec3{best.foot.x, best.foot.y, best.foot.z} : Vec3{nan, nan, nan};
    out.id[i] = found ? s.id[(size_t)best.lane] : -1;
    out.d2[i] = found ? best.foot.d2 : std::numeric_limits<double>::infinity();
    out.foot[3 * i] = f.x, out.foot[3 * i + 1] = f.y, out.foot[3 * i + 2] = f.z;
    out.normal[3 * i] = n.x, out.normal[3 * i + 1] = n.y, out.normal[3 * i + 2] = n.z;
  }
}
