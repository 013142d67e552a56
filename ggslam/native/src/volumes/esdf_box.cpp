// SPDX-License-Identifier: Apache-2.0
// Distances of blocks in a box, from the sites in the box and around it.
#include <algorithm>
#include <cmath>

#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(void esdf_row(const ggslam::volumes::SiteCell* cells, int sites, int first, int x, int count,
                                    int32_t* out))
GGSLAM_DECLARE_KERNEL(void esdf_envelopes(const ggslam::volumes::EnvelopeLines& lines, bool along_z))
GGSLAM_DECLARE_KERNEL(ggslam::volumes::RefineOutput esdf_refine(const ggslam::volumes::RefineInput& in,
                                                                ggslam::volumes::FieldVoxels& out))

namespace ggslam::volumes {
namespace {

constexpr int kUnbounded = 1 << 20;  // voxels

// The neighbours among 3^3 voxels of the sites of slice z, row by row, appended to `neighbours`; sites are in order of
// z, y, x.
void link_slice(const std::vector<int32_t>& row_start, int rows_y, int rows_z, int z, std::vector<BoxSite>& sites,
                std::vector<int32_t>& neighbours) {
  for (int y = 0; y < rows_y; ++y) {
    int32_t from[9], end[9];  // sites of the rows around, those too far left left out
    int n = 0;
    for (int dz = -1; dz <= 1; ++dz)
      for (int dy = -1; dy <= 1; ++dy) {
        if (z + dz < 0 || z + dz >= rows_z || y + dy < 0 || y + dy >= rows_y) continue;
        const int row = (z + dz) * rows_y + y + dy;
        from[n] = row_start[row], end[n] = row_start[row + 1];
        n += from[n] < end[n];
      }
    for (int32_t s = row_start[z * rows_y + y]; s < row_start[z * rows_y + y + 1]; ++s) {
      BoxSite& site = sites[s];
      site.neighbours = static_cast<int32_t>(neighbours.size());
      for (int r = 0; r < n; ++r) {
        while (from[r] < end[r] && sites[from[r]].cell.x < site.cell.x - 1) ++from[r];
        for (int32_t o = from[r]; o < end[r] && sites[o].cell.x <= site.cell.x + 1; ++o)
          if (o != s) neighbours.push_back(o);
      }
      site.neighbour_count = static_cast<int16_t>(neighbours.size() - site.neighbours);
    }
  }
}

void link_neighbours(ThreadPool& pool, const std::vector<int32_t>& row_start, int rows_y, int rows_z,
                     std::vector<BoxSite>& sites, std::vector<int32_t>& neighbours) {
  std::vector<std::vector<int32_t>> slices(rows_z);
  pool.parallel_for(rows_z, 1, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t z = begin; z < end; ++z)
      link_slice(row_start, rows_y, rows_z, static_cast<int>(z), sites, slices[z]);
  });
  std::vector<int32_t> first(rows_z + 1, 0);
  for (int z = 0; z < rows_z; ++z) first[z + 1] = first[z] + static_cast<int32_t>(slices[z].size());
  neighbours.resize(first[rows_z]);
  pool.parallel_for(rows_z, 1, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t z = begin; z < end; ++z) {
      std::copy(slices[z].begin(), slices[z].end(), neighbours.begin() + first[z]);
      for (int32_t s = row_start[z * rows_y]; s < row_start[(z + 1) * rows_y]; ++s) sites[s].neighbours += first[z];
    }
  });
}

}  // namespace

// The sites in the voxels of `padded`, in order of z, y, x, with positions from `frame.low`; rows are those of `frame`.
void Esdf::collect(Context& context, const Box3i& padded, const Box3i& frame) {
  const int rows_y = static_cast<int>(frame.size(1)), rows_z = static_cast<int>(frame.size(2));
  std::vector<BoxSite> found;
  row_start_.assign(static_cast<std::size_t>(rows_y) * rows_z + 1, 0);
  const auto take = [&](std::size_t row) {
    const Vec3i at = vector_of(table_.at(row));
    for (const Site& site : blocks_[row].sites) {
      const Vec3i v = kSide * at + voxel_of(site.voxel);
      if (!padded.contains(v)) continue;
      const auto cell = cast<int16_t>(v - frame.low);
      BoxSite s{};
      s.cell = {cell[0], cell[1], cell[2]};
      std::copy_n(site.point, 3, s.point);
      std::copy_n(site.normal, 3, s.normal);
      found.push_back(s);
      ++row_start_[s.cell.z * rows_y + s.cell.y + 1];
    }
  };
  for (std::size_t row = 0; row < blocks_.size(); ++row) {
    if (blocks_[row].sites.empty()) continue;
    if (padded.intersects(box_of(table_.at(row)).scale(kSide))) take(row);
  }
  for (std::size_t r = 1; r < row_start_.size(); ++r) row_start_[r] += row_start_[r - 1];
  sites_.resize(found.size());
  std::vector<int32_t> next(row_start_.begin(), row_start_.end() - 1);
  for (const BoxSite& s : found) {
    // Rows are short: put in by moving up those to the right.
    const int32_t row = s.cell.z * rows_y + s.cell.y;
    int32_t p = next[row]++;
    for (; p > row_start_[row] && sites_[p - 1].cell.x > s.cell.x; --p) sites_[p] = sites_[p - 1];
    sites_[p] = s;
  }
  cells_.resize(sites_.size());
  for (std::size_t s = 0; s < sites_.size(); ++s) cells_[s] = sites_[s].cell;
  link_neighbours(context.pool, row_start_, rows_y, rows_z, sites_, neighbours_);
}

// Fills nearest_: [y in box][z in frame][x in box], of which those z in the box count.
void Esdf::transform(Context& context, const Box3i& box, const Box3i& frame) {
  const int rows_y = static_cast<int>(frame.size(1)), rows_z = static_cast<int>(frame.size(2));
  const int columns = static_cast<int>(box.size(0)), x = box.low[0] - frame.low[0];
  const std::size_t slice = static_cast<std::size_t>(rows_z) * columns;
  const float farthest = max_distance_ + kCentreSlack;
  EnvelopeLines lines{};
  lines.cells = cells_.data();
  lines.x = x, lines.columns = columns;
  lines.limit = static_cast<int>(std::ceil(farthest * farthest));
  along_x_.reserve(static_cast<std::size_t>(rows_y) * slice);
  nearest_.reserve(box.size(1) * slice);
  const auto row_kernel = GGSLAM_DISPATCH(context.isa, esdf_row);
  const auto envelope_kernel = GGSLAM_DISPATCH(context.isa, esdf_envelopes);
  std::vector<uint8_t> filled(rows_z, 0);
  context.pool.parallel_for(rows_z, 1, [&](std::size_t begin, std::size_t end, int) {
    std::vector<int32_t> positions;
    for (std::size_t z = begin; z < end; ++z) {
      positions.clear();
      int32_t* from = along_x_.data() + z * rows_y * columns;
      for (int y = 0; y < rows_y; ++y) {
        const int32_t first = row_start_[z * rows_y + y], count = row_start_[z * rows_y + y + 1] - first;
        if (count == 0) continue;
        positions.push_back(y);
        row_kernel(cells_.data() + first, count, first, x, columns, from + static_cast<std::size_t>(y) * columns);
      }
      if (positions.empty()) continue;
      filled[z] = 1;
      EnvelopeLines along_y = lines;
      along_y.in = from, along_y.in_stride = columns;
      along_y.positions = positions.data(), along_y.count = static_cast<int>(positions.size());
      along_y.out = nearest_.data() + z * columns, along_y.out_stride = slice;
      along_y.first = box.low[1] - frame.low[1], along_y.last = box.high[1] - frame.low[1];
      envelope_kernel(along_y, false);
    }
  });
  std::vector<int32_t> slices;
  for (int z = 0; z < rows_z; ++z)
    if (filled[z]) slices.push_back(z);
  context.pool.parallel_for(box.size(1), 1, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t y = begin; y < end; ++y) {
      EnvelopeLines along_z = lines;
      int32_t* plane = nearest_.data() + y * slice;
      along_z.in = plane, along_z.in_stride = columns;
      along_z.positions = slices.data(), along_z.count = static_cast<int>(slices.size());
      along_z.first = box.low[2] - frame.low[2], along_z.last = box.high[2] - frame.low[2];
      along_z.out = plane + static_cast<std::size_t>(along_z.first) * columns, along_z.out_stride = columns;
      along_z.y = box.low[1] - frame.low[1] + static_cast<int>(y);
      envelope_kernel(along_z, true);
    }
  });
}

void Esdf::solve(Context& context, const std::vector<Task>& tasks, const Box3i& blocks, FieldStats& stats,
                 std::vector<Task>& again) {
  float pad = 0;
  for (const Task& task : tasks) pad = std::max(pad, task.pad);
  const Box3i padded = padded_box(blocks, pad, bounds_);
  const Box3i box = blocks.scale(kSide);
  Box3i frame = box;
  frame.include(padded);
  collect(context, padded, frame);
  transform(context, box, frame);
  stats.transformed += box.size(0) * box.size(1) * box.size(2);

  RefineInput common{};
  common.sites = sites_.data(), common.cells = cells_.data(), common.neighbours = neighbours_.data();
  common.stride_z = box.size(0), common.stride_y = common.stride_z * frame.size(2);
  common.voxel = tsdf_.voxel, common.max_distance = max_distance_;
  for (int a = 0; a < 3; ++a) {
    // Beyond the blocks with sites there is nothing to miss.
    common.low[a] = padded.low[a] <= kSide * bounds_.low[a] ? -kUnbounded : padded.low[a] - frame.low[a];
    common.high[a] = padded.high[a] >= kSide * bounds_.high[a] ? kUnbounded : padded.high[a] - frame.low[a];
  }
  std::vector<RefineOutput> results(tasks.size());
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_refine);
  context.pool.parallel_for(tasks.size(), 4, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t i = begin; i < end; ++i) {
      FieldBlock& block = blocks_[tasks[i].row];
      const Vec3i first = kSide * vector_of(table_.at(tasks[i].row));
      RefineInput in = common;
      (first - frame.low).to(in.origin);
      in.nearest = nearest_.data() + (first[1] - box.low[1]) * in.stride_y + in.origin[2] * in.stride_z +
                   (first[0] - box.low[0]);
      in.known = block.known, in.negative = block.negative;
      if (!block.voxels) block.voxels = std::make_unique<FieldVoxels>();
      results[i] = kernel(in, *block.voxels);
      block.required = results[i].required;
    }
  });
  for (std::size_t i = 0; i < tasks.size(); ++i)
    if (results[i].missing > 0) again.push_back({tasks[i].row, results[i].required});
}

}  // namespace ggslam::volumes
