// SPDX-License-Identifier: Apache-2.0
#include "volumes/tsdf_fusion.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "common/context.hpp"
#include "volumes/tsdf_candidates.hpp"
#include "volumes/tsdf_listed_blocks.hpp"
#include "volumes/tsdf_rays.hpp"

GGSLAM_DECLARE_KERNEL(void tsdf_prepare_depth(const float* depth, int width, int height, int row, float min_depth,
                                              float farthest, float* out, volumes::DepthTile* tiles, int32_t* valid))
GGSLAM_DECLARE_KERNEL(void tsdf_erode_row(const float* depth, int width, int v, float* out))
GGSLAM_DECLARE_KERNEL(void tsdf_erode_column(const float* rows, int width, int height, int v, float* out))
GGSLAM_DECLARE_KERNEL(void tsdf_pack_color(const uint8_t* color, std::size_t begin, std::size_t end, int32_t* out))
GGSLAM_DECLARE_KERNEL(unsigned tsdf_fuse_block(const volumes::VoxelUpdate& update, volumes::VoxelBlock& block))
GGSLAM_DECLARE_KERNEL(void tsdf_octants_of_row(const volumes::OctantRow& row))
GGSLAM_DECLARE_KERNEL(unsigned tsdf_decay_block(volumes::VoxelBlock& block, volumes::PointBlock* points, float factor,
                                                int least))

namespace ggslam::volumes {
namespace {

constexpr std::size_t kAtOnce = std::size_t{1} << 14;  // blocks with voxels; about what an image at 5 mm shows

using Clock = std::chrono::steady_clock;

double milliseconds(Clock::time_point from, Clock::time_point to) {
  return std::chrono::duration<double, std::milli>(to - from).count();
}

// --- images ----------------------------------------------------------------------------------------------------------

void add_levels(DepthPyramid& pyramid) {
  for (std::size_t level = 0; pyramid.levels[level].width > 1 || pyramid.levels[level].height > 1; ++level) {
    if (pyramid.levels.size() < level + 2) pyramid.levels.emplace_back();
    const DepthPyramid::Level& fine = pyramid.levels[level];
    DepthPyramid::Level& coarse = pyramid.levels[level + 1];
    coarse.width = (fine.width + 1) / 2, coarse.height = (fine.height + 1) / 2;
    coarse.tiles.assign(static_cast<std::size_t>(coarse.width) * coarse.height,
                        {std::numeric_limits<float>::infinity(), 0.0f});
    for (int v = 0; v < fine.height; ++v)
      for (int u = 0; u < fine.width; ++u) {
        const DepthTile from = fine.tiles[static_cast<std::size_t>(v) * fine.width + u];
        DepthTile& to = coarse.tiles[static_cast<std::size_t>(v / 2) * coarse.width + u / 2];
        to.low = std::min(to.low, from.low), to.high = std::max(to.high, from.high);
      }
    if (coarse.width == 1 && coarse.height == 1) pyramid.levels.resize(level + 2);
  }
}

void erode(const FusionInput& in, Context& context, FusionImages& images) {
  const auto kernel = GGSLAM_DISPATCH(context.isa, tsdf_erode_column);
  images.eroded.resize(images.eroded_rows.size());
  context.pool.parallel_for(in.height, 16, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t v = begin; v < end; ++v)
      kernel(images.eroded_rows.data(), in.width, in.height, static_cast<int>(v), images.eroded.data());
  });
}

void prepare(const FusionInput& in, const FusionSettings& settings, float truncation, Context& context,
             FusionImages& images) {
  const std::size_t pixels = static_cast<std::size_t>(in.width) * in.height;
  const int columns = (in.width + kTile - 1) / kTile, rows = (in.height + kTile - 1) / kTile;
  DepthPyramid& pyramid = images.pyramid;
  if (pyramid.levels.empty()) pyramid.levels.emplace_back();
  DepthPyramid::Level& base = pyramid.levels[0];
  base.width = columns, base.height = rows;
  base.tiles.resize(static_cast<std::size_t>(columns) * rows);
  images.depth.resize(pixels + in.width + OctantRow::kSlack), images.eroded_rows.resize(pixels);
  if (in.color != nullptr) images.color.resize(pixels);
  const std::size_t stride = columns + 1;
  pyramid.valid.assign(stride * (rows + 1), 0);
  const auto depth_kernel = GGSLAM_DISPATCH(context.isa, tsdf_prepare_depth);
  const auto erosion_kernel = GGSLAM_DISPATCH(context.isa, tsdf_erode_row);
  const auto color_kernel = GGSLAM_DISPATCH(context.isa, tsdf_pack_color);
  context.pool.parallel_for(rows, 8, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t row = begin; row < end; ++row) {
      const int first = static_cast<int>(row) * kTile, last = std::min(first + kTile, in.height);
      depth_kernel(in.depth, in.width, in.height, static_cast<int>(row), settings.min_depth,
                   settings.max_depth + 2 * truncation, images.depth.data(), base.tiles.data() + row * columns,
                   &pyramid.valid[(row + 1) * stride + 1]);
      for (int v = first; v < last; ++v) erosion_kernel(images.depth.data(), in.width, v, images.eroded_rows.data());
    }
    if (in.color == nullptr) return;
    const std::size_t per_row = static_cast<std::size_t>(kTile) * in.width;
    color_kernel(in.color, begin * per_row, std::min(end * per_row, pixels), images.color.data());
  });
  erode(in, context, images);
  for (int v = 1; v <= rows; ++v)
    for (int u = 1; u <= columns; ++u)
      pyramid.valid[v * stride + u] += pyramid.valid[v * stride + u - 1] + pyramid.valid[(v - 1) * stride + u] -
                                       pyramid.valid[(v - 1) * stride + u - 1];
  add_levels(pyramid);
  const DepthTile all = pyramid.levels.back().tiles[0];
  images.nearest = all.low, images.farthest = all.high;
}

// --- blocks ----------------------------------------------------------------------------------------------------------

// Candidates of all cells, in an order that does not depend on the threads.
void select(const Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context,
            FusionScratch& scratch) {
  scratch.candidates.clear();
  if (scratch.images.farthest <= 0) return;
  const CandidateSearch search(map, in, settings, scratch.images);
  const std::size_t threads = context.pool.size();
  scratch.parts.resize(threads);
  for (auto& part : scratch.parts) part.clear();
  scratch.cells.assign(search.cells(), {});
  std::vector<CandidateCount> counts(threads);
  context.pool.parallel_for(search.cells(), 4, [&](std::size_t begin, std::size_t end, int thread) {
    std::vector<Candidate>& part = scratch.parts[thread];
    for (std::size_t cell = begin; cell < end; ++cell) {
      const std::size_t first = part.size();
      search.search(cell, counts[thread], part);
      scratch.cells[cell] = {thread, first, part.size()};
    }
  });
  CandidateCount total;
  for (const CandidateCount& count : counts) total.add(count.all, count.with_voxels);
  for (const auto& cell : scratch.cells) {
    const auto from = scratch.parts[cell.thread].begin();
    scratch.candidates.insert(scratch.candidates.end(), from + cell.begin, from + cell.end);
  }
}

uint16_t grown(uint16_t weight, float measured, float most) {
  const float total = std::min(weight + std::floor(measured + 0.5f), std::max(most, static_cast<float>(weight)));
  return static_cast<uint16_t>(std::min(total, static_cast<float>(kFullWeight)));
}

// Notes free blocks, makes the blocks of surfaces, and lists those whose voxels are to be updated, up to kAtOnce of them.
// Returns the first candidate that is left.
std::size_t make_blocks(Tsdf& map, const FusionSettings& settings, FusionScratch& scratch, FusionStats& stats,
                        std::size_t first) {
  const float scale = kFullWeight / map.max_weight, most = settings.max_free_weight * scale;
  scratch.updates.clear();
  for (; first < scratch.candidates.size() && scratch.updates.size() < kAtOnce; ++first) {
    Candidate& c = scratch.candidates[first];
    const bool is_new = c.row < 0;
    if (is_new) c.row = static_cast<int32_t>(map.insert(c.at));
    Block& block = map.block(c.row);
    block.seen = map.views;
    // A block that is known to be free needs no voxels for a view that shows a part of it as free.
    if (c.sight == Sight::partial && !is_new && block.slot < 0) continue;
    if (c.sight == Sight::free && block.slot < 0) {
      if (is_new) block.revision = map.revision, ++stats.made;
      block.free_weight = grown(block.free_weight, scale / (c.z * c.z), most);
      continue;
    }
    const bool was_dense = block.slot >= 0;
    VoxelBlock* voxels = map.densify(block);
    scratch.updates.push_back({c.at, voxels, c.row, is_new, !was_dense, 0u});
  }
  return first;
}

// Marks the octants of a row's points.
void mark_row(const OctantRow& row, bool alone, ListedBlocks& blocks, FusionScratch& scratch) {
  for (int begin = 0; begin < row.width; begin += 64)
    for (uint64_t fresh = row.fresh[begin / 64]; fresh != 0; fresh &= fresh - 1) {
      const int u = begin + __builtin_ctzll(fresh);
      const int32_t x = row.out[0][u], y = row.out[1][u], z = row.out[2][u];
      const int32_t n = blocks.find(x >> 4, y >> 4, z >> 4);
      if (n < 0) continue;
      __atomic_store_n(&scratch.marked[n], 1, __ATOMIC_RELAXED);
      uint8_t* const octants = scratch.octants.data() + static_cast<std::size_t>(n) * kVoxels + (x >> 1 & 7) + (y >> 1 & 7) * kSide + (z >> 1 & 7) * kSide * kSide;
      const auto bit = static_cast<uint8_t>(1 << ((x & 1) + 2 * (y & 1) + 4 * (z & 1)));
      if (alone)
        *octants |= bit;
      else if (!(__atomic_load_n(octants, __ATOMIC_RELAXED) & bit))
        __atomic_fetch_or(octants, bit, __ATOMIC_RELAXED);
    }
}

// Octants of two rows, one above the other, that take turns.
class OctantRows {
 public:
  explicit OctantRows(int width)
      : stride_(width + 1 + OctantRow::kSlack), values_(6 * stride_, OctantRow::kNone), fresh_((width + 63) / 64) {}

  void next(OctantRow& row) {
    turn_ ^= 1;
    for (int a = 0; a < 3; ++a) {
      row.out[a] = values_.data() + (3 * turn_ + a) * stride_ + 1;
      row.above[a] = values_.data() + (3 * (turn_ ^ 1) + a) * stride_ + 1;
    }
    row.fresh = fresh_.data();
  }

 private:
  std::size_t stride_;
  std::vector<int32_t> values_;
  std::vector<uint64_t> fresh_;
  std::size_t turn_ = 0;
};

// Marks the octants of the listed blocks' voxels that the view has points in.
void mark_points(const Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context,
                 FusionScratch& scratch) {
  constexpr int kOctants = 2 * kSide;  // along the edge of a block
  scratch.octants.resize(std::max(scratch.octants.size(), scratch.updates.size() * kVoxels), 0);
  scratch.marked.assign(scratch.updates.size(), 0);
  const ListedRows rows(map, scratch);
  const Mat3d axes = Mat3d::from(in.rotation).transpose();
  const double octant = 0.5 * map.voxel;
  const Vec3d position = -1.0 / (kOctants * octant) * (axes * Vec3d::from(in.translation));
  const Vec3i corner = floor(position);
  OctantRow common{};
  common.width = in.width, common.max_depth = settings.max_depth;
  cast<float>(kOctants * (position - cast<double>(corner))).to(common.origin);
  const auto kernel = GGSLAM_DISPATCH(context.isa, tsdf_octants_of_row);
  const bool alone = context.pool.size() == 1;
  context.pool.parallel_for(in.height, 32, [&](std::size_t begin, std::size_t end, int) {
    ListedBlocks blocks(map, scratch, corner);
    OctantRows turns(in.width);
    OctantRow row = common;
    for (std::size_t v = begin; v < end; ++v) {
      row.depth = scratch.images.depth.data() + v * in.width;
      for (int a = 0; a < 3; ++a) {
        const double y = (static_cast<double>(v) - in.cy) / in.fy;
        row.first[a] = static_cast<float>((axes(a, 0) * (-in.cx / in.fx) + axes(a, 1) * y + axes(a, 2)) / octant);
        row.step[a] = static_cast<float>(axes(a, 0) / in.fx / octant);
      }
      turns.next(row);
      kernel(row);
      mark_row(row, alone, blocks, scratch);
    }
  });
}

void update_blocks(const Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context,
                   FusionScratch& scratch) {
  VoxelUpdate view{};
  view.depth = scratch.images.depth.data();
  view.eroded = settings.clearing > 0 ? scratch.images.eroded.data() : nullptr;
  view.color = in.color == nullptr ? nullptr : scratch.images.color.data();
  view.labels = in.labels;
  view.width = in.width, view.height = in.height;
  view.fx = in.fx, view.fy = in.fy, view.cx = in.cx, view.cy = in.cy;
  view.truncation = map.truncation, view.voxel = map.voxel, view.edge = settings.edge;
  view.clearing = settings.clearing, view.max_depth = settings.max_depth;
  view.rays_alone = settings.integrator == kRays, view.least_rays = settings.least_rays;
  view.weight_scale = kFullWeight / map.max_weight;
  view.max_free_weight = settings.max_free_weight * view.weight_scale;
  const Mat3d rotation = Mat3d::from(in.rotation);
  for (int axis = 0; axis < 3; ++axis) cast<float>(map.voxel * rotation.column(axis)).to(view.step[axis]);
  const auto kernel = GGSLAM_DISPATCH(context.isa, tsdf_fuse_block);
  context.pool.parallel_for(scratch.updates.size(), 8, [&](std::size_t begin, std::size_t end, int) {
    VoxelUpdate own = view;
    for (std::size_t n = begin; n < end; ++n) {
      FusionScratch::Update& update = scratch.updates[n];
      const Vec3d p = map.voxel * (kSide * cast<double>(vector_of(update.at)) + Vec3d::all(0.5));
      cast<float>(rotation * p + Vec3d::from(in.translation)).to(own.origin);
      own.points = map.points(map.block(update.row));
      own.octants = own.points != nullptr && scratch.marked[n] ? scratch.octants.data() + n * kVoxels : nullptr;
      const bool rays = settings.integrator == kRays || (settings.integrator == kHybrid && scratch.passed[n]);
      own.rays = rays ? scratch.rays.data() + n * kVoxels : nullptr;
      update.flags = kernel(own, *update.voxels);
    }
  });
}

uint16_t least_weight(const VoxelBlock& voxels) { return *std::min_element(voxels.weight, voxels.weight + kVoxels); }

// Blocks that are free throughout give their voxels back; those that got voxels for nothing are as they were before, or
// noted as gone: rows must not change while there are candidates left.
void finish_blocks(Tsdf& map, FusionScratch& scratch, FusionStats& stats) {
  for (const FusionScratch::Update& update : scratch.updates) {
    Block& block = map.block(update.row);
    const bool in_vain = update.is_new ? update.flags & kNoneSeen : update.was_free && !(update.flags & kInBand);
    if (update.flags & kAllFree) {
      if (!update.was_free || update.is_new) block.revision = map.revision;
      stats.freed += !update.was_free;
      stats.made += update.is_new;
      map.collapse(block, least_weight(*update.voxels));
    } else if (in_vain && update.is_new) {
      map.collapse(block, 0);
      scratch.gone.push_back(update.at);
    } else if (in_vain) {
      map.collapse(block, block.free_weight);
    } else if (update.flags & kChanged) {
      block.revision = map.revision;
      stats.made += update.is_new;
    }
  }
}

// What the candidates tell, in parts: a camera that looks far past its axis has many that turn out to hold nothing, whose
// voxels serve those that follow.
void fuse(Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context, FusionScratch& scratch,
          FusionStats& stats) {
  if (settings.points) map.count_points();
  scratch.gone.clear();
  for (std::size_t first = 0; first < scratch.candidates.size();) {
    first = make_blocks(map, settings, scratch, stats, first);
    if (map.counts_points()) mark_points(map, in, settings, context, scratch);
    if (settings.integrator != kProjection) cast_rays(map, in, settings, context, scratch);
    update_blocks(map, in, settings, context, scratch);
    finish_blocks(map, scratch, stats);
    stats.updated += scratch.updates.size();
  }
  for (const BlockCoordinates at : scratch.gone) map.erase(map.find(at));
}

}  // namespace

FusionStats integrate(Tsdf& map, FusionScratch& scratch, Context& context, const FusionInput& in,
                      const FusionSettings& settings) {
  FusionStats stats{};
  const auto start = Clock::now();
  prepare(in, settings, map.truncation, context, scratch.images);
  const auto prepared = Clock::now();
  select(map, in, settings, context, scratch);
  ++map.revision, ++map.views;
  const auto selected = Clock::now();
  fuse(map, in, settings, context, scratch, stats);
  stats.blocks = scratch.candidates.size();
  stats.prepare_ms = milliseconds(start, prepared), stats.select_ms = milliseconds(prepared, selected);
  stats.update_ms = milliseconds(selected, Clock::now());
  return stats;
}

int64_t decay(Tsdf& map, FusionScratch& scratch, Context& context, float factor, int least, bool spare_in_view) {
  ++map.revision;
  const auto kernel = GGSLAM_DISPATCH(context.isa, tsdf_decay_block);
  scratch.emptied.assign(map.size(), 0);
  context.pool.parallel_for(map.size(), 64, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t row = begin; row < end; ++row) {
      Block& block = map.block(row);
      if (block.frozen || (spare_in_view && map.views > 0 && block.seen == map.views)) continue;
      if (block.slot < 0) {
        const int weight = static_cast<int>(block.free_weight * factor + 0.5f);
        block.free_weight = static_cast<uint16_t>(weight < least ? 0 : weight);
        scratch.emptied[row] = block.free_weight == 0;
        continue;
      }
      const unsigned flags = kernel(*map.voxels(block), map.points(block), factor, least);
      if (flags & kChanged) block.revision = map.revision;
      scratch.emptied[row] = (flags & kNoneSeen) != 0;
    }
  });
  int64_t erased = 0;
  // From the last row down: an erased row is filled by the last one, which has been dealt with.
  for (std::size_t row = scratch.emptied.size(); row-- > 0;)
    if (scratch.emptied[row]) map.erase(row), ++erased;
  return erased;
}

}  // namespace ggslam::volumes
