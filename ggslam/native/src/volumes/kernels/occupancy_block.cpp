// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_update.hpp"

namespace ggslam::GGSLAM_ISA {

// A voxel that is free and occupied in one scan is occupied. Values beyond a threshold (from a file of other settings)
// are not drawn back by an update that points beyond it, as in OctoMap. Returns whether the block is known throughout
// and of one value.
bool update_block(OccupancyBlock& block, const std::uint64_t* free, const std::uint64_t* occupied,
                  const OccupancyUpdate& update) {
  const OccupancyUpdate u = update;
  std::uint64_t known = ~std::uint64_t{0};
  for (int w = 0; w < kBlockVoxels / 64; ++w) {
    const std::uint64_t hits = occupied[w], seen = free[w] | hits;
    known &= block.known[w] |= seen;
    if (seen == 0) continue;
    float* value = block.value + 64 * w;
    for (int half = 0; half < 2; ++half) {
      const std::uint32_t seen_bits = static_cast<std::uint32_t>(seen >> (32 * half));
      const std::uint32_t hit_bits = static_cast<std::uint32_t>(hits >> (32 * half));
      for (int i = 0; i < 32; ++i) {
        const std::uint32_t bit = std::uint32_t{1} << i;
        const float old = value[32 * half + i];
        const float raised = old >= u.maximum ? old : old + u.hit > u.maximum ? u.maximum : old + u.hit;
        const float lowered = old <= u.minimum ? old : old + u.miss < u.minimum ? u.minimum : old + u.miss;
        // A hit that starts below the minimum, or a miss that starts above the maximum, may end there: clamp these, too.
        const float hit = raised < u.minimum ? u.minimum : raised;
        const float miss = lowered > u.maximum ? u.maximum : lowered;
        value[32 * half + i] = hit_bits & bit ? hit : seen_bits & bit ? miss : old;
      }
    }
  }
  if (known != ~std::uint64_t{0}) return false;
  bool equal = true;
  for (int i = 1; i < kBlockVoxels; ++i) equal &= block.value[i] == block.value[0];
  return equal;
}

}  // namespace ggslam::GGSLAM_ISA
