// The nearest primitive of a query by branch and bound over the tree, begun at a guess.
// Included inside a namespace named after the instruction set.
struct Best {
  Foot foot;
  int32_t lane;  // 8 block + lane, -1: none within the bound
};

// What all queries of a pass have in common.
struct Scope {
  const Store& s;
  const Facing& facing;
  const Vec3* eye;  // only primitives that face it count; null: all
  double bound2;    // feet at this squared distance or farther do not count [m^2]
  float bound;      // its root [m]
  float lead;       // other primitives are found up to this much beyond the nearest [m]; 0: only the nearest
};

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

// Square of a distance and a lead, with room for the rounding of single precision.
static inline float lenient(const Store& s, float d, float lead) {
  const float r = d + 2.f * s.slack + lead;
  return r * r * 1.00001f;
}

static inline F8 box_distance2(const Node& n, const Query& q) {
  const F8 zero = f8(0.f);
  const F8 x = max8(max8(load8(n.lo[0]) - q.qx, q.qx - load8(n.hi[0])), zero);
  const F8 y = max8(max8(load8(n.lo[1]) - q.qy, q.qy - load8(n.hi[1])), zero);
  const F8 z = max8(max8(load8(n.lo[2]) - q.qz, q.qz - load8(n.hi[2])), zero);
  return x * x + y * y + z * z;
}

// Where the grid keeps the list of the cell that a place is in, or null.
static inline const uint32_t* word_at(const Store& s, double x, double y, double z) {
  if (!(s.cell > 0)) return nullptr;
  const double inv = 1.0 / s.cell, f[3] = {(x - s.low.x) * inv, (y - s.low.y) * inv, (z - s.low.z) * inv};
  int32_t c[3];
  for (int k = 0; k < 3; ++k) {
    if (!(f[k] >= 0 && f[k] < (double)s.size[k] * BRICK)) return nullptr;
    c[k] = (int32_t)f[k];
  }
  const uint32_t brick = s.top[((size_t)(c[0] / BRICK) * s.size[1] + c[1] / BRICK) * s.size[2] + c[2] / BRICK];
  if (!brick) return nullptr;
  return s.bricks.data() + (size_t)(brick - 1) * WORDS + (size_t)((c[0] % BRICK * BRICK + c[1] % BRICK) * BRICK + c[2] % BRICK);
}

static inline const uint32_t* list_of(const Store& s, const uint32_t* word) {
  return word && *word ? s.lists.data() + *word : nullptr;
}

constexpr int STACK = 96;  // at most 10 levels of 8 children

// One search.
template <class Kind>
class Search {
 public:
  Search(const Scope& scope, const Query& q)
      : o_(scope), s_(scope.s), q_(q), best_{{scope.bound2, 0, 0, 0, 0, FACE}, -1},
        p_{(float)(q.x - s_.centre.x), (float)(q.y - s_.centre.y), (float)(q.z - s_.centre.z)},
        exact_(lenient(s_, scope.bound, 0.f)), limit_(lenient(s_, scope.bound, scope.lead)) {}

  // `list`: of the query's cell, or null. `seed`: a lane to begin with, -1 for none; it shows in the time, never in the
  // result.
  void run(const uint32_t* list, int32_t seed) {
    if (!is_near()) return;
    const uint32_t first = seed < 0 ? NO_CHILD : (uint32_t)seed / LANES;
    if (seed >= 0) visit(first);
    if (list && in_list(list, first)) return;
    first_ = second_ = 3e38f;  // the tree comes to the same blocks again
    in_tree();
  }

  const Best& best() const { return best_; }

  // How far the query may move before another primitive can be the nearest, or one come within the bound. An eye that
  // stays within the margin of `Facing` makes no difference.
  float room() const {
    if (best_.lane >= 0 && first_ < least_) return 0.f;  // a lane that may come to face the eye is nearer
    const float first = std::sqrt(first_), second = std::sqrt(second_), known = std::sqrt(limit_);
    const float next = best_.lane < 0 ? first : second;
    const float gap = (next < known ? next : known) - (best_.lane < 0 ? o_.bound : first);
    return (best_.lane < 0 ? gap : 0.5f * gap) - 3.f * s_.slack;
  }

 private:
  // False for every query that is farther than the bound from the model's box, or not finite.
  bool is_near() const {
    const Vec3& c = s_.centre;
    const double sum = std::fabs(q_.x - c.x) + std::fabs(q_.y - c.y) + std::fabs(q_.z - c.z);
    return sum <= 2.0 * (s_.extent + (double)o_.bound + (double)o_.lead);
  }

  // Visits the blocks of the list. False where others may be nearer.
  bool in_list(const uint32_t* list, uint32_t seed) {
    constexpr int shift = 32 - DISTANCE_BITS;
    const uint32_t n = *list & (MOST_BLOCKS - 1);
    const float radius = cell_radius(s_);
    for (uint32_t k = 1; k <= n; ++k) {
      const float d = (float)(list[k] >> shift) * s_.step - radius;
      if (d > 0.f && !(d * d < limit_)) break;
      const uint32_t block = list[k] & (MOST_BLOCKS - 1);
      if (block != seed && o_.facing.may[block] && to_box2(s_.boxes[block]) < limit_) visit(block);
    }
    const float known = (float)(*list >> shift) * s_.step - radius;
    return known > 0.f && limit_ <= known * known;
  }

  float to_box2(const Box& b) const {
    float sum = 0;
    for (int k = 0; k < 3; ++k) {
      const float under = b.lo[k] - p_[k], over = p_[k] - b.hi[k], d = under > over ? under : over, out = d > 0.f ? d : 0.f;
      sum += out * out;
    }
    return sum;
  }

  void in_tree() {
    struct Todo {
      uint32_t child;
      float d2;
    } stack[STACK];
    int depth = 0;
    stack[depth++] = {0, 0.f};
    while (depth) {
      const Todo t = stack[--depth];
      if (!(t.d2 < limit_)) continue;
      if (t.child & IS_BLOCK) {
        visit(t.child & ~IS_BLOCK);
        continue;
      }
      const Node& n = s_.nodes[t.child];
      const F8 d = box_distance2(n, q_);
      unsigned open = bits(d < f8(limit_)) & o_.facing.alive[t.child];
      if (!open) continue;
      alignas(32) float d2[LANES];
      store8(d2, d);
      int nearest = depth;
      for (; open; open &= open - 1) {
        const int k = lowest_bit(open);
        stack[depth] = {n.child[k], d2[k]};
        if (d2[k] < stack[nearest].d2) nearest = depth;
        ++depth;
      }
      const Todo last = stack[depth - 1];
      stack[depth - 1] = stack[nearest], stack[nearest] = last;
    }
  }

  void visit(uint32_t block) {
    const F8 d = Kind::distance2(s_, block, q_);
    unsigned lanes = bits(d < f8(limit_)) & o_.facing.may[block];
    if (!lanes) return;
    alignas(32) float d2[LANES];
    store8(d2, d);
    const unsigned sure = o_.facing.sure[block];
    float least = least_;
    for (unsigned m = lanes; m; m &= m - 1) {
      const int k = lowest_bit(m);
      second_ = d2[k] < first_ ? first_ : d2[k] < second_ ? d2[k] : second_;
      first_ = d2[k] < first_ ? d2[k] : first_;
      if ((sure >> k & 1) && d2[k] < least) least = d2[k];
    }
    tighten(least);
    for (; lanes; lanes &= lanes - 1) {
      const int k = lowest_bit(lanes);
      if (!(d2[k] < exact_)) continue;
      const uint32_t lane = LANES * block + (uint32_t)k;
      if (!(sure >> k & 1) && !Kind::faces(s_, lane, *o_.eye)) continue;
      const Foot f = Kind::foot(s_, lane, q_);
      if (best_.lane < 0 ? f.d2 < best_.foot.d2 : nearer<Kind>(s_, f, lane, best_)) best_ = {f, (int32_t)lane};
      tighten(d2[k]);
    }
  }

  void tighten(float d2) {
    if (!(d2 < least_)) return;
    least_ = d2;
    const float d = std::sqrt(d2), exact = lenient(s_, d, 0.f), limit = lenient(s_, d, o_.lead);
    exact_ = exact < exact_ ? exact : exact_, limit_ = limit < limit_ ? limit : limit_;
  }

  const Scope& o_;
  const Store& s_;
  const Query& q_;
  Best best_;
  float p_[3];  // the query relative to the model's centre
  float exact_, limit_;  // squared distances under which lanes are measured exactly, and looked at
  float least_ = 3e38f;  // least squared distance of a lane that counts
  float first_ = 3e38f, second_ = 3e38f;  // least two of the lanes that may count
};
