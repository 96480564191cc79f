// A few threads that share numbered work. The results do not depend on which thread does which number.
#pragma once
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace avs {

class Team {
 public:
  explicit Team(int threads);
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  // Calls work(k) once for each k in [0, n); returns when all are done. `work` must not throw. Throws Interrupted, without
  // the rest of the work, where it is to end.
  void each(int64_t n, const std::function<void(int64_t)>& work);

 private:
  void serve();
  void take(bool asks);

  std::vector<std::thread> threads_;
  std::mutex mutex_;
  std::condition_variable wake_, done_;
  std::atomic<int64_t> next_{0};
  std::atomic<bool> ended_{false};
  const std::function<void(int64_t)>* work_ = nullptr;
  int64_t n_ = 0;
  uint64_t round_ = 0;
  int busy_ = 0;
  bool stop_ = false;
};

}  // namespace avs
