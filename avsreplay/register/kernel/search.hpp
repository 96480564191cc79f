// The nearest primitive of a query: through its cell's list, or down the tree where there is none.
// Included inside a namespace named after the instruction set.
struct Best {
  Foot foot;
  int32_t lane;  // 8 block + lane, -1: none within the bound
};

static inline Best nothing(double bound2) { return {{bound2, 0, 0, 0}, -1}; }

// Of two at the same computed distance the lower id wins.
template <class Kind>
static inline void consider(const Store& s, const Query& q, uint32_t block, unsigned lanes, Best& best) {
  for (; lanes; lanes &= lanes - 1) {
    const uint32_t lane = LANES * block + (uint32_t)lowest_bit(lanes);
    const Foot f = Kind::foot(s, lane, q);
    const bool tie = f.d2 == best.foot.d2 && best.lane >= 0 && s.id[lane] < s.id[(size_t)best.lane];
    if (f.d2 < best.foot.d2 || tie) best = {f, (int32_t)lane};
  }
}

// Largest single-precision square that a primitive as near as `d2` can show.
static inline float lenient(const Store& s, float d2) {
  const float d = std::sqrt(d2) + 2.f * s.slack;
  return d * d * 1.00001f;
}

template <class Kind>
static inline Best in_list(const Store& s, const Query& q, const uint32_t* list, float* d2) {
  const uint32_t n = *list++;
  F8 m = f8(3e38f);
  for (uint32_t k = 0; k < n; ++k) {
    const F8 d = Kind::distance2(s, list[k], q);
    store8(d2 + LANES * k, d);
    m = min8(m, d);
  }
  const F8 limit = f8(lenient(s, least(m)));
  Best best = nothing(s.reach * s.reach);
  for (uint32_t k = 0; k < n; ++k) {
    const unsigned lanes = bits(load8(d2 + LANES * k) < limit);
    if (lanes) consider<Kind>(s, q, list[k], lanes, best);
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
static Best in_tree(const Store& s, const Query& q, double bound2) {
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
      consider<Kind>(s, q, t.first, bits(Kind::distance2(s, t.first, q) < f8(limit)), best);
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

static inline uint32_t word_at(const Store& s, const Place& p) {
  uint32_t word = s.top[top_slot(s, p)];
  for (int level = 0; word & IS_BRICK; ++level) word = s.bricks[brick_slot(word, p, level)];
  return word;
}

template <class Kind>
static inline Best nearest(const Store& s, const Query& q, uint32_t word, float* scratch) {
  const double reach2 = s.reach * s.reach;
  if (word == EMPTY) return nothing(reach2);
  const uint32_t* list = s.lists.data() + word;
  return *list == TOO_MANY ? in_tree<Kind>(s, q, reach2) : in_list<Kind>(s, q, list, scratch);
}
