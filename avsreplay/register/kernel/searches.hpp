// The searches of a strip. Included inside a namespace named after the instruction set.
//
// A search needs two blocks in the mean, and whether it needs another one follows from a long calculation. The processor
// guesses such a branch, and a wrong guess costs more than a block. The blocks of all points of a strip are therefore measured
// in sweeps without such branches: the first block of each point, then all blocks that may be nearer than the limit which
// this gives. The results are those of `Search`, which takes the few points that need the tree.

// What the searches of a chunk took.
struct Effort {
  int64_t ignored = 0;                 // points that are not finite
  int64_t searched = 0, compared = 0;  // searches made; blocks and nodes that were compared, also for kept neighbours
  int32_t last = -1;                   // the primitive of the last point
};

// A kept neighbour that no longer faces the eye is searched for again.
template <class Kind>
static inline bool is_kept(const Scope& o, Treat treat, int32_t lane) {
  if (treat <= SEARCHED) return false;
  if (!o.eye || lane < 0 || o.facing.sure[lane / LANES] >> lane % LANES & 1) return true;
  return Kind::faces(o.s, (uint32_t)lane, *o.eye);
}

template <class Kind>
class SearchesOfStrip {
 public:
  // `kept`: what is known of the points of the strip, or null; `remember`: where what is found is written, or null.
  SearchesOfStrip(const Scope& o, int n, const Kept* kept, Kept* remember, Strip& c)
      : o_(o), s_(o.s), n_(n), kept_(kept), remember_(remember), c_(c), begin_(rank_of(o)) {}

  // Finds the primitive of every point.
  void run(Effort& effort) {
    for (int i = 0; i < n_; ++i) plan(i);
    first_blocks();
    collect();
    other_blocks();
    effort.compared += jobs_ + many_ - STRIP;
    for (int k = 0; k < jobs_; ++k) close(k, effort);
    for (int p = 0; p < many_pending_; ++p) c_.lane[point_[pending_[p]]] = nearest_of(pending_[p]);
    if (alone_)
      one_by_one(effort);
    else if (jobs_)
      effort.last = c_.lane[point_[jobs_ - 1]];
    if (remember_) remember();
  }

 private:
  static constexpr int AHEAD = 4;  // blocks ahead of the one that is measured
  static_assert(STRIP <= 256 && LONGEST_LIST < 255, "numbers of points and of entries are bytes");
  enum Taken : uint8_t { KEPT_AS_IT_IS, IN_SWEEPS, ALONE };

  // The nearest three blocks of a job, see `ranked`; none_: there is none.
  struct Ranked {
    uint64_t first, other, third;
  };

  // A block to be measured for a job. The first block of a job has its number.
  struct Visit {
    uint32_t block;
    int32_t job;
  };

  Query query_of(int i) const { return query(s_, c_.c[0][i], c_.c[1][i], c_.c[2][i]); }
  int32_t own(int i) const { return kept_ ? kept_[i].lane : -1; }

  void add(int i, uint32_t first, uint8_t next) {
    Kind::prefetch_block(s_, first);
    taken_[i] = IN_SWEEPS;
    visit_[jobs_] = {first, jobs_};
    point_[jobs_] = (uint8_t)i, next_[jobs_++] = next;
  }

  // Decides where the search of a point begins.
  void plan(int i) {
    const int32_t lane = own(i);
    taken_[i] = KEPT_AS_IT_IS, c_.lane[i] = lane;
    if (c_.search[i] == IGNORED) {
      c_.lane[i] = -1;
    } else if (is_kept<Kind>(o_, c_.search[i], lane)) {
      if (c_.search[i] != KEPT && lane >= 0) add(i, (uint32_t)lane / LANES, 0);
    } else {
      c_.search[i] = SEARCHED;
      if (c_.list[i] && lane >= 0)
        add(i, (uint32_t)lane / LANES, 1);
      else if (!c_.list[i] || !begin_in_list(i))
        taken_[i] = ALONE, ++alone_;
    }
  }

  bool begin_in_list(int i) {
    const uint32_t *list = c_.list[i], n = list_length(list);
    const F4 at = load4(c_.at[i]);
    for (uint32_t k = 1; k <= n; ++k) {
      const Entry e = entry(s_, list[k], c_.off[i]);
      if (!is_within(e, begin_.limit)) return false;
      if (o_.facing.may[e.block] && to_box2(s_.boxes[e.block], at) < begin_.limit) return add(i, e.block, (uint8_t)(k + 1)), true;
    }
    return false;
  }

  // Measures a block for a point.
  void measure(int j) {
    const uint32_t block = visit_[j].block;
    const float* at = c_.at[point_[visit_[j].job]];
    const unsigned may = o_.facing.may[block];
    const F8 d = select(expand(may), Kind::distance2(s_, block, {0, 0, 0, f8(at[0]), f8(at[1]), f8(at[2])}), f8(FAR));
    d_[j] = d, nearest_[j] = least(d);
    uncertain_ |= may ^ o_.facing.sure[block];
  }

  // Least squared distance of a lane of a block that counts.
  float counted(int j) const {
    const uint32_t block = visit_[j].block;
    return o_.facing.sure[block] == o_.facing.may[block] ? nearest_[j] : nearest_facing<Kind>(o_, block, d_[j], FAR);
  }

  void first_blocks() {
    for (int k = 0; k < jobs_; ++k) {
      measure(k);
      counted_[k] = nearest_[k], ranked_[k] = {ranked(k), none_, none_};
    }
    if (uncertain_)
      for (int k = 0; k < jobs_; ++k) counted_[k] = counted(k);
    limits();
  }

  // See Rank::tighten.
  void limits() {
    const F8 exact = f8(begin_.exact), limit = f8(begin_.limit), far = f8(FAR), lead = f8(o_.lead), slack = f8(2.f * s_.slack);
    const auto lenient = [slack](F8 d, F8 more) {
      const F8 r = d + slack + more;
      return r * r * f8(1.00001f);
    };
    for (int k = 0; k < jobs_; k += LANES) {
      const F8 counted = load8(counted_ + k), d = sqrt8(select(counted < exact, counted, far));
      store8(exact_ + k, min8(lenient(d, f8(0.f)), exact)), store8(limit_ + k, min8(lenient(d, lead), limit));
    }
  }

  // The entries of the list of a job whose blocks may be nearer than the limit after the first block. Eight are written whatever
  // their number is.
  int entries(int k, int m) {
    const int i = point_[k];
    const uint32_t *list = c_.list[i], n = list_length(list);
    const F8 zero = f8(0.f), step = f8(s_.step), off = f8(c_.off[i]), limit = f8(limit_[k]);
    for (uint32_t l = next_[k]; l <= n; l += LANES) {
      const F8 d = high_bits8<DISTANCE_SHIFT>(list + l) * step - off;
      const unsigned within = bits(either(d * d < limit, d < zero));
      const int many = std::min(lowest_bit(~within), (int)(n + 1 - l));
      for (int j = 0; j < LANES; ++j) entry_[m + j] = {list[l + (uint32_t)j] & (MOST_BLOCKS - 1), k};
      m += many;
      if (many < LANES) break;
    }
    return m;
  }

  // All further blocks that may be nearer than the limit after the first block. Without branches, which could not be
  // predicted.
  void collect() {
    int m = 0;
    for (int k = 0; k < jobs_; ++k) {
      const int i = point_[k];
      if (c_.search[i] == IN_PAIR)
        entry_[m] = {kept_[i].other, k}, m += kept_[i].other != NO_CHILD;
      else if (c_.search[i] == SEARCHED)
        m = entries(k, m);
    }
    for (int j = 0; j < m; ++j) {
      if (j + 16 < m) fetch(s_.boxes.data() + entry_[j + 16].block);
      const Visit e = entry_[j];
      const int i = point_[e.job];
      const bool wanted = (o_.facing.may[e.block] != 0) & (e.block != visit_[e.job].block) & (to_box2(s_.boxes[e.block], load4(c_.at[i])) < limit_[e.job]);
      visit_[many_] = e, many_ += wanted | (c_.search[i] == IN_PAIR);
    }
  }

  // Without branches, which could not be predicted.
  void other_blocks() {
    for (int j = STRIP; j < many_ && j < STRIP + AHEAD; ++j) Kind::prefetch_block(s_, visit_[j].block);
    for (int j = STRIP; j < many_; ++j) {
      if (j + AHEAD < many_) Kind::prefetch_block(s_, visit_[j + AHEAD].block);
      measure(j);
    }
    Ranked r{};
    for (int j = STRIP, last = -1; j < many_; ++j) {
      const int k = visit_[j].job;
      const uint64_t next = ranked(j);
      r = k == last ? r : Ranked{ranked(k), none_, none_}, last = k;
      r = {std::min(r.first, next), std::min(r.other, std::max(r.first, next)), std::min(r.third, std::max(r.other, next))};
      ranked_[k] = r;
    }
    if (uncertain_)
      for (int j = STRIP; j < many_; ++j) counted_[visit_[j].job] = Rank::smaller(counted_[visit_[j].job], counted(j));
    for (int k = 0; k < jobs_; ++k) {
      first_[k] = distance_of(ranked_[k].first), other_[k] = distance_of(ranked_[k].other), third_[k] = distance_of(ranked_[k].third);
      if (!uncertain_) counted_[k] = first_[k];
    }
    limits();
  }

  // The squared distance of a block, which is not negative, and its visit in one number of the same order.
  static uint64_t ranked(float d2, int visit) {
    uint32_t bits;
    std::memcpy(&bits, &d2, sizeof bits);
    return (uint64_t)bits << 32 | (uint32_t)visit;
  }
  uint64_t ranked(int visit) const { return ranked(nearest_[visit], visit); }
  static int visit_of(uint64_t ranked) { return (int)(uint32_t)ranked; }
  static float distance_of(uint64_t ranked) {
    const uint32_t bits = (uint32_t)(ranked >> 32);
    float d2;
    std::memcpy(&d2, &bits, sizeof d2);
    return d2;
  }

  void close(int k, Effort& effort) {
    const int i = point_[k], first = visit_of(ranked_[k].first), other = visit_of(ranked_[k].other);
    const bool searched = c_.search[i] == SEARCHED;
    first_block_[k] = visit_[first].block, other_block_[k] = ranked_[k].other == none_ ? NO_CHILD : visit_[other].block, lanes_[k] = first;
    if (searched && !(limit_[k] <= complete_below(s_, c_.list[i], c_.off[i]))) {
      const auto [begin, end] = others(k);
      effort.compared -= 1 + end - begin;
      taken_[i] = ALONE, ++alone_;
      return;
    }
    effort.searched += searched;
    if (is_alone(o_.facing, first_block_[k], d_[first], exact_[k], other_[k], c_.lane[i])) return;
    for (unsigned left = bits(d_[first] < f8(exact_[k])); left; left &= left - 1)
      Kind::prefetch_exact(s_, LANES * first_block_[k] + (uint32_t)lowest_bit(left));
    pending_[many_pending_++] = (uint8_t)k;
  }

  // The visits of a job after its first one.
  std::pair<int, int> others(int k) const {
    const int first = visit_of(ranked_[k].first), other = visit_of(ranked_[k].other);
    int begin = first < STRIP ? other : first, end = begin;
    if (begin < STRIP) return {0, 0};
    while (begin > STRIP && visit_[begin - 1].job == k) --begin;
    while (end < many_ && visit_[end].job == k) ++end;
    return {begin, end};
  }

  // Measures exactly the lanes that may be the nearest.
  int32_t nearest_of(int k) const {
    const Query q = query_of(point_[k]);
    const float limit = exact_[k];
    Exact<Kind> found(o_, q);
    found.take(visit_[k].block, d_[k], limit);
    const auto [begin, end] = others(k);
    for (int j = begin; j < end; ++j)
      if (nearest_[j] < limit) found.take(visit_[j].block, d_[j], limit);
    return found.nearest(true);
  }

  // The points that need the tree, in the order of the scan.
  void one_by_one(Effort& effort) {
    int job[STRIP];
    std::fill(job, job + STRIP, -1);
    for (int k = 0; k < jobs_; ++k) job[point_[k]] = k;
    for (int i = 0; i < n_; ++i) {
      if (taken_[i] == KEPT_AS_IT_IS) continue;
      if (taken_[i] == ALONE) {
        const Query q = query_of(i);
        const int32_t lane = own(i);
        Search<Kind> search(o_, q);
        c_.lane[i] = search.run(c_.list[i], lane < 0 && !c_.list[i] ? effort.last : lane);
        effort.compared += search.compared(), ++effort.searched;
        const Rank& r = search.rank();
        const int k = job[i] < 0 ? jobs_++ : job[i];
        point_[k] = (uint8_t)i, first_[k] = r.first, other_[k] = r.other, third_[k] = r.third, counted_[k] = r.counted, limit_[k] = r.limit;
        first_block_[k] = r.first_block, other_block_[k] = r.other_block, d_[k] = r.first_lanes, lanes_[k] = k;
      }
      effort.last = c_.lane[i];
    }
  }

  // How far each query may move before another primitive (`lane`), one of another block (`block`), or one that is neither in
  // the lane's block nor in the second nearest (`pair`) can be the nearest, or one come within the bound: half of how much
  // farther than the nearest these are. An eye that stays within the margin of `Facing` makes no difference. Where only the
  // blocks that were known are measured, what is left of the room that was known holds for all others.
  void remember() {
    for (int k = 0; k < jobs_; ++k) ask(k);
    for (int k = 0; k < jobs_; k += LANES) rooms(k);
    for (int k = 0; k < jobs_; ++k) write(k);
  }

  // What the rooms of a job depend on; 1 for true.
  struct Asked {
    alignas(32) float none[STRIP], own[STRIP], own_or_other[STRIP];  // there is no nearest lane; it is in the nearest block
    alignas(32) float searched[STRIP], measured[STRIP];              // all blocks were searched; a second one was measured
    alignas(32) float second[STRIP];                                 // least of the other lanes of the nearest block
    alignas(32) float block2[STRIP], pair2[STRIP], moved2[STRIP];    // known before, and the way since then
  };

  void ask(int k) {
    const int i = point_[k];
    const int32_t lane = c_.lane[i];
    const uint32_t block = (uint32_t)lane / LANES;
    const bool own = lane >= 0 && block == first_block_[k], searched = c_.search[i] == SEARCHED;
    const F8 others = select(expand(0xffu & ~(1u << (uint32_t)lane % LANES)), d_[lanes_[k]], f8(FAR));
    const Kept& was = remember_[i];
    const double x = c_.c[0][i] - was.x, y = c_.c[1][i] - was.y, z = c_.c[2][i] - was.z;
    asked_.none[k] = lane < 0, asked_.own[k] = own, asked_.own_or_other[k] = own || (lane >= 0 && block == other_block_[k]);
    asked_.searched[k] = searched, asked_.measured[k] = other_block_[k] != NO_CHILD, asked_.second[k] = least(others);
    asked_.block2[k] = was.block2, asked_.pair2[k] = was.pair2, asked_.moved2[k] = (float)(x * x + y * y + z * z);
  }

  // Squares of the rooms, with room for rounding; negative where one is not positive.
  void rooms(int k) {
    const F8 zero = f8(0.f), margin = f8(3.f * s_.slack);
    const auto at = [k](const float* x) { return load8(x + k); };
    const auto is = [&](const float* x) { return zero < at(x); };
    const auto half = [&](F8 nearest, F8 next) { return f8(0.5f) * (next - nearest) - margin; };
    const F8 first = sqrt8(at(first_)), other = sqrt8(at(other_)), limit = sqrt8(at(limit_)), moved = f8(1.0001f) * sqrt8(at(asked_.moved2));
    const auto left = [&](F8 room2) { return select(zero < room2, sqrt8(max8(room2, zero)) - moved, zero); };
    const F8::Mask counted = at(first_) < at(counted_), own = both(is(asked_.own), at(counted_) < f8(FAR));
    const auto nearest = [&](F8 room) { return select(counted, zero, select(own, room, zero)); };
    // Of a search.
    const F8 gap = min8(first, limit) - f8(o_.bound) - margin;
    const F8 pair = select(is(asked_.own_or_other), half(sqrt8(at(counted_)), min8(sqrt8(at(third_)), limit)), zero);
    const F8 block = nearest(half(first, min8(other, limit)));
    // Of the blocks that were known.
    const F8 old_pair = left(at(asked_.pair2)), old_block = select(is(asked_.measured), nearest(min8(old_pair, half(first, other))), left(at(asked_.block2)));
    const F8::Mask none = is(asked_.none), searched = is(asked_.searched);
    const F8 all_pair = select(searched, pair, old_pair), all_block = select(searched, block, old_block);
    const F8 lane = select(at(asked_.second) < at(first_), zero, nearest(min8(all_block, half(first, sqrt8(at(asked_.second))))));
    const auto put = [&](float* to, F8 room) {
      if (!(o_.lead > 0.f)) room = select(searched, zero, room);
      store8(to + k, select(zero < room, room * room * f8(0.9999f), f8(-1.f)));
    };
    put(room_[0], select(none, gap, lane)), put(room_[1], select(none, gap, all_block)), put(room_[2], select(none, gap, all_pair));
  }

  void write(int k) {
    const int i = point_[k];
    const int32_t lane = c_.lane[i];
    const bool searched = c_.search[i] == SEARCHED;
    if (lane < 0 && !searched) return;
    const bool is_known = searched ? asked_.own_or_other[k] > 0 && o_.lead > 0.f : other_block_[k] != NO_CHILD;
    const uint32_t other = asked_.own[k] > 0 ? other_block_[k] : first_block_[k], old = searched ? NO_CHILD : remember_[i].other;
    remember_[i] = {c_.c[0][i], c_.c[1][i], c_.c[2][i], room_[0][k], room_[1][k], room_[2][k], lane, is_known ? other : old};
  }

  const Scope& o_;
  const Store& s_;
  const int n_;
  const Kept* kept_;
  Kept* remember_;
  Strip& c_;
  const Rank begin_;
  const uint64_t none_ = ranked(FAR, 0);
  int jobs_ = 0, many_ = STRIP, alone_ = 0;
  int many_pending_ = 0;
  uint8_t pending_[STRIP];  // jobs with lanes that must be measured exactly
  unsigned uncertain_ = 0;  // not zero: whether some lanes face the eye is not known
  uint8_t taken_[STRIP];  // how the primitive of a point is found
  // Of each job: its point, the entry of the list with which its further blocks begin, and as in Rank.
  uint8_t point_[STRIP], next_[STRIP];
  int32_t lanes_[STRIP];  // lanes: where in d_ those of the first are
  uint32_t first_block_[STRIP], other_block_[STRIP];
  alignas(32) float first_[STRIP], other_[STRIP], third_[STRIP], counted_[STRIP], exact_[STRIP], limit_[STRIP], room_[3][STRIP];
  Ranked ranked_[STRIP];
  Asked asked_;
  // The blocks, the others after the first STRIP, with their lanes' squared distances and the least of these.
  static constexpr int MOST_VISITS = STRIP * (1 + LONGEST_LIST) + 1;
  Visit visit_[MOST_VISITS], entry_[STRIP * LONGEST_LIST + LANES];
  float nearest_[MOST_VISITS];
  F8 d_[MOST_VISITS];
};
