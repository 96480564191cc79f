// The nearest primitive of a query: through its cell's list, or down the tree where there is none.
// Included inside a namespace named after the instruction set.
struct Best {
  Foot foot;
  int32_t lane;  // 8 block + lane, -1: none within the bound
};

static inline Best nothing(double bound2) { return {{bound2, 0, 0, 0, 0}, -1}; }

// Of two at the same distance the one that faces the query more squarely wins, then the lower id.
static inline bool wins_tie(const Store& s, const Foot& f, uint32_t lane, const Best& best) {
  if (std::fabs(f.height - best.foot.height) > s.tie) return f.height > best.foot.height;
  return s.id[lane] < s.id[(size_t)best.lane];
}

template <class Kind>
static inline bool nearer(const Store& s, const Foot& f, uint32_t lane, const Best& best) {
  const double tie = Kind::tie(s, best.foot.d2);
  if (f.d2 < best.foot.d2 - tie) return true;
  return f.d2 <= best.foot.d2 + tie && wins_tie(s, f, lane, best);
}

// `eye`: only primitives that face it count; null: all.
template <class Kind>
static inline void consider(const Store& s, const Query& q, uint32_t block, unsigned lanes, const Vec3* eye, Best& best) {
  for (; lanes; lanes &= lanes - 1) {
    const uint32_t lane = LANES * block + (uint32_t)lowest_bit(lanes);
    if (eye && !Kind::faces(s, lane, *eye)) continue;
    const Foot f = Kind::foot(s, lane, q);
    if (best.lane < 0 ? f.d2 < best.foot.d2 : nearer<Kind>(s, f, lane, best)) best = {f, (int32_t)lane};
  }
}

// Largest single-precision square that a primitive as near as `d2` can show.
static inline float lenient(const Store& s, float d2) {
  const float d = std::sqrt(d2) + 2.f * s.slack;
  return d * d * 1.00001f;
}

// The least and the second least of all the lanes seen.
struct TwoLeast {
  F8 first = f8(3e38f), second = f8(3e38f);

  void add(F8 d) {
    second = min8(second, max8(first, d));
    first = min8(first, d);
  }

  float runner_up() const {
    float a[8], b[8];
    store8(a, first), store8(b, second);
    float m = 3e38f, n = 3e38f;
    for (int k = 0; k < 8; ++k) {
      const float larger = a[k] < m ? m : a[k];
      n = larger < n ? larger : n;
      n = b[k] < n ? b[k] : n;
      m = a[k] < m ? a[k] : m;
    }
    return n;
  }
};

// `room`: how far the query may move before another primitive can be the nearest, or any come within reach.
template <class Kind>
static inline Best in_list(const Store& s, const Query& q, const uint32_t* list, float* d2, float* room) {
  const uint32_t n = *list++;
  TwoLeast two;
  for (uint32_t k = 0; k < n; ++k) {
    const F8 d = Kind::distance2(s, list[k], q);
    store8(d2 + LANES * k, d);
    two.add(d);
  }
  const float m = least(two.first);
  const F8 limit = f8(lenient(s, m));
  Best best = nothing(s.reach * s.reach);
  for (uint32_t k = 0; k < n; ++k) {
    const unsigned lanes = bits(load8(d2 + LANES * k) < limit);
    if (lanes) consider<Kind>(s, q, list[k], lanes, nullptr, best);
  }
  if (room) {
    const float d = std::sqrt(m);
    *room = best.lane < 0 ? d - (float)s.reach : 0.5f * (std::sqrt(two.runner_up()) - d);
    *room -= 2.f * s.slack;
  }
  return best;
}

static inline float box_distance2(const Box& b, const float* q) {
  float sum = 0;
  for (int k = 0; k < 3; ++k) {
    const float under = b.lo[k] - q[k], over = q[k] - b.hi[k];
    const float d = under > over ? under : over;
    if (d > 0) sum += d * d;
  }
  return sum;
}

// Branch and bound over the tree; boxes are in single precision, so the bound is lenient.
template <class Kind>
static Best in_tree(const Store& s, const Query& q, double bound2, const Vec3* eye) {
  struct Todo {
    uint32_t node, first, last;
    float d2;
  } stack[64];
  const float p[3] = {(float)(q.x - s.centre.x), (float)(q.y - s.centre.y), (float)(q.z - s.centre.z)};
  Best best = nothing(bound2);
  int depth = 0;
  stack[depth++] = {0, 0, s.blocks, box_distance2(s.nodes[0], p)};
  while (depth) {
    const Todo t = stack[--depth];
    const float limit = lenient(s, (float)best.foot.d2);
    if (t.d2 > limit) continue;
    if (t.last - t.first == 1) {
      consider<Kind>(s, q, t.first, bits(Kind::distance2(s, t.first, q) < f8(limit)), eye, best);
      continue;
    }
    const uint32_t left = (t.last - t.first + 1) / 2, mid = t.first + left;
    const Todo a{t.node + 1, t.first, mid, box_distance2(s.nodes[t.node + 1], p)};
    const Todo b{t.node + 2 * left, mid, t.last, box_distance2(s.nodes[t.node + 2 * left], p)};
    stack[depth++] = a.d2 < b.d2 ? b : a;
    stack[depth++] = a.d2 < b.d2 ? a : b;
  }
  return best;
}

struct Place {
  bool inside;
  int32_t cell[3];  // of the finest cells
};

static inline Place place(const Store& s, double x, double y, double z) {
  const double inv = 1.0 / s.cell;
  const double f[3] = {(x - s.low.x) * inv, (y - s.low.y) * inv, (z - s.low.z) * inv};
  Place p{true, {0, 0, 0}};
  for (int k = 0; k < 3; ++k) {
    if (!(f[k] >= 0 && f[k] < (double)s.size[k] * FINE)) return {false, {0, 0, 0}};
    p.cell[k] = (int32_t)f[k];
  }
  return p;
}

static inline size_t top_slot(const Store& s, const Place& p) {
  constexpr int shift = 2 * LEVELS;
  return ((size_t)(p.cell[0] >> shift) * s.size[1] + (p.cell[1] >> shift)) * s.size[2] + (p.cell[2] >> shift);
}

static inline size_t brick_slot(uint32_t word, const Place& p, int level) {
  const int shift = 2 * (LEVELS - 1 - level);
  const auto part = [&](int k) { return (size_t)(p.cell[k] >> shift & 3); };
  return (size_t)(word & ~IS_BRICK) * 64 + (part(0) * 4 + part(1)) * 4 + part(2);
}

struct Found {
  uint32_t word;
  int level;  // bricks passed on the way: the word's cell has the side cell * 4^(LEVELS - level)
};

static inline Found word_at(const Store& s, const Place& p) {
  Found f{s.top[top_slot(s, p)], 0};
  for (; f.word & IS_BRICK; ++f.level) f.word = s.bricks[brick_slot(f.word, p, f.level)];
  return f;
}

// Distance from a place to the walls of its word's cell.
static inline float to_wall(const Store& s, const Query& q, const Place& p, int level) {
  const int shift = 2 * (LEVELS - level);
  const double side = s.cell * (double)(1 << shift), at[3] = {q.x - s.low.x, q.y - s.low.y, q.z - s.low.z};
  double least = side;
  for (int k = 0; k < 3; ++k) {
    const double into = at[k] - (double)(p.cell[k] >> shift) * side, left = side - into;
    least = into < least ? into : least;
    least = left < least ? left : least;
  }
  return (float)least - s.slack;
}

template <class Kind>
static inline Best nearest(const Store& s, const Query& q, uint32_t word, float* scratch, float* room) {
  const double reach2 = s.reach * s.reach;
  if (room) *room = word == EMPTY ? 3e38f : 0.f;
  if (word == EMPTY) return nothing(reach2);
  const uint32_t* list = s.lists.data() + word;
  return *list == TOO_MANY ? in_tree<Kind>(s, q, reach2, nullptr) : in_list<Kind>(s, q, list, scratch, room);
}

// The nearest of the primitives that face the eye, given the nearest of all; within the bound.
template <class Kind>
static inline Best nearest_facing(const Store& s, const Query& q, const Best& best, double bound2, const Vec3& eye) {
  if (best.lane < 0 || best.foot.d2 >= bound2) return nothing(bound2);
  return Kind::faces(s, (uint32_t)best.lane, eye) ? best : in_tree<Kind>(s, q, bound2, &eye);
}
