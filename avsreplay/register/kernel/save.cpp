#include "save.hpp"

#include <algorithm>
#include <cstring>

namespace avs {
namespace {

constexpr size_t ALIGNED = 64;  // arrays begin at multiples of this

class Writer {
 public:
  template <class T>
  void put(const T& value) {
    bytes_.append(reinterpret_cast<const char*>(&value), sizeof value);
  }
  template <class T>
  void put(const Many<T>& values) {
    put((uint64_t)values.size());
    bytes_.append((ALIGNED - bytes_.size() % ALIGNED) % ALIGNED, '\0');
    bytes_.append(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
  }
  std::string take() { return std::move(bytes_); }

 private:
  std::string bytes_;
};

class Reader {
 public:
  Reader(const char* data, size_t size) : begin_(data), at_(data), left_(size) {}

  template <class T>
  void get(T& value) {
    copy(&value, sizeof value);
  }
  template <class T>
  void get(Many<T>& values) {
    uint64_t n = 0;
    get(n);
    const size_t gap = (ALIGNED - (size_t)(at_ - begin_) % ALIGNED) % ALIGNED;
    good_ = good_ && gap <= left_;
    if (good_) at_ += gap, left_ -= gap;
    if (!good_ || n > left_ / sizeof(T)) {
      good_ = false;
      return;
    }
    const size_t size = (size_t)n * sizeof(T);
    if (reinterpret_cast<uintptr_t>(at_) % alignof(T) == 0) {
      const T* first = reinterpret_cast<const T*>(at_);  // every bit pattern is a number of these types
      values.assign(first, first + n);
      at_ += size, left_ -= size;
    } else {
      values.resize((size_t)n);
      copy(values.data(), size);
    }
  }
  bool done() const { return good_ && left_ == 0; }

 private:
  void copy(void* to, size_t size) {
    good_ = good_ && size <= left_;
    if (!good_ || size == 0) return;
    std::memcpy(to, at_, size);
    at_ += size, left_ -= size;
  }

  const char *begin_, *at_;
  size_t left_;
  bool good_ = true;
};

template <class Stream, class S>
void each_field(S& s, Stream&& field) {
  field(s.reach), field(s.extent), field(s.centre), field(s.slack), field(s.tie), field(s.tie2), field(s.grain);
  field(s.blocks), field(s.last_valid), field(s.id), field(s.points), field(s.triangles), field(s.normals);
  field(s.point_blocks), field(s.triangle_blocks), field(s.boxes), field(s.nodes), field(s.sides), field(s.clear);
  field(s.low), field(s.cell), field(s.step), field(s.size), field(s.top), field(s.bricks), field(s.lists);
}

bool sound_sizes(const Store& s, int64_t ids) {
  const size_t lanes = (size_t)LANES * s.blocks;
  if (s.blocks == 0 || s.last_valid == 0 || (s.last_valid & (s.last_valid + 1))) return false;
  if (s.id.size() != lanes || s.normals.size() != (s.mesh ? 0 : lanes)) return false;
  if ((s.mesh ? s.triangles.size() : s.points.size()) != lanes) return false;
  if ((s.mesh ? s.triangle_blocks.size() : s.point_blocks.size()) != s.blocks) return false;
  if (s.boxes.size() != s.blocks) return false;
  if (s.sides.size() != (s.mesh ? s.nodes.size() : 0)) return false;
  if (s.clear.size() != (s.mesh ? lanes : 0)) return false;
  for (uint32_t levels : s.clear)
    for (int shift = 0; shift < 32; shift += 4)
      if ((levels >> shift & 15) > (shift < 20 ? (uint32_t)CLEAR_LEVELS : 0u)) return false;
  for (int32_t id : s.id)
    if (id < 0 || id >= ids) return false;
  return true;
}

// The tree over the blocks [first, last) in the one order that build gives it; `node` is the next number to come.
bool sound_tree(const Store& s, uint32_t first, uint32_t last, uint32_t& node) {
  const uint32_t at = node++, capacity = child_capacity(last - first);
  if (at >= s.nodes.size()) return false;
  for (uint32_t child : s.nodes[at].child) {
    const uint32_t end = last - first > capacity ? first + capacity : last;
    if (first == last) {
      if (child != NO_CHILD) return false;
    } else if (end - first == 1) {
      if (child != (first | IS_BLOCK)) return false;
    } else if (child != node || !sound_tree(s, first, end, node)) {
      return false;
    }
    first = end;
  }
  return first == last;
}

bool sound_list(const Store& s, uint32_t start) {
  if (start == 0) return true;
  if (start >= s.lists.size()) return false;
  const uint32_t n = s.lists[start] & (MOST_BLOCKS - 1);
  if (n > (uint32_t)LONGEST_LIST || n + LANES > s.lists.size() - start - 1) return false;
  for (uint32_t k = 1; k <= n; ++k)
    if ((s.lists[start + k] & (MOST_BLOCKS - 1)) >= s.blocks) return false;
  return true;
}

bool sound_grid(const Store& s) {
  if (!(s.cell > 0)) return s.top.empty() && s.bricks.empty() && s.lists.empty();
  constexpr int32_t longest = 1 << 10;
  size_t words = 1;
  for (int32_t k : s.size) {
    if (k < 1 || k > longest) return false;
    words *= (size_t)k;
  }
  if (s.top.size() != words || s.bricks.size() % WORDS != 0) return false;
  for (uint32_t w : s.top)
    if (w > s.bricks.size() / WORDS) return false;
  for (uint32_t w : s.bricks)
    if (!sound_list(s, w)) return false;
  return true;
}

}  // namespace

std::string save(const Store& s) {
  Writer w;
  each_field(s, [&](const auto& value) { w.put(value); });
  return w.take();
}

uint64_t checksum(const char* data, size_t size) {
  constexpr uint64_t factor = 0x9e3779b97f4a7c15u;  // odd: each step is invertible, so no single change is lost
  uint64_t lane[4] = {1, 2, 3, size}, word;
  const auto step = [&](uint64_t& to) { to = (to ^ word) * factor, to ^= to >> 29; };
  size_t k = 0;
  for (; k + 32 <= size; k += 32)
    for (int i = 0; i < 4; ++i) std::memcpy(&word, data + k + 8 * i, 8), step(lane[i]);
  for (; k < size; k += 8) word = 0, std::memcpy(&word, data + k, std::min(size - k, (size_t)8)), step(lane[k / 8 % 4]);
  for (int i = 1; i < 4; ++i) word = lane[i], step(lane[0]);
  return lane[0];
}

bool restore(const char* data, size_t size, int64_t ids, bool mesh, Store& s) {
  Reader r(data, size);
  each_field(s, [&](auto& value) { r.get(value); });
  s.mesh = mesh;
  if (!r.done() || !sound_sizes(s, ids)) return false;
  uint32_t nodes = 0;
  return sound_tree(s, 0, s.blocks, nodes) && nodes == s.nodes.size() && sound_grid(s);
}

}  // namespace avs
