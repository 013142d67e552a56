// SPDX-License-Identifier: Apache-2.0
// Hands out parts of a block of memory.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// Each part is aligned to 256 bytes. With a null block it only counts.
class Carver {
 public:
  explicit Carver(void* block) : block_(static_cast<char*>(block)) {}
  template <class T>
  T* take(std::int64_t count) {
    T* part = reinterpret_cast<T*>(block_ + used_);
    used_ += (static_cast<std::size_t>(count) * sizeof(T) + 255) / 256 * 256;
    return part;
  }
  std::size_t used() const { return used_; }

 private:
  char* block_;
  std::size_t used_ = 0;
};

}  // namespace ggslam::cuda
