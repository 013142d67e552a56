// SPDX-License-Identifier: Apache-2.0
// What somebody lacks who has a copy of an earlier version of a target, or of another one.
#include <cstring>

#include "common/guard.hpp"
#include "tracking/gicp_target.hpp"

namespace ggslam {
namespace {

constexpr int64_t kAlignment = 64;  // of what a kernel reads

int64_t aligned(int64_t bytes) { return (bytes + kAlignment - 1) / kAlignment * kAlignment; }

struct Block {
  uint64_t key, occupied, first;
};

struct Lacking {
  std::vector<Block> blocks;
  int64_t voxels = 0;
};

Lacking lacking_of(const LevelContents& contents, const std::vector<uint64_t>* keys) {
  Lacking found;
  const auto note = [&](uint64_t key, const VoxelBlock& block) {
    found.blocks.push_back({key, block.occupied, block.first});
    found.voxels += __builtin_popcountll(block.occupied);
  };
  if (keys == nullptr) {
    found.blocks.reserve(contents.block_count);
    contents.for_each_block(note);
    return found;
  }
  for (const uint64_t key : *keys) note(key, contents.view.blocks[find_block(contents.view, key)]);
  return found;
}

// Keys of the blocks of both levels that changed since the copy was made; false: it is not known, or of another target.
bool changed_keys(const GicpTarget& target, const TargetCopy& copy, bool finished, std::vector<uint64_t>* keys) {
  if (copy.number == 0 || (copy.finished != 0) != finished) return false;
  if (!target.grown) return copy.number == target.number;
  GrowingTarget& of = *target.grown->of;
  const uint32_t version = target.grown->fine.version;
  const uint32_t before = copy.number == of.origin ? kFirstVersion : copy.version;
  if ((copy.number != of.number && copy.number != of.origin) || before > version) return false;
  const std::lock_guard<std::mutex> lock(of.mutex);
  return of.fine.changes(before, version, keys[0]) && of.coarse.changes(before, version, keys[1]);
}

// Lays a level out behind `begin`; returns its end.
int64_t lay_out(const Lacking& lacking, const LevelContents& contents, int64_t value_bytes, int64_t begin,
                LevelChanges& out) {
  const auto blocks = static_cast<int64_t>(lacking.blocks.size());
  out.values_at = begin;
  out.blocks_at = aligned(begin + lacking.voxels * value_bytes);
  out.indices_at = aligned(out.blocks_at + blocks * static_cast<int64_t>(sizeof(Block)));
  out.voxel_count = static_cast<int32_t>(lacking.voxels), out.block_count = static_cast<int32_t>(blocks);
  out.all_blocks = static_cast<int32_t>(contents.block_count), out.places = static_cast<int32_t>(contents.places);
  return aligned(out.indices_at + lacking.voxels * static_cast<int64_t>(sizeof(int32_t)));
}

template <typename T>
void write(const Lacking& lacking, const T* values, const LevelChanges& at, char* out) {
  T* value = reinterpret_cast<T*>(out + at.values_at);
  int32_t* index = reinterpret_cast<int32_t*>(out + at.indices_at);
  for (const Block& block : lacking.blocks) {
    const int count = __builtin_popcountll(block.occupied);
    value = std::copy_n(values + block.first, count, value);
    for (int i = 0; i < count; ++i) *index++ = static_cast<int32_t>(block.first) + i;
  }
  if (!lacking.blocks.empty())
    std::memcpy(out + at.blocks_at, lacking.blocks.data(), lacking.blocks.size() * sizeof(Block));
}

int64_t write_changes(const GicpTarget& target, const TargetCopy& copy, bool finished, char* out, int64_t room,
                      TargetChanges& changes) {
  if (finished && !target.is_finished()) refuse("target: it is not finished");
  std::vector<uint64_t> keys[2];
  const bool known = changed_keys(target, copy, finished, keys);
  changes = TargetChanges{};
  changes.target = {target.number, 0, finished};
  if (target.grown) changes.target = {target.grown->of->number, target.grown->fine.version, finished};
  changes.whole = !known;
  const int64_t value_bytes = finished ? sizeof(Voxel) : sizeof(VoxelMoments);
  Lacking lacking[2];
  LevelChanges* levels[2] = {&changes.fine, &changes.coarse};
  int64_t end = 0;
  for (int level = 0; level < 2; ++level) {
    lacking[level] = lacking_of(target.contents(level), known ? &keys[level] : nullptr);
    end = lay_out(lacking[level], target.contents(level), value_bytes, end, *levels[level]);
  }
  for (int level = 0; level < 2 && end <= room; ++level) {
    const LevelContents contents = target.contents(level);
    if (finished)
      write(lacking[level], contents.view.voxels, *levels[level], out);
    else
      write(lacking[level], contents.moments, *levels[level], out);
  }
  return end;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int64_t ggslam_gicp_target_changes(const void* target, const ggslam::TargetCopy* copy, int finished,
                                                 void* out, int64_t room, ggslam::TargetChanges* changes) try {
  ggslam::check_array("out", out, room);
  return ggslam::write_changes(ggslam::object_of<ggslam::GicpTarget>(target),
                               ggslam::object_of<ggslam::TargetCopy>(copy), finished != 0, static_cast<char*>(out), room,
                               ggslam::object_of<ggslam::TargetChanges>(changes));
} GGSLAM_CATCH_ALL
