#include "team.hpp"

#include <system_error>

#include "interrupt.hpp"

namespace avs {

Team::Team(int threads) {
  threads_.reserve(threads > 1 ? threads - 1 : 0);
  try {
    for (int k = 1; k < threads; ++k) threads_.emplace_back([this] { serve(); });
  } catch (const std::system_error&) {  // the system has no more: those that started do the work
  }
}

Team::~Team() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  wake_.notify_all();
  for (std::thread& t : threads_) t.join();
}

void Team::each(int64_t n, const std::function<void(int64_t)>& work) {
  if (threads_.empty() || n < 2) {
    for (int64_t k = 0; k < n; ++k) {
      if (Poll::ends()) throw Interrupted{};
      work(k);
    }
    return;
  }
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    work_ = &work, n_ = n, next_ = 0, ended_ = false, busy_ = (int)threads_.size(), ++round_;
  }
  wake_.notify_all();
  take(true);
  std::unique_lock<std::mutex> lock(mutex_);
  done_.wait(lock, [this] { return busy_ == 0; });
  if (ended_) throw Interrupted{};
}

void Team::serve() {
  uint64_t seen = 0;
  std::unique_lock<std::mutex> lock(mutex_);
  for (;;) {
    wake_.wait(lock, [&] { return stop_ || round_ != seen; });
    if (stop_) return;
    seen = round_;
    lock.unlock();
    take(false);
    lock.lock();
    if (--busy_ == 0) done_.notify_one();
  }
}

// Only the thread that called `each` asks whether the work is to end.
void Team::take(bool asks) {
  for (int64_t k; !ended_ && (k = next_.fetch_add(1)) < n_;) {
    (*work_)(k);
    if (asks && Poll::ends()) ended_ = true;
  }
}

}  // namespace avs
