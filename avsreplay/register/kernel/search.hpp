// The nearest primitive of a query by branch and bound over the tree, begun at a guess.
// Included inside a namespace named after the instruction set.
// What all queries of a pass have in common.
struct Scope {
  const Store& s;
  const Facing& facing;
  const Vec3* eye;  // only primitives that face it count; null: all
  double bound2;    // feet at this squared distance or farther do not count [m^2]
  float bound;      // its root [m]
  float lead;       // other primitives are found up to this much beyond the nearest [m]; 0: only the nearest
  double per_cell;  // cells of the grid along a metre
};

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

// Where the grid keeps the list of the cell that a place is in, or null. The place is relative to the corner of the grid,
// in cells.
static inline const uint32_t* word_at(const Store& s, double x, double y, double z) {
  if (!(s.cell > 0)) return nullptr;
  const double f[3] = {x, y, z};
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

// Distance of a place in the grid from the centre of its cell, rounded up. The place is as for `word_at`.
static inline float off_centre(const Store& s, double x, double y, double z) {
  double sum = 0;
  for (const double at : {x, y, z}) {
    const double d = at - (double)(int32_t)at - 0.5;
    sum += d * d;
  }
  return (float)(1.000001 * s.cell * std::sqrt(sum)) + s.slack;
}

constexpr float FAR = 3e38f;  // squared distance of what is not there
constexpr int STACK = 96;     // at most 10 levels of 8 children

// Whether only one lane of the nearest block may be the nearest, or none, -1.
static inline bool is_alone(const Facing& facing, uint32_t block, F8 lanes, float exact, float other, int32_t& lane) {
  const unsigned left = bits(lanes < f8(exact));
  if (other < exact || (left & (left - 1)) != 0) return false;
  lane = -1;
  if (left == 0) return true;
  if ((facing.sure[block] & left) == 0) return false;
  lane = (int32_t)(LANES * block) + lowest_bit(left);
  return true;
}

// What the blocks that were measured tell of one search.
struct Rank {
  float exact, limit;         // squared distances under which lanes are measured exactly, and looked at
  float counted;              // least squared distance of a lane that counts
  float first, other, third;  // least of the lanes that may count, by blocks
  uint32_t first_block, other_block;
  F8 first_lanes;  // squared distances in that block

  static float smaller(float a, float b) { return b < a ? b : a; }
  static float larger(float a, float b) { return a < b ? b : a; }

  // Takes in a block, without branches, which could not be predicted. Returns whether it is the first now; `first_lanes` must
  // then be set.
  bool add(uint32_t block, float nearest) {
    const bool is_first = nearest < first, is_other = nearest < other;
    third = smaller(third, larger(other, nearest)), other = smaller(other, larger(first, nearest)), first = smaller(first, nearest);
    other_block = is_first ? first_block : is_other ? block : other_block;
    first_block = is_first ? block : first_block;
    return is_first;
  }

  // A lane that counts is this near.
  void tighten(const Scope& o, float d2) {
    counted = smaller(counted, d2);
    const float d = std::sqrt(counted);
    exact = smaller(exact, lenient(o.s, d, 0.f)), limit = smaller(limit, lenient(o.s, d, o.lead));
  }

  // Whether only one lane may be the nearest, or none, -1: then the search is at its end.
  bool alone(const Facing& facing, int32_t& lane) const { return is_alone(facing, first_block, first_lanes, exact, other, lane); }
};

static inline Rank rank_of(const Scope& o) {
  return {lenient(o.s, o.bound, 0.f), lenient(o.s, o.bound, o.lead), FAR, FAR, FAR, FAR, NO_CHILD, NO_CHILD, f8(FAR)};
}

// The least squared distance below `most` of the lanes that face the eye, or `most`.
template <class Kind>
static float nearest_facing(const Scope& o, uint32_t block, F8 d, float most) {
  float d2[LANES];
  store8(d2, d);
  const unsigned sure = o.facing.sure[block];
  for (unsigned m = bits(d < f8(most)); m; m &= m - 1) {
    const int k = lowest_bit(m);
    if (d2[k] < most && ((sure >> k & 1) || Kind::faces(o.s, LANES * block + (uint32_t)k, *o.eye))) most = d2[k];
  }
  return most;
}

// The nearest of some lanes, measured in double precision.
template <class Kind>
class Exact {
 public:
  Exact(const Scope& o, const Query& q) : o_(o), q_(q), best_d2_(o.bound2) {}

  // The lanes of a block that are nearer than `limit` and face the eye.
  void take(uint32_t block, F8 d, float limit) {
    const unsigned sure = o_.facing.sure[block];
    for (unsigned left = bits(d < f8(limit)); left; left &= left - 1) {
      const int k = lowest_bit(left);
      const uint32_t lane = LANES * block + (uint32_t)k;
      if (!(sure >> k & 1) && !Kind::faces(o_.s, lane, *o_.eye)) continue;
      if (waiting_ == 4) measure();
      lanes_[waiting_++] = lane;
    }
  }

  // The nearest of those taken, -1: none. Whether its distance is below the bound is not always decided. `end`: no lanes
  // follow; one that is alone need not be measured.
  int32_t nearest(bool end) {
    if (end && waiting_ == 1 && lane_ < 0)
      lane_ = (int32_t)lanes_[0];
    else if (waiting_)
      measure();
    return lane_;
  }

 private:
  void measure() {
    for (int k = waiting_; k < 4; ++k) lanes_[k] = lanes_[0];
    const Four four = Kind::feet(o_.s, lanes_, {d4(q_.x), d4(q_.y), d4(q_.z)}, Ask::FOOT);
    double d2[4], height[4];
    store4(d2, four.d2), store4(height, four.height);
    for (int k = 0; k < waiting_; ++k)
      if (nearer(d2[k], height[k], lanes_[k])) lane_ = (int32_t)lanes_[k], best_d2_ = d2[k], best_height_ = height[k];
    waiting_ = 0;
  }

  // Of two at the same distance the one that faces the query more squarely wins, then the lower id.
  bool nearer(double d2, double height, uint32_t lane) const {
    if (lane_ < 0) return d2 < best_d2_;
    const double tie = Kind::tie(o_.s, best_d2_);
    if (d2 < best_d2_ - tie || d2 > best_d2_ + tie) return d2 < best_d2_ - tie;
    if (std::fabs(height - best_height_) > o_.s.tie) return height > best_height_;
    return o_.s.id[lane] < o_.s.id[(size_t)lane_];
  }

  const Scope& o_;
  const Query& q_;
  int32_t lane_ = -1;  // the best so far, with its squared distance and height
  double best_d2_, best_height_ = 0;
  uint32_t lanes_[4];
  int waiting_ = 0;
};

// Squared distance of a place from the box of a block; the place is relative to the model's centre, its last is not used.
static inline float to_box2(const Box& b, F4 at) {
  const F4 out = max4(max4(load4(b.lo) - at, at - load4(b.hi)), f4(0.f));
  return sum3(out * out);
}

// One entry of a cell's list: a block, and the least distance of the query from it, or less.
struct Entry {
  uint32_t block;
  float d;
};

constexpr int DISTANCE_SHIFT = 32 - DISTANCE_BITS;
static inline uint32_t list_length(const uint32_t* list) { return *list & (MOST_BLOCKS - 1); }
static inline Entry entry(const Store& s, uint32_t word, float radius) {
  return {word & (MOST_BLOCKS - 1), (float)(word >> DISTANCE_SHIFT) * s.step - radius};
}
static inline bool is_within(const Entry& e, float limit) { return !(e.d > 0.f && !(e.d * e.d < limit)); }

// All blocks nearer than this squared distance are in the list; negative: none need be. A block farther from every place of
// the cell than the band of the grid is in no list.
static inline float complete_below(const Store& s, const uint32_t* list, float radius) {
  const float band = (float)STEPS * s.step - cell_radius(s), known = std::min((float)(*list >> DISTANCE_SHIFT) * s.step - radius, band);
  return known > 0.f ? known * known : -1.f;
}

constexpr int MOST_WAITING = 8;  // blocks with lanes that may be the nearest

// One search, a block at a time. `SearchesOfStrip` does the same for many points at once.
template <class Kind>
class Search {
 public:
  Search(const Scope& scope, const Query& q)
      : o_(scope), s_(scope.s), q_(q),
        p_{(float)(q.x - s_.centre.x), (float)(q.y - s_.centre.y), (float)(q.z - s_.centre.z), 0.f},
        rank_(rank_of(scope)), found_(scope, q) {}

  // `list`: of the query's cell, or null. `seed`: a lane to begin with, -1 for none; it changes the time, never the
  // result. Returns the nearest lane.
  int32_t run(const uint32_t* list, int32_t seed) {
    if (!is_near()) return -1;
    const uint32_t first = seed < 0 ? NO_CHILD : (uint32_t)seed / LANES;
    if (seed >= 0) visit(first);
    if (!list || !in_list(list, first)) {
      // The tree comes to the same blocks again.
      rank_.first = rank_.other = rank_.third = FAR, rank_.first_lanes = f8(FAR), waiting_ = 0;
      in_tree();
    }
    int32_t lane;
    if (!measured_ && rank_.alone(o_.facing, lane)) return lane;
    return resolve(true);
  }

  const Rank& rank() const { return rank_; }

  // Blocks and nodes of the tree that were compared with the query: a measure of the work, the same on every machine.
  int64_t compared() const { return compared_; }

 private:
  // False for every query that is farther than the bound from the model's box, or not finite.
  bool is_near() const {
    const Vec3& c = s_.centre;
    const double sum = std::fabs(q_.x - c.x) + std::fabs(q_.y - c.y) + std::fabs(q_.z - c.z);
    return sum <= 2.0 * (s_.extent + (double)o_.bound + (double)o_.lead);
  }

  // Visits the blocks of the list. False where others may be nearer.
  bool in_list(const uint32_t* list, uint32_t seed) {
    const uint32_t n = list_length(list);
    const Vec3& low = s_.low;
    const float radius = off_centre(s_, (q_.x - low.x) * o_.per_cell, (q_.y - low.y) * o_.per_cell, (q_.z - low.z) * o_.per_cell);
    for (uint32_t k = 1; k <= n; ++k) {
      const Entry e = entry(s_, list[k], radius);
      if (!is_within(e, rank_.limit)) break;
      if (e.block != seed && o_.facing.may[e.block] && to_box2(s_.boxes[e.block], load4(p_)) < rank_.limit) visit(e.block);
    }
    return rank_.limit <= complete_below(s_, list, radius);
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
      if (!(t.d2 < rank_.limit)) continue;
      if (t.child & IS_BLOCK) {
        visit(t.child & ~IS_BLOCK);
        continue;
      }
      const Node& n = s_.nodes[t.child];
      ++compared_;
      const F8 d = box_distance2(n, q_);
      unsigned open = bits(d < f8(rank_.limit)) & o_.facing.alive[t.child];
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

  // Measures the lanes of a block in single precision; those that may be the nearest wait for `resolve`.
  void visit(uint32_t block) {
    ++compared_;
    F8 d = Kind::distance2(s_, block, q_);
    const unsigned may = o_.facing.may[block];
    if (may != 0xffu) d = select(expand(may), d, f8(FAR));
    const float nearest = least(d);
    rank_.first_lanes = select(expand(rank_.add(block, nearest) ? 0xffu : 0u), d, rank_.first_lanes);
    if (!(nearest < rank_.exact)) return;
    if (o_.facing.sure[block] == may)
      rank_.tighten(o_, nearest);
    else if (const float facing = nearest_facing<Kind>(o_, block, d, rank_.exact); facing < rank_.exact)
      rank_.tighten(o_, facing);
    if (waiting_ == MOST_WAITING) resolve(false);
    wait_block_[waiting_] = block, wait_[waiting_++] = d;
  }

  // Measures exactly what waits and may still be the nearest.
  int32_t resolve(bool end) {
    for (int i = 0; i < waiting_; ++i) found_.take(wait_block_[i], wait_[i], rank_.exact);
    waiting_ = 0;
    const int32_t lane = found_.nearest(end);
    measured_ = lane >= 0;
    return lane;
  }

  const Scope& o_;
  const Store& s_;
  const Query& q_;
  float p_[4];  // the query relative to the model's centre; the last is not used
  Rank rank_;
  Exact<Kind> found_;
  bool measured_ = false;  // a lane was measured exactly
  int waiting_ = 0;
  int64_t compared_ = 0;
  uint32_t wait_block_[MOST_WAITING];
  F8 wait_[MOST_WAITING];
};
