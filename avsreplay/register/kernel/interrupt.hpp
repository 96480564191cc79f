// The end of long work on request. The work asks between its parts, so that it ends at one of them.
#pragma once
#include <atomic>
#include <cstdint>

namespace avs {

// Thrown by work that ends early; the caller raises KeyboardInterrupt.
struct Interrupted {};

inline std::atomic<bool> stop_requested{false};
inline thread_local bool shielded = false;  // this thread finishes its work in any case
// Handles the signals that have arrived, where this thread does that; whether one ends the work. Set by the bindings.
inline bool (*handle_signals)() = nullptr;

class Poll {
 public:
  // After one more part of the work, of about 512 searches: whether it is to end.
  static bool ends() {
    thread_local int parts = 0;
    if (shielded) return false;
    if (stop_requested.load(std::memory_order_relaxed)) return true;
    if (++parts < PARTS || handle_signals == nullptr) return false;
    parts = 0;
    return handle_signals();
  }

 private:
  static constexpr int PARTS = 64;  // between two looks at the signals, about 20 ms
};

// Before item k of numbered work of one thread, of which `each` make one part: throws Interrupted where the work is to end.
inline void poll(int64_t k, int64_t each = 512) {
  if (k % each == 0 && Poll::ends()) throw Interrupted{};
}

}  // namespace avs
