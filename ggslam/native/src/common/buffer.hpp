// SPDX-License-Identifier: Apache-2.0
// Memory of the kernels: aligned to cache lines, grown on demand, never shrunk.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <new>
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ggslam {

// Room for a number of plain values. Contents are lost when it grows.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  void reserve(std::size_t size) {
    if (size <= capacity_) return;
    std::free(data_);
    data_ = nullptr;
    capacity_ = 0;
    const std::size_t wanted = size + size / 4 + 64, bytes = wanted * sizeof(T);
    // Large buffers are written in random order: with pages of 4 KiB, every write would miss the address cache.
    const std::size_t alignment = bytes >= 2 * kHugePage ? kHugePage : 64;
    const std::size_t rounded = (bytes + alignment - 1) / alignment * alignment;
    void* memory = std::aligned_alloc(alignment, rounded);
    if (memory == nullptr) throw std::bad_alloc();
#if defined(__linux__)
    if (alignment == kHugePage) madvise(memory, rounded, MADV_HUGEPAGE);
#endif
    data_ = static_cast<T*>(memory);
    capacity_ = wanted;
  }

  T* data() const { return data_; }
  T& operator[](std::size_t i) const { return data_[i]; }

 private:
  static constexpr std::size_t kHugePage = std::size_t{1} << 21;
  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace ggslam
