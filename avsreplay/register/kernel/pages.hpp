// Memory of large arrays that are read at random: aligned to cache lines, and in huge pages where the system has them.
#pragma once
#include <cstddef>
#include <cstdint>
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

  static constexpr bool is_large(std::size_t n) { return n * sizeof(T) >= LARGE_ARRAY; }

  T* allocate(std::size_t n) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    if (is_large(n)) return static_cast<T*>(huge(whole(n, HUGE_PAGE)));
#endif
    return static_cast<T*>(::operator new(whole(n, CACHE_LINE), std::align_val_t(CACHE_LINE)));
  }
  void deallocate(T* p, std::size_t n) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    if (is_large(n)) return void(::munmap(p, whole(n, HUGE_PAGE)));
#endif
    ::operator delete(p, std::align_val_t(CACHE_LINE));
  }

 private:
  static std::size_t whole(std::size_t n, std::size_t unit) { return (n * sizeof(T) + unit - 1) / unit * unit; }

#if defined(__linux__) && defined(MADV_HUGEPAGE)
  // From the system and not from the memory that was freed before: pages that were used remain small.
  static void* huge(std::size_t size) {
    const std::size_t all = size + HUGE_PAGE;
    void* p = ::mmap(nullptr, all, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (p == MAP_FAILED) throw std::bad_alloc();
    char* first = static_cast<char*>(p);
    const std::size_t before = (HUGE_PAGE - reinterpret_cast<std::uintptr_t>(p) % HUGE_PAGE) % HUGE_PAGE;
    if (before) ::munmap(first, before);
    if (before < HUGE_PAGE) ::munmap(first + before + size, HUGE_PAGE - before);
    ::madvise(first + before, size, MADV_HUGEPAGE);
    return first + before;
  }
#endif

 public:
  friend bool operator==(const Pages&, const Pages&) { return true; }
  friend bool operator!=(const Pages&, const Pages&) { return false; }
};

template <class T>
using Many = std::vector<T, Pages<T>>;

}  // namespace avs
