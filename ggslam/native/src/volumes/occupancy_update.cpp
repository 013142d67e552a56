// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_update.hpp"

GGSLAM_DECLARE_KERNEL(bool update_block(OccupancyBlock& block, const std::uint64_t* free, const std::uint64_t* occupied,
                                        const OccupancyUpdate& update))

namespace ggslam {
namespace {

constexpr std::uint64_t kNothing[kMaskWords] = {};

struct Task {
  std::uint64_t code;
  const std::uint64_t *free, *occupied;
  OccupancyBlock* block;
  bool one_value;
};

// Whether the scan cannot change a cell: all of it is as surely free, or occupied, as it may become.
bool settled(const Cell& cell, const OccupancyUpdate& update, bool misses, bool hits) {
  if (cell.kind != CellKind::leaf) return false;
  return (!misses || cell.value <= update.minimum) && (!hits || cell.value >= update.maximum);
}

}  // namespace

void apply_scan(Context& context, const Scan& scan, const OccupancyUpdate& update, OccupancyTree& tree) {
  std::vector<Task> tasks;
  const auto add = [&](std::uint64_t code, const std::uint64_t* free, const std::uint64_t* occupied) {
    if (settled(tree.find(code), update, free != nullptr, occupied != nullptr)) return;
    tasks.push_back({code, free ? free : kNothing, occupied ? occupied : kNothing, &tree.open(code), false});
  };
  const VoxelMasks &free = scan.free(), &occupied = scan.occupied();
  for (std::size_t b = 0; b < free.blocks(); ++b) add(free.code(b), free.words(b), occupied.find(free.code(b)));
  for (std::size_t b = 0; b < occupied.blocks(); ++b)
    if (free.find(occupied.code(b)) == nullptr) add(occupied.code(b), nullptr, occupied.words(b));
  const auto kernel = GGSLAM_DISPATCH(context.isa, update_block);
  context.pool.parallel_for(tasks.size(), 64, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t i = begin; i < end; ++i)
      tasks[i].one_value = kernel(*tasks[i].block, tasks[i].free, tasks[i].occupied, update);
  });
  for (const Task& task : tasks)
    if (task.one_value) tree.collapse(task.code);
}

}  // namespace ggslam
