// SPDX-License-Identifier: Apache-2.0
// A small pool of threads. Several host threads may share it: jobs are serialised by a lock. The caller works, too, and
// waits for those threads only that have begun: on a busy machine one may wake when all is done. What a job throws
// reaches the caller once all threads are done; of several exceptions, one.
#pragma once
#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace ggslam {

class ThreadPool {
 public:
  explicit ThreadPool(int size);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  int size() const { return size_; }

  // Hands out [0, count) in chunks; f(begin, end, thread), where `thread`, from 0 to size - 1, is another
  // one for each that runs at the same time. Which thread gets which chunk is not fixed, so f must write only to places
  // that belong to its chunk: results are then the same for any number of threads.
  void parallel_for(std::size_t count, std::size_t chunk,
                    const std::function<void(std::size_t, std::size_t, int)>& f);

 private:
  using Job = std::function<void(int)>;
  void run(const Job& job, int count);
  void worker();
  void work() noexcept;
  bool enter();
  void stop() noexcept;
  int size_;
  std::vector<std::thread> threads_;
  std::mutex run_mutex_, mutex_;
  std::condition_variable wake_;
  const Job* job_ = nullptr;  // what runs: job_(t) once for each t in [0, count_)
  int count_ = 0;
  std::atomic<int> generation_{0};
  std::atomic<int> ticket_{0};  // the next t
  std::atomic<int> inside_;     // workers in the job, and whether others may come in
  std::mutex failure_mutex_;
  std::exception_ptr failure_;  // of the job that runs
  std::atomic<bool> stop_{false};
};

}  // namespace ggslam
