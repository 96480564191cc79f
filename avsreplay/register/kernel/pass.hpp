// One chunk of a pass: move, search, sum. Included inside a namespace named after the instruction set.
//
// A chunk is taken in strips, which fit into the first-level cache, and a strip in sweeps so that the cache misses of many
// points overlap: moved points and their cells first, then the lists, then the blocks a few points ahead of the search.
constexpr int STRIP = 128;  // points
static_assert(CHUNK % STRIP == 0 && STRIP % 4 == 0, "sums run over four points at a time");

// What is searched: everything, two blocks, the block of the kept neighbour, or nothing but this neighbour.
enum Treat : uint8_t { IGNORED, SEARCHED, IN_PAIR, IN_BLOCK, KEPT };

struct Strip {
  alignas(32) double p[3][STRIP];   // moved, relative to the model's centre
  alignas(32) double f[3][STRIP];   // foot, the same
  alignas(32) double n[3][STRIP];   // normal, or v of the stiffness
  alignas(32) double sign[STRIP], whole[STRIP];  // of the stiffness
  alignas(32) double d2[STRIP];
  alignas(32) double take[STRIP];   // 1: an inlier, 0: not
  alignas(32) double c[3][STRIP];   // moved, in {C}
  int32_t lane[STRIP];              // of the primitive that is nearest, -1: none
  const uint32_t* list[STRIP];      // of the cell of a point that is searched for, or null
  alignas(16) float at[STRIP][4];   // moved, relative to the model's centre; the last is not used
  float off[STRIP];                 // its distance from the centre of this cell, rounded up [m]
  Treat search[STRIP];
};

// Reads n points and moves them by T: `c.c`, with `c.take` 1 where they are finite. The strip is filled up to a multiple of
// four.
template <class Number>
static void read(const View& v, int64_t first, int n, const double* T, Strip& c) {
  const char* from = v.data + first * v.row;
  for (int i = 0; i < n; ++i, from += v.row)
    for (int k = 0; k < 3; ++k) {
      Number x;
      std::memcpy(&x, from + k * v.column, sizeof x);
      c.p[k][i] = (double)x;
    }
  for (int i = n; i % 4; ++i) c.p[0][i] = c.p[1][i] = c.p[2][i] = 0;
  const D4 zero = d4(0), one = d4(1);
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 none = (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]);  // zero, or not a number
    store4(c.take + i, select(none < one, one, zero));
    for (int k = 0; k < 3; ++k)
      store4(c.c[k] + i, d4(T[4 * k]) * p[0] + d4(T[4 * k + 1]) * p[1] + d4(T[4 * k + 2]) * p[2] + d4(T[4 * k + 3]));
  }
}

static inline Treat treat(const Kept& k, const Strip& c, int i) {
  const double x = c.c[0][i] - k.x, y = c.c[1][i] - k.y, z = c.c[2][i] - k.z, moved2 = x * x + y * y + z * z;
  // Without branches, which could not be predicted: a room is at least as large as those inside it.
  return (Treat)(SEARCHED + (moved2 < (double)k.pair2) + (moved2 < (double)k.block2) + (moved2 < (double)k.radius2));
}

// Moves a strip and decides what is searched. Returns how many of the points are not finite.
static int gather(const Scope& o, const View& v, int64_t first, int n, const double* T, const Kept* kept, Strip& c) {
  const Store& s = o.s;
  v.single ? read<float>(v, first, n, T, c) : read<double>(v, first, n, T, c);
  int ignored = 0;
  for (int i = 0; i < n; ++i) {
    c.list[i] = nullptr;
    if (!(c.take[i] > 0)) {
      for (int k = 0; k < 3; ++k) c.c[k][i] = 0;
      c.search[i] = IGNORED, ++ignored;
      continue;
    }
    c.search[i] = kept ? treat(kept[first + i], c, i) : SEARCHED;
  }
  for (int i = 0; i < n; ++i) {
    c.at[i][0] = (float)(c.c[0][i] - s.centre.x), c.at[i][1] = (float)(c.c[1][i] - s.centre.y), c.at[i][2] = (float)(c.c[2][i] - s.centre.z);
    c.at[i][3] = 0;
  }
  const D4 low[3] = {d4(s.low.x), d4(s.low.y), d4(s.low.z)}, per_cell = d4(o.per_cell);
  for (int i = 0; i < n; i += 4)
    for (int k = 0; k < 3; ++k) store4(c.f[k] + i, (load4(c.c[k] + i) - low[k]) * per_cell);
  for (int i = 0; i < n; ++i)
    if (c.search[i] == SEARCHED)
      if (const uint32_t* word = c.list[i] = word_at(s, c.f[0][i], c.f[1][i], c.f[2][i])) fetch(word);
  for (int i = 0; i < n; ++i) {
    c.list[i] = list_of(s, c.list[i]);
    if (!c.list[i]) continue;
    fetch(c.list[i]), fetch(c.list[i] + LANES), fetch(c.list[i] + 2 * LANES);
    c.off[i] = off_centre(s, c.f[0][i], c.f[1][i], c.f[2][i]);
  }
  return ignored;
}

#include "searches.hpp"

constexpr int FAR_AHEAD = 16;  // points ahead of the feet

// Finds the primitive of every point of a strip. `remember`: where, for later passes.
template <class Kind>
static void search(const Scope& o, int64_t first, int n, const Kept* kept, Kept* remember, Strip& c, Effort& effort) {
  SearchesOfStrip<Kind>(o, n, kept ? kept + first : nullptr, remember ? remember + first : nullptr, c).run(effort);
}

// Calls put(i, points, feet, which of them are nearer than the bound) for every four points of the strip.
template <class Kind, class Put>
static void each_four(const Scope& o, int n, Ask ask, Strip& c, const Put& put) {
  for (int i = n; i < (n + 3) / 4 * 4; ++i) {
    c.lane[i] = -1;
    for (int k = 0; k < 3; ++k) c.c[k][i] = 0;
  }
  for (int i = 0; i < n; i += 4) {
    for (int k = i + FAR_AHEAD; k < i + FAR_AHEAD + 4 && k < n; ++k)
      if (c.lane[k] >= 0) Kind::prefetch_exact(o.s, (uint32_t)c.lane[k]);
    uint32_t lane[4];
    double none[4];
    for (int k = 0; k < 4; ++k) lane[k] = c.lane[i + k] < 0 ? 0 : (uint32_t)c.lane[i + k], none[k] = c.lane[i + k] < 0 ? 1 : 0;
    const D4 p[3] = {load4(c.c[0] + i), load4(c.c[1] + i), load4(c.c[2] + i)};
    const Four four = Kind::feet(o.s, lane, p, ask);
    put(i, p, four, both(load4(none) < d4(1), four.d2 < d4(o.bound2)));
  }
}

// What is not an inlier is zero.
template <class Kind>
static void settle(const Scope& o, int n, Ask ask, Strip& c) {
  const D4 zero = d4(0), centre[3] = {d4(o.s.centre.x), d4(o.s.centre.y), d4(o.s.centre.z)};
  each_four<Kind>(o, n, ask, c, [&](int i, const D4 (&p)[3], const Four& four, D4::Mask in) {
    const auto put = [&](double* to, D4 x) { store4(to + i, select(in, x, zero)); };
    put(c.take, d4(1)), put(c.d2, four.d2), put(c.sign, four.sign), put(c.whole, four.whole);
    for (int k = 0; k < 3; ++k) put(c.p[k], p[k] - centre[k]), put(c.f[k], four.foot[k] - centre[k]), put(c.n[k], four.v[k]);
  });
}

// Sums over the strips of a chunk in the order of `Sums`, each by the place of a point among four.
struct Fours {
  D4 v[SUMS] = {};

  // Local copies, because the compiler must assume that sums in memory change with the points.
  template <int N>
  void take(int from, D4 (&a)[N]) const {
    for (int k = 0; k < N; ++k) a[k] = v[from + k];
  }
  template <int N>
  void put(int from, const D4 (&a)[N]) {
    for (int k = 0; k < N; ++k) v[from + k] = a[k];
  }
};

static void sum_point(int n, const Strip& c, Fours& sums) {
  D4 a[19];
  sums.take(0, a);
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 f[3] = {load4(c.f[0] + i), load4(c.f[1] + i), load4(c.f[2] + i)};
    a[0] = a[0] + load4(c.take + i), a[1] = a[1] + load4(c.d2 + i);
    for (int k = 0; k < 3; ++k) a[4 + k] = a[4 + k] + p[k], a[7 + k] = a[7 + k] + f[k];
    for (int k = 0; k < 9; ++k) a[10 + k] = a[10 + k] + p[k / 3] * f[k % 3];
  }
  sums.put(0, a);
}

static void sum_newton(int n, const Strip& c, Fours& sums) {
  D4 a[31];
  sums.take(19, a);
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
  sums.put(19, a);
}

static void sum_plane(int n, const Strip& c, Fours& sums) {
  D4 a[35];
  sums.take(0, a);
  for (int i = 0; i < n; i += 4) {
    const D4 p[3] = {load4(c.p[0] + i), load4(c.p[1] + i), load4(c.p[2] + i)};
    const D4 m[3] = {load4(c.n[0] + i), load4(c.n[1] + i), load4(c.n[2] + i)};
    const D4 e = (load4(c.f[0] + i) - p[0]) * m[0] + (load4(c.f[1] + i) - p[1]) * m[1] + (load4(c.f[2] + i) - p[2]) * m[2];
    const D4 j[6] = {p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2], p[0] * m[1] - p[1] * m[0], m[0], m[1], m[2]};
    a[0] = a[0] + load4(c.take + i), a[1] = a[1] + load4(c.d2 + i);
    for (int k = 0; k < 3; ++k) a[4 + k] = a[4 + k] + p[k];
    int t = 7;
    for (int r = 0; r < 6; ++r)
      for (int q = 0; q <= r; ++q, ++t) a[t] = a[t] + j[r] * j[q];
    for (int r = 0; r < 6; ++r, ++t) a[t] = a[t] + j[r] * e;
    a[t] = a[t] + e * e;
  }
  sums.put(0, a);
}

static inline Scope scope_of(const Store& s, const Facing& facing, bool sided, double bound, float lead) {
  return {s, facing, sided && s.mesh ? &facing.eye : nullptr, bound * bound, (float)bound, lead, s.cell > 0 ? 1 / s.cell : 0};
}

template <class Kind>
static void pass_kind(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, Kept* kept,
                      Sums& out) {
  const Vec3 eye{look.T[3], look.T[7], look.T[11]};
  Scope o = scope_of(s, *look.facing, false, look.gate, look.lead);
  if (look.sided && s.mesh) o.eye = &eye;
  const bool plane = look.kind == Pass::plane, newton = look.kind == Pass::newton;
  Effort effort;
  Fours sums;
  Strip c;
  for (int64_t at = first; at < last; at += STRIP) {
    const int n = (int)std::min<int64_t>(STRIP, last - at);
    effort.ignored += gather(o, v, at, n, look.T, kept, c);
    search<Kind>(o, at, n, kept, kept, c, effort);
    settle<Kind>(o, n, plane ? Ask::NORMAL : newton ? Ask::STIFFNESS : Ask::FOOT, c);
    plane ? sum_plane(n, c, sums) : sum_point(n, c, sums);
    if (newton) sum_newton(n, c, sums);
  }
  for (int k = 0; k < SUMS; ++k) out.v[k] = sum_in_order(sums.v[k]);
  out.v[2] = (double)effort.ignored, out.v[3] = (double)effort.searched, out.v[50] = (double)effort.compared;
}

// Searches for the points whose kept neighbour is not nearer than `known`: what is kept says nothing of places farther
// than the gate under which it was found. Returns whether there were any.
template <class Kind>
static bool search_beyond(const Scope& o, int n, double known, Strip& c) {
  if (known >= o.bound) return false;
  bool any = false;
  for (int i = 0; i < n; ++i) {
    if (c.search[i] <= SEARCHED || (c.take[i] > 0 && c.d2[i] < known * known)) continue;
    const Query q = query(o.s, c.c[0][i], c.c[1][i], c.c[2][i]);
    const Vec3& low = o.s.low;
    const uint32_t* word = word_at(o.s, (q.x - low.x) * o.per_cell, (q.y - low.y) * o.per_cell, (q.z - low.z) * o.per_cell);
    c.lane[i] = Search<Kind>(o, q).run(list_of(o.s, word), c.lane[i]);
    any = true;
  }
  return any;
}

template <class Kind>
static int match_kind(const Store& s, const View& v, int64_t first, int64_t last, const Look& look, const Kept* kept, Match* out,
                      uint16_t* off, Footing* feet) {
  const Vec3 eye{look.T[3], look.T[7], look.T[11]};
  Scope o = scope_of(s, *look.facing, false, look.gate, 0.f);
  if (look.sided && s.mesh) o.eye = &eye;
  Effort effort;
  Strip c;
  int found = 0;
  for (int64_t at = first; at < last; at += STRIP) {
    const int n = (int)std::min<int64_t>(STRIP, last - at);
    gather(o, v, at, n, look.T, kept, c);
    search<Kind>(o, at, n, kept, nullptr, c, effort);
    settle<Kind>(o, n, Ask::NORMAL, c);
    if (kept && search_beyond<Kind>(o, n, look.known, c)) settle<Kind>(o, n, Ask::NORMAL, c);
    for (int i = 0; i < n; ++i) {
      if (!(c.take[i] > 0)) {
        if (off) *off++ = (uint16_t)(at - first + i);
        continue;
      }
      const double N[3] = {c.n[0][i], c.n[1][i], c.n[2][i]};
      const double e = N[0] * (c.p[0][i] - c.f[0][i]) + N[1] * (c.p[1][i] - c.f[1][i]) + N[2] * (c.p[2][i] - c.f[2][i]);
      out[found] = {{c.c[0][i], c.c[1][i], c.c[2][i]}, {N[0], N[1], N[2]}, e, c.d2[i]};
      if (feet) feet[found] = {{c.f[0][i] + s.centre.x, c.f[1][i] + s.centre.y, c.f[2][i] + s.centre.z}, c.lane[i]};
      ++found;
    }
  }
  return found;
}

static void add(const Match* matches, const uint32_t* order, int64_t n, PatchSums& to) {
  const D4 zero = d4(0);
  D4 low[6] = {zero, zero, zero, zero, zero, zero}, high[6] = {zero, zero, zero, zero, zero, zero}, last = zero;
  const auto put = [](double* sum, D4 part) { store4(sum, load4(sum) + part); };
  for (int64_t k = 0; k < n; ++k) {
    const Match& m = matches[order[k]];
    const double *p = m.p, *v = m.n;
    const double J[6] = {p[1] * v[2] - p[2] * v[1], p[2] * v[0] - p[0] * v[2], p[0] * v[1] - p[1] * v[0], v[0], v[1], v[2]};
    const D4 first = d4(J[0], J[1], J[2], J[3]), rest = d4(J[4], J[5], m.e, 1);
    for (int r = 0; r < 6; ++r) low[r] = low[r] + d4(J[r]) * first, high[r] = high[r] + d4(J[r]) * rest;
    last = last + d4(p[0], p[1], p[2], m.e);
    if (k + 1 < n && order[k + 1] / CHUNK == order[k] / CHUNK) continue;
    for (int r = 0; r < 6; ++r) put(to.rows[r], low[r]), put(to.rows[r] + 4, high[r]), low[r] = high[r] = zero;
    put(to.last, last), last = zero;
  }
  to.points += n;
}

template <class Kind>
static int64_t closest_kind(const Store& s, const View& v, int64_t first, int64_t last, const double* T, const Facing& facing,
                            bool sided, double bound, const Feet& out) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const Scope o = scope_of(s, facing, sided, bound, 0.f);
  Strip c;
  Effort effort;
  for (int64_t at = first; at < last; at += STRIP) {
    const int n = (int)std::min<int64_t>(STRIP, last - at);
    if ((at - first) % CHUNK == 0) effort.last = -1;  // the work is that of separate chunks
    gather(o, v, at, n, T, nullptr, c);
    search<Kind>(o, at, n, nullptr, nullptr, c, effort);
    each_four<Kind>(o, n, Ask::NORMAL, c, [&](int i, const D4 (&)[3], const Four& four, D4::Mask in) {
      const D4 none = d4(nan);
      double d2[4], v[6][4];
      store4(d2, select(in, four.d2, d4(std::numeric_limits<double>::infinity())));
      for (int k = 0; k < 3; ++k) store4(v[k], select(in, four.foot[k], none)), store4(v[3 + k], select(in, four.v[k], none));
      for (int64_t j = 0; j < 4 && i + j < n; ++j) {
        const int64_t to = at + i + j;
        out.d2[to] = d2[j], out.id[to] = std::isfinite(d2[j]) ? s.id[(size_t)c.lane[i + j]] : -1;
        for (int k = 0; k < 3; ++k) out.foot[3 * to + k] = v[k][j], out.normal[3 * to + k] = v[3 + k][j];
      }
    });
  }
  return effort.compared;
}
