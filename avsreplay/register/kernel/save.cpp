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
  void put(const std::vector<T>& values) {
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
  void get(std::vector<T>& values) {
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
  field(s.reach), field(s.extent), field(s.centre), field(s.slack), field(s.tie), field(s.tie2), field(s.blocks);
  field(s.id), field(s.points), field(s.triangles), field(s.normals), field(s.point_blocks), field(s.triangle_blocks);
  field(s.nodes), field(s.low), field(s.cell), field(s.size), field(s.top), field(s.bricks), field(s.lists);
}

bool sound_sizes(const Store& s, int64_t primitives, int64_t ids) {
  const size_t lanes = (size_t)LANES * s.blocks, n = (size_t)primitives;
  if (s.blocks == 0 || s.blocks != (n + LANES - 1) / LANES) return false;
  if (s.id.size() != lanes || s.normals.size() != lanes || s.nodes.size() != 2 * (size_t)s.blocks - 1) return false;
  if ((s.mesh ? s.triangles.size() : s.points.size()) != lanes) return false;
  if ((s.mesh ? s.triangle_blocks.size() : s.point_blocks.size()) != s.blocks) return false;
  for (int32_t id : s.id)
    if (id < 0 || id >= ids) return false;
  constexpr int32_t longest = 1 << 20;
  size_t words = 1;
  for (int32_t k : s.size) {
    if (k < 1 || k > longest) return false;
    words *= (size_t)k;
  }
  return s.top.size() == words && s.bricks.size() % 64 == 0 && !s.lists.empty();
}

bool sound_list(const Store& s, uint32_t start) {
  if (start >= s.lists.size()) return false;
  const uint32_t n = s.lists[start];
  if (n == TOO_MANY) return true;
  if (n == 0 || n > (uint32_t)LONGEST_LIST || n > s.lists.size() - start - 1) return false;
  for (uint32_t k = 1; k <= n; ++k)
    if (s.lists[start + k] >= s.blocks) return false;
  return true;
}

// A word and all below it; a brick may hold bricks for LEVELS levels only.
bool sound_word(const Store& s, uint32_t word, int level) {
  if (word == EMPTY) return true;
  if (!(word & IS_BRICK)) return sound_list(s, word);
  const size_t brick = word & ~IS_BRICK;
  if (level == LEVELS || brick >= s.bricks.size() / 64) return false;
  for (size_t k = 0; k < 64; ++k)
    if (!sound_word(s, s.bricks[64 * brick + k], level + 1)) return false;
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
  for (uint32_t word : s.top)
    if (!sound_word(s, word, 0)) return false;
  return true;
}

}  // namespace avs
