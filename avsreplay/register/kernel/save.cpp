#include "save.hpp"

#include <cstring>

namespace avs {
namespace {

class Writer {
 public:
  template <class T>
  void put(const T& value) {
    bytes_.append(reinterpret_cast<const char*>(&value), sizeof value);
  }
  template <class T>
  void put(const Many<T>& values) {
    put((uint64_t)values.size());
    bytes_.append(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
  }
  std::string take() { return std::move(bytes_); }

 private:
  std::string bytes_;
};

class Reader {
 public:
  Reader(const char* data, size_t size) : at_(data), left_(size) {}

  template <class T>
  void get(T& value) {
    copy(&value, sizeof value);
  }
  template <class T>
  void get(Many<T>& values) {
    uint64_t n = 0;
    get(n);
    if (!good_ || n > left_ / sizeof(T)) {
      good_ = false;
      return;
    }
    values.resize((size_t)n);
    copy(values.data(), (size_t)n * sizeof(T));
  }
  bool done() const { return good_ && left_ == 0; }

 private:
  void copy(void* to, size_t size) {
    good_ = good_ && size <= left_;
    if (!good_ || size == 0) return;
    std::memcpy(to, at_, size);
    at_ += size, left_ -= size;
  }

  const char* at_;
  size_t left_;
  bool good_ = true;
};

template <class Stream, class S>
void each_field(S& s, Stream&& field) {
  field(s.reach), field(s.extent), field(s.centre), field(s.slack), field(s.tie), field(s.tie2), field(s.grain);
  field(s.blocks), field(s.last_valid), field(s.id), field(s.points), field(s.triangles), field(s.normals);
  field(s.point_blocks), field(s.triangle_blocks), field(s.boxes), field(s.nodes), field(s.sides);
  field(s.low), field(s.cell), field(s.step), field(s.size), field(s.top), field(s.bricks), field(s.lists);
}

bool sound_sizes(const Store& s, int64_t primitives, int64_t ids) {
  const size_t lanes = (size_t)LANES * s.blocks, n = (size_t)primitives;
  if (s.blocks == 0 || s.blocks != (n + LANES - 1) / LANES) return false;
  if (s.last_valid != (uint8_t)(0xff >> (lanes - n))) return false;
  if (s.id.size() != lanes || s.normals.size() != (s.mesh ? 0 : lanes)) return false;
  if ((s.mesh ? s.triangles.size() : s.points.size()) != lanes) return false;
  if ((s.mesh ? s.triangle_blocks.size() : s.point_blocks.size()) != s.blocks) return false;
  if (s.boxes.size() != s.blocks) return false;
  if (s.sides.size() != (s.mesh ? s.nodes.size() : 0)) return false;
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
  if (n > (uint32_t)LONGEST_LIST || n > s.lists.size() - start - 1) return false;
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

bool restore(const char* data, size_t size, int64_t primitives, int64_t ids, bool mesh, Store& s) {
  Reader r(data, size);
  each_field(s, [&](auto& value) { r.get(value); });
  s.mesh = mesh;
  if (!r.done() || !sound_sizes(s, primitives, ids)) return false;
  uint32_t nodes = 0;
  return sound_tree(s, 0, s.blocks, nodes) && nodes == s.nodes.size() && sound_grid(s);
}

}  // namespace avs
