// SPDX-License-Identifier: Apache-2.0
// A small pool of threads. run(f) calls f(t) once for each t in [0, size): the caller's thread is t = 0.
// Several host threads may share a pool: calls of run() are serialised by a lock. What f throws reaches the caller once
// all threads are done; of several exceptions, one.
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
  void run(const std::function<void(int)>& job);

  // Hands out [0, count) in chunks; f(begin, end, thread). Which thread gets which chunk is not fixed, so f must
  // write only to places that belong to its chunk: results are then the same for any number of threads.
  void parallel_for(std::size_t count, std::size_t chunk,
                    const std::function<void(std::size_t, std::size_t, int)>& f);

 private:
  void worker(int index);
  void work(const std::function<void(int)>& job, int index) noexcept;
  void stop() noexcept;
  int size_;
  std::vector<std::thread> threads_;
  std::mutex run_mutex_, mutex_;
  std::condition_variable wake_;
  const std::function<void(int)>* job_ = nullptr;
  std::atomic<int> generation_{0}, pending_{0};
  std::mutex failure_mutex_;
  std::exception_ptr failure_;  // of the job that runs
  bool stop_ = false;
};

}  // namespace ggslam
