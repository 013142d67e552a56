// SPDX-License-Identifier: Apache-2.0
#include "tracking/growing_level.hpp"

#include <limits>

#include "common/guard.hpp"
#include "tracking/target_part.hpp"

namespace ggslam {
namespace {

constexpr std::size_t kPlaceUnit = 4;       // voxels; places are given out in multiples
constexpr std::size_t kSlotsPerBlock = 4;   // at least, so that most look-ups end at the first slot
constexpr std::size_t kKnownVersions = 64;  // whose changes are kept
constexpr uint32_t kNewest = ~uint32_t{0};

std::size_t count_of(uint64_t occupied) { return static_cast<std::size_t>(__builtin_popcountll(occupied)); }
std::size_t units_for(uint64_t occupied) { return (count_of(occupied) + kPlaceUnit - 1) / kPlaceUnit; }

// Of the place that a block leaves. The first ones lie close together.
std::size_t units_of(const VoxelBlock& block) {
  return block.version == kFirstVersion ? count_of(block.occupied) / kPlaceUnit : units_for(block.occupied);
}

// Voxels of a block that are at its side in direction (x, y, z), each of -1, 0, 1.
uint64_t side(int x, int y, int z) {
  const auto low = [](int d) { return d > 0 ? 3 : 0; };
  const auto high = [](int d) { return d < 0 ? 0 : 3; };
  return bits_x(low(x), high(x)) & bits_y(low(y), high(y)) & bits_z(low(z), high(z));
}

}  // namespace

VoxelLevelView HeldLevel::view() const {
  return {voxels.get(),     blocks.get(), previous.get(), slot_key.get(), slot_block.get(),
          slot_mask,        size,         1 / size,       version};
}

VoxelLevelView GrowingLevel::newest() const {
  return {voxels_.get(),     blocks_.get(), previous_.get(), slot_key_.get(), slot_block_.get(),
          slot_mask_,        size_,         1 / size_,       kNewest};
}

void GrowingLevel::move(HeldLevel& held) const {
  held.voxels = voxels_.data(), held.moments = moments_.data();
  held.blocks = blocks_.data(), held.previous = previous_.data();
  held.slot_key = slot_key_, held.slot_block = slot_block_, held.slot_mask = slot_mask_;
  held.keys = keys_.data();
}

HeldLevel GrowingLevel::hold(uint32_t version) const {
  HeldLevel held;
  move(held);
  held.block_count = key_count_, held.voxel_count = voxel_count_, held.places = places_;
  held.size = size_, held.version = version;
  return held;
}

// A table for so many keys, and for those who come from now on: the old one leads to the old array of blocks for ever.
void GrowingLevel::make_table(std::size_t keys) {
  std::size_t capacity = 64;
  while (capacity < 2 * kSlotsPerBlock * keys) capacity *= 2;
  const VoxelLevelView before = newest();
  std::shared_ptr<uint64_t[]> slot_key(new uint64_t[capacity]);
  std::shared_ptr<int32_t[]> slot_block(new int32_t[capacity]);
  std::fill_n(slot_key.get(), capacity, kEmptyKey);
  for (std::size_t k = 0; k < key_count_; ++k) {
    const uint64_t key = keys_.get()[k];
    std::size_t slot = hash_key(key) & (capacity - 1);
    while (slot_key.get()[slot] != kEmptyKey) slot = (slot + 1) & (capacity - 1);
    slot_key.get()[slot] = key;
    slot_block.get()[slot] = find_block(before, key);
  }
  slot_key_ = std::move(slot_key), slot_block_ = std::move(slot_block), slot_mask_ = capacity - 1;
}

// For so many blocks, all of them with new keys. Where blocks move to another array, the table does, too: no slot that
// a reader of the old array sees leads beyond it.
void GrowingLevel::make_room(std::size_t more) {
  keys_.reserve(key_count_, key_count_ + more);
  const bool moves = block_room_ + more > blocks_.room();
  blocks_.reserve(block_room_, block_room_ + more);
  previous_.reserve(block_room_, block_room_ + more);
  if (moves || !slot_key_ || slot_mask_ + 1 < kSlotsPerBlock * (key_count_ + more)) make_table(key_count_ + more);
}

uint32_t GrowingLevel::take_place(uint64_t occupied) {
  const std::size_t units = units_for(occupied);
  std::vector<uint32_t>& free = free_places_[units];
  if (!free.empty()) {
    const uint32_t place = free.back();
    free.pop_back();
    return place;
  }
  return append_place(kPlaceUnit * units);
}

uint32_t GrowingLevel::append_place(std::size_t voxels) {
  const std::size_t place = places_;
  if (place + voxels > static_cast<std::size_t>(std::numeric_limits<int32_t>::max()))
    refuse("target: expected at most %d voxels", std::numeric_limits<int32_t>::max());
  places_ += voxels;
  voxels_.reserve(place, places_);
  moments_.reserve(place, places_);
  return static_cast<uint32_t>(place);
}

int32_t GrowingLevel::new_block(uint64_t key, const VoxelBlock& block, int32_t previous) {
  int32_t number;
  if (free_blocks_.empty()) {
    number = static_cast<int32_t>(block_room_++);
    key_of_.resize(block_room_), shaped_.resize(block_room_), listed_.resize(block_room_), chosen_.resize(block_room_);
  } else {
    number = free_blocks_.back();
    free_blocks_.pop_back();
  }
  const std::size_t n = static_cast<std::size_t>(number);
  blocks_.get()[n] = block, previous_.get()[n] = previous;
  key_of_[n] = key, shaped_[n] = 0, chosen_[n] = 0;
  if (!listed_[n]) unshaped_.push_back(number), listed_[n] = 1;
  return number;
}

// The key leads to the block from now on; readers of earlier versions go on to the one before.
void GrowingLevel::publish(uint64_t key, int32_t block) {
  std::size_t slot = hash_key(key) & slot_mask_;
  while (slot_key_.get()[slot] != kEmptyKey && slot_key_.get()[slot] != key) slot = (slot + 1) & slot_mask_;
  const bool is_new = slot_key_.get()[slot] == kEmptyKey;
  if (is_new) keys_.get()[key_count_++] = key;
  __atomic_store_n(&slot_block_.get()[slot], block, __ATOMIC_RELEASE);
  if (is_new) __atomic_store_n(&slot_key_.get()[slot], key, __ATOMIC_RELEASE);
}

void GrowingLevel::append(uint64_t key, uint64_t occupied, const VoxelMoments* moments, const Voxel* voxels) {
  make_room(1);
  const uint32_t first = append_place(count_of(occupied));
  const int32_t block = new_block(key, {occupied, first, kFirstVersion}, -1);
  std::copy_n(moments, count_of(occupied), moments_.get() + first);
  if (voxels) std::copy_n(voxels, count_of(occupied), voxels_.get() + first);
  shaped_[static_cast<std::size_t>(block)] = voxels != nullptr;
  voxel_count_ += count_of(occupied);
  publish(key, block);
}

// Blocks beside changed ones in which a voxel touches one of those that change: its shape may.
void GrowingLevel::choose_beside(const std::vector<ChangedBlock>& changed, uint32_t version, Choice& choice) {
  const VoxelLevelView view = newest();
  for (const ChangedBlock& c : changed) {
    const Vec3i at = block_coordinates(c.key);
    for (int n = 0; n < 27; ++n) {
      const int x = n % 3 - 1, y = n / 3 % 3 - 1, z = n / 9 - 1;
      if (n == 13 || !(c.added & side(x, y, z))) continue;
      const uint64_t key = block_key(at[0] + x, at[1] + y, at[2] + z);
      const int before = find_block(view, key);
      if (before < 0 || chosen_[static_cast<std::size_t>(before)] == version) continue;
      const VoxelBlock& block = view.blocks[before];
      if (!(block.occupied & side(-x, -y, -z))) continue;
      chosen_[static_cast<std::size_t>(before)] = version;
      choice.placed.push_back({key, 0, block, block});
      choice.before.push_back(before);
    }
  }
}

std::vector<PlacedBlock> GrowingLevel::place(const std::vector<ChangedBlock>& changed, bool spread, uint32_t version) {
  make_room(0);
  const VoxelLevelView view = newest();
  Choice choice;
  for (const ChangedBlock& c : changed) {
    const int before = find_block(view, c.key);
    const VoxelBlock old = before < 0 ? VoxelBlock{0, 0, 0} : view.blocks[before];
    if (before >= 0) chosen_[static_cast<std::size_t>(before)] = version;
    choice.placed.push_back({c.key, c.added, {old.occupied | c.added, 0, version}, old});
    choice.before.push_back(before);
  }
  if (spread) choose_beside(changed, version, choice);
  make_room(choice.placed.size());
  Change change{version, {}};
  for (std::size_t i = 0; i < choice.placed.size(); ++i) {
    PlacedBlock& p = choice.placed[i];
    p.now.version = version;
    p.now.first = take_place(p.now.occupied);
    if (choice.before[i] >= 0) replaced_.push_back({version, choice.before[i]});
    voxel_count_ += count_of(p.now.occupied) - count_of(p.before.occupied);
    publish(p.key, new_block(p.key, p.now, choice.before[i]));
    change.keys.push_back(p.key);
  }
  changes_.push_back(std::move(change));
  if (changes_.size() > kKnownVersions) changes_.pop_front();
  return std::move(choice.placed);
}

std::vector<VoxelBlock> GrowingLevel::take_unshaped(uint32_t version) {
  VoxelLevelView view = newest();
  view.version = version;
  std::vector<VoxelBlock> found;
  std::vector<int32_t> left;
  for (const int32_t block : unshaped_) {
    const std::size_t b = static_cast<std::size_t>(block);
    const bool take = !shaped_[b] && find_block(view, key_of_[b]) == block;
    if (take) found.push_back(view.blocks[b]);
    if (take) shaped_[b] = 1;
    listed_[b] = !shaped_[b];
    if (listed_[b]) left.push_back(block);
  }
  unshaped_ = std::move(left);
  return found;
}

void GrowingLevel::collect(uint32_t version) {
  for (; !replaced_.empty() && replaced_.front().version <= version; replaced_.pop_front()) {
    const int32_t block = replaced_.front().block;
    const VoxelBlock& old = blocks_.get()[block];
    if (units_of(old) > 0) free_places_[units_of(old)].push_back(old.first);
    free_blocks_.push_back(block);
    shaped_[static_cast<std::size_t>(block)] = 1;  // nobody will ask
  }
  if (unshaped_.size() < 2 * key_count_ + 1024) return;
  std::vector<int32_t> left;
  for (const int32_t block : unshaped_) {
    listed_[static_cast<std::size_t>(block)] = !shaped_[static_cast<std::size_t>(block)];
    if (listed_[static_cast<std::size_t>(block)]) left.push_back(block);
  }
  unshaped_ = std::move(left);
}

bool GrowingLevel::changes(uint32_t version, uint32_t last, std::vector<uint64_t>& keys) const {
  keys.clear();
  if (version < last && (changes_.empty() || changes_.front().version > version + 1)) return false;
  for (const Change& change : changes_)
    if (change.version > version && change.version <= last) keys.insert(keys.end(), change.keys.begin(), change.keys.end());
  if (last > version + 1) {
    std::sort(keys.begin(), keys.end());
    keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
  }
  return true;
}

}  // namespace ggslam
