// SPDX-License-Identifier: Apache-2.0
// A target that grows: each set of Gaussians that is added makes a new version, at a cost that goes with the blocks they
// lie in. Versions share all blocks in which they agree. Earlier ones stay what they are, and may be read meanwhile.
#pragma once
#include <memory>
#include <mutex>
#include <set>

#include "common/context.hpp"
#include "tracking/growing_level.hpp"

namespace ggslam {

struct GicpTarget;

class GrowingTarget {
 public:
  // Begins with what a target holds.
  GrowingTarget(const GicpTarget& base, const TargetSettings& settings);

  std::mutex mutex;  // is held by callers of all that follows
  const uint64_t number;  // of no other target
  const uint64_t origin;  // number of the target whose blocks and voxels are those of the first version, place by place; or 0
  uint32_t newest = kFirstVersion;

  void hold(uint32_t version) { held_.insert(version); }
  void release(uint32_t version) { held_.erase(held_.find(version)); }

  // Adds Gaussians: `newest` is the version with them, whose voxels lack shapes. After an exception nothing can be added
  // to an earlier version any more: `newest` is none that somebody has.
  void add(Context& context, const TargetInput& input, const TargetSettings& settings);

  GrowingLevel fine, coarse;

 private:
  std::multiset<uint32_t> held_;
};

// A hold on a version.
struct TargetVersion {
  std::shared_ptr<GrowingTarget> of;
  HeldLevel fine, coarse;
  bool finished = false;

  // Of the newest version; its mutex is held.
  explicit TargetVersion(std::shared_ptr<GrowingTarget> target);
  ~TargetVersion();
  TargetVersion(const TargetVersion&) = delete;
  TargetVersion& operator=(const TargetVersion&) = delete;

  // Makes shapes where voxels have none yet.
  void finish(Context& context, const TargetSettings& settings);
};

// What `base` holds and the Gaussians of `input`.
std::unique_ptr<TargetVersion> grow(Context& context, const GicpTarget& base, const TargetInput& input,
                                    const TargetSettings& settings);

// A number that no other target has.
uint64_t new_target_number();

}  // namespace ggslam
