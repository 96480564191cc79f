// Memory of large arrays that are read at random: aligned to cache lines, and in huge pages where the system has them.
#pragma once
#include <cstddef>
#include <new>
#include <vector>
#if defined(__linux__)
#include <sys/mman.h>
#endif
#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace avs {

// Memory that is freed stays with the process, up to these sizes [B], which are those that the C library chooses by itself
// once a block of 32 MB is freed. Otherwise the arrays of each scan return to the system, which clears every page again for
// the next scan: 60 to 220 page faults and up to a seventh of the time of a registration.
inline void keep_freed_memory() {
#if defined(__GLIBC__)
  constexpr int LARGEST_KEPT = 32 << 20, MOST_KEPT = 64 << 20;
  ::mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT);
  ::mallopt(M_TRIM_THRESHOLD, MOST_KEPT);
#endif
}

template <class T>
struct Pages {
  using value_type = T;
  static constexpr std::size_t CACHE_LINE = 64, HUGE_PAGE = std::size_t{1} << 21, LARGE_ARRAY = HUGE_PAGE / 2;

  Pages() = default;
  template <class U>
  Pages(const Pages<U>&) {}

  static std::size_t alignment(std::size_t n) { return n * sizeof(T) < LARGE_ARRAY ? CACHE_LINE : HUGE_PAGE; }
  static std::size_t bytes(std::size_t n) { return (n * sizeof(T) + alignment(n) - 1) / alignment(n) * alignment(n); }

  T* allocate(std::size_t n) {
    void* p = ::operator new(bytes(n), std::align_val_t(alignment(n)));
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    if (alignment(n) == HUGE_PAGE) ::madvise(p, bytes(n), MADV_HUGEPAGE);
#endif
    return static_cast<T*>(p);
  }
  void deallocate(T* p, std::size_t n) { ::operator delete(p, std::align_val_t(alignment(n))); }

  friend bool operator==(const Pages&, const Pages&) { return true; }
  friend bool operator!=(const Pages&, const Pages&) { return false; }
};

template <class T>
using Many = std::vector<T, Pages<T>>;

}  // namespace avs
