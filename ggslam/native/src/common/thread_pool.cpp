// SPDX-License-Identifier: Apache-2.0
#include "common/thread_pool.hpp"

#include <algorithm>
#include <utility>

namespace ggslam {
namespace {
inline void cpu_relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  __asm__ __volatile__("yield");
#endif
}
// Kernels follow one another within microseconds, so a short spin saves a wake-up; it must stay short, because on
// a busy machine a spinning thread takes the core from the one it waits for.
constexpr int kSpins = 2000;
constexpr int kClosed = 1 << 30;  // a bit of inside_
}  // namespace

ThreadPool::ThreadPool(int size) : size_(std::max(1, size)), inside_(kClosed) {
  threads_.reserve(size_);
  try {
    for (int t = 1; t < size_; ++t) threads_.emplace_back([this] { worker(); });
  } catch (...) {  // there are no more threads to be had
    stop();
    throw;
  }
}

ThreadPool::~ThreadPool() { stop(); }

void ThreadPool::stop() noexcept {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
    generation_.fetch_add(1);
  }
  wake_.notify_all();
  for (auto& thread : threads_) thread.join();
}

void ThreadPool::work() noexcept {
  for (int t; (t = ticket_.fetch_add(1)) < count_;) {
    try {
      (*job_)(t);
    } catch (...) {
      std::lock_guard<std::mutex> lock(failure_mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }
}

// Whether there is a job to help with; it stays until this worker has left it.
bool ThreadPool::enter() {
  int inside = inside_.load();
  while (!(inside & kClosed))
    if (inside_.compare_exchange_weak(inside, inside + 1)) return true;
  return false;
}

void ThreadPool::worker() {
  int seen = 0;
  for (;;) {
    for (int spin = 0; spin < kSpins && generation_.load(std::memory_order_acquire) == seen; ++spin) cpu_relax();
    if (generation_.load(std::memory_order_acquire) == seen) {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return generation_.load() != seen; });
    }
    seen = generation_.load(std::memory_order_acquire);
    if (stop_) return;
    if (!enter()) continue;
    work();
    inside_.fetch_sub(1);
  }
}

void ThreadPool::run(const Job& job, int count) {
  std::lock_guard<std::mutex> serial(run_mutex_);
  if (count == 1) {
    job(0);
    return;
  }
  job_ = &job;
  count_ = count;
  ticket_.store(0);
  inside_.store(0);
  {
    std::lock_guard<std::mutex> lock(mutex_);
    generation_.fetch_add(1);
  }
  wake_.notify_all();
  work();
  inside_.fetch_or(kClosed);
  for (int spin = 0; inside_.load() != kClosed; ++spin) {
    if (spin > kSpins) std::this_thread::yield();
    cpu_relax();
  }
  if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
}

void ThreadPool::parallel_for(std::size_t count, std::size_t chunk,
                              const std::function<void(std::size_t, std::size_t, int)>& f) {
  std::atomic<std::size_t> next{0};
  const std::size_t chunks = (count + chunk - 1) / chunk;
  const Job all = [&](int thread) {
    for (;;) {
      const std::size_t begin = next.fetch_add(chunk);
      if (begin >= count) break;
      try {
        f(begin, std::min(count, begin + chunk), thread);
      } catch (...) {
        next.store(count);  // nobody needs to begin with the rest
        throw;
      }
    }
  };
  if (chunks) run(all, static_cast<int>(std::min<std::size_t>(size_, chunks)));
}

}  // namespace ggslam
