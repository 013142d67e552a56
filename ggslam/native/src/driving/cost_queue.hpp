// SPDX-License-Identifier: Apache-2.0
// Cells of which a search goes on with those of the least cost, to a part of a cell.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

namespace ggslam::driving {

class CostQueue {
 public:
  struct Entry {
    uint32_t cell;
    float value;
  };

  void clear() {
    for (std::size_t b = lowest_; b < highest_; ++b) buckets_[b].clear();
    current_ = count_ = highest_ = 0, lowest_ = ~std::size_t{0};
  }

  void push(float rank, Entry entry) {
    const std::size_t bucket = static_cast<std::size_t>(std::max(rank, 0.0f) / kStep);
    if (bucket >= buckets_.size()) buckets_.resize(bucket + bucket / 2 + 64);
    buckets_[bucket].push_back(entry);
    current_ = count_++ == 0 ? bucket : std::min(current_, bucket);
    lowest_ = std::min(lowest_, bucket), highest_ = std::max(highest_, bucket + 1);
  }

  bool pop(Entry* entry) {
    if (count_ == 0) return false;
    while (buckets_[current_].empty()) ++current_;
    *entry = buckets_[current_].back();
    buckets_[current_].pop_back();
    --count_;
    return true;
  }

  // Ranks all anew: rank(entry), infinite for those that are left out.
  template <class Rank>
  void sort(Rank&& rank) {
    std::vector<Entry> all;
    all.reserve(count_);
    for (std::size_t b = lowest_; b < highest_; ++b) all.insert(all.end(), buckets_[b].begin(), buckets_[b].end());
    clear();
    for (const Entry& entry : all)
      if (const float r = rank(entry); r < std::numeric_limits<float>::infinity()) push(r, entry);
  }

  float rank() const { return static_cast<float>(current_) * kStep; }  // of the next, or a little less
  bool is_empty() const { return count_ == 0; }

 private:
  static constexpr float kStep = 0.03125f;
  std::vector<std::vector<Entry>> buckets_;
  std::size_t current_ = 0, count_ = 0;
  std::size_t lowest_ = ~std::size_t{0}, highest_ = 0;  // buckets that were used
};

}  // namespace ggslam::driving
