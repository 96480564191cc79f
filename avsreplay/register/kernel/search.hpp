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

// Distance of a place in the grid from the centre of its cell, rounded up.
static inline float off_centre(const Store& s, const Query& q, double per_cell) {
  const double f[3] = {(q.x - s.low.x) * per_cell, (q.y - s.low.y) * per_cell, (q.z - s.low.z) * per_cell};
  double sum = 0;
  for (const double x : f) {
    const double d = x - (double)(int32_t)x - 0.5;
    sum += d * d;
  }
  return (float)(1.000001 * s.cell * std::sqrt(sum)) + s.slack;
}

constexpr int STACK = 96;  // at most 10 levels of 8 children

// One search.
template <class Kind>
class Search {
 public:
  Search(const Scope& scope, const Query& q)
      : o_(scope), s_(scope.s), q_(q), best_d2_(scope.bound2),
        p_{(float)(q.x - s_.centre.x), (float)(q.y - s_.centre.y), (float)(q.z - s_.centre.z), 0.f},
        exact_(lenient(s_, scope.bound, 0.f)), limit_(lenient(s_, scope.bound, scope.lead)) {}

  // `list`: of the query's cell, or null. `seed`: a lane to begin with, -1 for none; it changes the time, never the
  // result.
  void run(const uint32_t* list, int32_t seed) {
    if (!is_near()) return;
    const uint32_t first = seed < 0 ? NO_CHILD : (uint32_t)seed / LANES;
    if (seed >= 0) visit(first);
    if (!list || !in_list(list, first)) {
      first_ = other_ = third_ = FAR, first_lanes_ = f8(FAR), waiting_ = 0;  // the tree comes to the same blocks again
      in_tree();
    }
    resolve(true);
  }

  // Only these blocks; `other` may be NO_CHILD. Where one holds the nearest lane, this finds it.
  void run_blocks(uint32_t block, uint32_t other) {
    visit(block);
    if (other != NO_CHILD) visit(other);
    resolve(true);
  }

  // The nearest, -1: none. Whether its distance is below the bound is not always decided yet.
  int32_t lane() const { return lane_; }

  // Blocks and nodes of the tree that were compared with the query: a measure of the work, the same on every machine.
  int64_t compared() const { return compared_; }

  // How far the query may move before another primitive (`lane`), one of another block (`block`), or one that is neither in
  // the lane's block nor in `other` (`pair`) can be the nearest, or one come within the bound: half of how much farther than
  // the nearest these are. An eye that stays within the margin of `Facing` makes no difference.
  struct Room {
    float lane, block, pair;
    uint32_t other;
  };
  Room room() const {
    const float first = std::sqrt(first_), known = std::sqrt(limit_);
    if (lane_ < 0) {
      const float gap = (first < known ? first : known) - o_.bound - 3.f * s_.slack;
      return {gap, gap, gap, NO_CHILD};
    }
    Room room{0.f, 0.f, 0.f, NO_CHILD};
    const uint32_t own = (uint32_t)lane_ / LANES;
    if (own == first_block_ || own == other_block_) {
      room.pair = half(std::sqrt(least_), std::min(std::sqrt(third_), known));
      room.other = own == first_block_ ? other_block_ : first_block_;
    }
    if (first_ < least_ || own != first_block_) return room;
    room.block = half(first, std::min(std::sqrt(other_), known));
    room.lane = in_block(room.block);
    return room;
  }

  // The same after `run_blocks` of the lane's block and `was.other`, or of the former alone. `was`: what is left of the room
  // that was known; there must be a lane.
  Room room_left(const Room& was) const {
    Room room = was;
    room.lane = 0.f;
    const uint32_t own = (uint32_t)lane_ / LANES;
    const bool nearest = !(first_ < least_) && own == first_block_;
    if (other_block_ != NO_CHILD) {
      room.block = nearest ? std::min(was.pair, half(std::sqrt(first_), std::sqrt(other_))) : 0.f;
      room.other = own == first_block_ ? other_block_ : first_block_;
    }
    if (nearest) room.lane = in_block(room.block);
    return room;
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
    const float radius = off_centre(s_, q_, o_.per_cell);
    for (uint32_t k = 1; k <= n; ++k) {
      const float d = (float)(list[k] >> shift) * s_.step - radius;
      if (d > 0.f && !(d * d < limit_)) break;
      const uint32_t block = list[k] & (MOST_BLOCKS - 1);
      if (block != seed && o_.facing.may[block] && to_box2(s_.boxes[block]) < limit_) visit(block);
    }
    // A block farther from every place of the cell than the band of the grid is in no list.
    const float band = (float)STEPS * s_.step - cell_radius(s_), known = std::min((float)(*list >> shift) * s_.step - radius, band);
    return known > 0.f && limit_ <= known * known;
  }

  float to_box2(const Box& b) const {
    const F4 p = load4(p_), out = max4(max4(load4(b.lo) - p, p - load4(b.hi)), f4(0.f));
    return sum3(out * out);
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
      ++compared_;
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

  // Measures the lanes of a block in single precision; those that may be the nearest wait for `resolve`.
  void visit(uint32_t block) {
    ++compared_;
    F8 d = Kind::distance2(s_, block, q_);
    const unsigned may = o_.facing.may[block], sure = o_.facing.sure[block];
    if (may != 0xffu) d = select(expand(may), d, f8(FAR));
    const float nearest = least(d);
    // Without branches, which could not be predicted.
    const bool is_first = nearest < first_, is_other = nearest < other_;
    third_ = smaller(third_, larger(other_, nearest)), other_ = smaller(other_, larger(first_, nearest)), first_ = smaller(first_, nearest);
    other_block_ = is_first ? first_block_ : is_other ? block : other_block_;
    first_block_ = is_first ? block : first_block_;
    first_lanes_ = select(expand(is_first ? 0xffu : 0u), d, first_lanes_);
    if (!(nearest < exact_)) return;
    if (sure == may)
      tighten(nearest);
    else
      tighten_to_facing(block, d, sure);
    if (waiting_ == MOST_WAITING) resolve(false);
    wait_block_[waiting_] = block, wait_[waiting_++] = d;
  }

  void tighten_to_facing(uint32_t block, F8 d, unsigned sure) {
    float d2[LANES];
    store8(d2, d);
    for (unsigned m = bits(d < f8(exact_)); m; m &= m - 1) {
      const int k = lowest_bit(m);
      if (d2[k] < least_ && ((sure >> k & 1) || Kind::faces(s_, LANES * block + (uint32_t)k, *o_.eye))) tighten(d2[k]);
    }
  }

  // Whether only one lane may be the nearest, or none: then the search is at its end.
  bool is_alone() {
    const unsigned left = bits(first_lanes_ < f8(exact_));
    if (other_ < exact_ || (left & (left - 1)) != 0) return false;
    if (left == 0) return true;
    if ((o_.facing.sure[first_block_] & left) == 0) return false;
    lane_ = (int32_t)(LANES * first_block_) + lowest_bit(left);
    return true;
  }

  // Measures exactly what waits and may still be the nearest. What is alone at the end need not be measured.
  void resolve(bool end) {
    if (end && lane_ < 0 && is_alone()) return;
    uint32_t lanes[4];
    int n = 0;
    for (int i = 0; i < waiting_; ++i) {
      const unsigned sure = o_.facing.sure[wait_block_[i]];
      for (unsigned left = bits(wait_[i] < f8(exact_)); left; left &= left - 1) {
        const int k = lowest_bit(left);
        const uint32_t lane = LANES * wait_block_[i] + (uint32_t)k;
        if (!(sure >> k & 1) && !Kind::faces(s_, lane, *o_.eye)) continue;
        if (n == 4) measure(lanes, n), n = 0;
        lanes[n++] = lane;
      }
    }
    waiting_ = 0;
    if (end && n == 1 && lane_ < 0)
      lane_ = (int32_t)lanes[0];
    else if (n)
      measure(lanes, n);
  }

  void measure(uint32_t (&lanes)[4], int n) {
    for (int k = n; k < 4; ++k) lanes[k] = lanes[0];
    const Four four = Kind::feet(s_, lanes, {d4(q_.x), d4(q_.y), d4(q_.z)}, Ask::FOOT);
    double d2[4], height[4];
    store4(d2, four.d2), store4(height, four.height);
    for (int k = 0; k < n; ++k)
      if (nearer(d2[k], height[k], lanes[k])) lane_ = (int32_t)lanes[k], best_d2_ = d2[k], best_height_ = height[k];
  }

  // Of two at the same distance the one that faces the query more squarely wins, then the lower id.
  bool nearer(double d2, double height, uint32_t lane) const {
    if (lane_ < 0) return d2 < best_d2_;
    const double tie = Kind::tie(s_, best_d2_);
    if (d2 < best_d2_ - tie || d2 > best_d2_ + tie) return d2 < best_d2_ - tie;
    if (std::fabs(height - best_height_) > s_.tie) return height > best_height_;
    return s_.id[lane] < s_.id[(size_t)lane_];
  }

  void tighten(float d2) {
    if (!(d2 < least_)) return;
    least_ = d2;
    const float d = std::sqrt(d2), exact = lenient(s_, d, 0.f), limit = lenient(s_, d, o_.lead);
    exact_ = exact < exact_ ? exact : exact_, limit_ = limit < limit_ ? limit : limit_;
  }

  // The room of the lane in its block, which has this room.
  float in_block(float block) const {
    const float second = least(select(expand(0xffu & ~(1u << lane_ % LANES)), first_lanes_, f8(FAR)));
    return second < first_ ? 0.f : std::min(block, half(std::sqrt(first_), std::sqrt(second)));
  }

  float half(float nearest, float next) const { return 0.5f * (next - nearest) - 3.f * s_.slack; }

  static float smaller(float a, float b) { return b < a ? b : a; }
  static float larger(float a, float b) { return a < b ? b : a; }

  static constexpr float FAR = 3e38f;
  static constexpr int MOST_WAITING = 8;
  const Scope& o_;
  const Store& s_;
  const Query& q_;
  int32_t lane_ = -1;                     // the best so far, with its exact squared distance and height
  double best_d2_, best_height_ = 0;
  float p_[4];  // the query relative to the model's centre; the last is not used
  float exact_, limit_;  // squared distances under which lanes are measured exactly, and looked at
  float least_ = FAR;   // least squared distance of a lane that counts
  float first_ = FAR, other_ = FAR, third_ = FAR;  // least of the lanes that may count, by blocks
  uint32_t first_block_ = NO_CHILD, other_block_ = NO_CHILD;
  F8 first_lanes_ = f8(FAR);  // squared distances in that block
  int waiting_ = 0;
  int64_t compared_ = 0;
  uint32_t wait_block_[MOST_WAITING];
  F8 wait_[MOST_WAITING];
};
