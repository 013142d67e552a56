// SPDX-License-Identifier: Apache-2.0
// Rays are set up here, in a file compiled without fused multiply-adds, with the mixture of float and double of
// OctoMap's computeRayKeys, so that they pass exactly the same voxels (Amanatides and Woo, "A fast voxel traversal
// algorithm for ray tracing", 1987).
#include "volumes/scan_rays.hpp"

#include <algorithm>
#include <limits>

GGSLAM_DECLARE_KERNEL(void quantize_points(const float* points, std::size_t n, double factor, std::int64_t* codes))
GGSLAM_DECLARE_KERNEL(void walk_rays(const RayBatch& batch, std::uint64_t start, VoxelMasks& free))

namespace ggslam {
namespace {

// Free blocks of a scan: those of rays that cross the whole grid would fill all memory.
constexpr std::size_t kMostFreeBlocks = std::size_t{1} << 22;

constexpr std::size_t kRayChunk = 1024, kPointChunk = 8192;

struct Origin {
  Vec3f point;
  Vec3i key;
  std::uint64_t code;
};

double norm(const Vec3f& v) { return std::sqrt(static_cast<double>(dot(v, v))); }

// Puts the ray from the origin to `end` into the batch; the two lie in different voxels.
void prepare_ray(const KeyGrid& grid, const Origin& origin, const Vec3f& end, std::uint64_t end_code,
                 RayBatch& batch) {
  const std::uint64_t axes[3] = {kAxisX, kAxisY, kAxisZ};
  const int i = batch.count++;
  const Vec3f way = end - origin.point;
  const float length = static_cast<float>(norm(way));
  const Vec3f direction = way / length;
  for (int a = 0; a < 3; ++a) {
    const int sign = direction[a] > 0 ? 1 : direction[a] < 0 ? -1 : 0;
    // One less is, within an axis of a Morton code, the addition of all its bits.
    batch.step[a][i] = sign > 0 ? std::int64_t{1} << a : sign < 0 ? static_cast<std::int64_t>(axes[a]) : 0;
    batch.t[a][i] = batch.delta[a][i] = std::numeric_limits<double>::max();
    if (sign == 0) continue;
    double border = key_centre(grid, origin.key[a]);
    border += static_cast<float>(sign * grid.resolution * 0.5);
    batch.t[a][i] = (border - origin.point[a]) / direction[a];
    batch.delta[a][i] = grid.resolution / std::fabs(static_cast<double>(direction[a]));
  }
  batch.length[i] = length;
  batch.end[i] = static_cast<std::int64_t>(end_code);
}

// The end of a ray that is cut at the range; false: the point is nearer.
bool cut_at_range(const Origin& origin, const Vec3f& point, double max_range, Vec3f& end) {
  const Vec3f way = point - origin.point;
  const double distance = norm(way);
  if (max_range < 0 || distance <= max_range) return false;
  end = origin.point + static_cast<float>(max_range) * (way / static_cast<float>(distance));
  return true;
}

void list_centres(const KeyGrid& grid, const VoxelMasks& voxels, std::vector<float>& centres) {
  centres.clear();
  for_each_voxel(voxels, [&](std::uint64_t code) {
    const Vec3i key = keys_of_morton(code);
    for (const int k : key.v) centres.push_back(static_cast<float>(key_centre(grid, k)));
  });
}

}  // namespace

std::uint64_t* free_block(VoxelMasks& masks, std::uint64_t code) { return masks.block(code); }

void quantize(Context& context, const KeyGrid& grid, const float* points, std::size_t n,
              std::vector<std::int64_t>& codes, VoxelMasks& voxels) {
  const auto kernel = GGSLAM_DISPATCH(context.isa, quantize_points);
  codes.resize(n);
  context.pool.parallel_for(n, kPointChunk, [&](std::size_t begin, std::size_t end, int) {
    kernel(points + 3 * begin, end - begin, grid.factor, codes.data() + begin);
  });
  voxels.clear();
  for (std::size_t i = 0; i < n; ++i)
    if (codes[i] >= 0) voxels.insert(static_cast<std::uint64_t>(codes[i]));
}

void PointCounts::take(const std::vector<std::int64_t>& codes, const VoxelMasks& set) {
  voxels = &set;
  first.resize(set.blocks() * kMaskWords);
  std::size_t total = 0;
  for (std::size_t b = 0; b < set.blocks(); ++b)
    for (int w = 0; w < kMaskWords; ++w) {
      first[b * kMaskWords + w] = total;
      total += __builtin_popcountll(set.words(b)[w]);
    }
  counts.assign(total, 0);
  for (const std::int64_t code : codes) {
    if (code < 0) continue;
    const std::size_t word = set.index(static_cast<std::uint64_t>(code) >> 9) * kMaskWords + ((code >> 6) & 7);
    const std::uint64_t below = (std::uint64_t{1} << (code & 63)) - 1;
    const std::uint64_t bits = set.words(word / kMaskWords)[word % kMaskWords];
    ++counts[first[word] + __builtin_popcountll(bits & below)];
  }
}

bool Scan::cast(Context& context, const KeyGrid& grid, const ScanSettings& settings, const float* points,
                std::size_t n, const std::vector<float>& empty) {
  Vec3i key;
  if (!key_of_point(grid, Vec3f::from(settings.origin), key)) return false;
  while (workers_.size() < static_cast<std::size_t>(context.pool.size())) {
    workers_.emplace_back(new Worker);
    workers_.back()->free.limit(kMostFreeBlocks);
  }
  for (auto& worker : workers_) worker->free.clear(), worker->occupied.clear(), worker->rays = worker->batch.count = 0;
  counts_.voxels = nullptr;
  cast_to(context, grid, settings, points, n, false);
  if (!empty.empty()) cast_to(context, grid, settings, empty.data(), empty.size() / 3, true);
  rays_ = workers_[0]->rays;
  for (std::size_t w = 1; w < workers_.size(); ++w) {
    workers_[0]->free.unite(workers_[w]->free);
    workers_[0]->occupied.unite(workers_[w]->occupied);
    rays_ += workers_[w]->rays;
  }
  return true;
}

// Rays to n points, at which there is something unless they are `empty`.
void Scan::cast_to(Context& context, const KeyGrid& grid, const ScanSettings& settings, const float* points,
                   std::size_t n, bool empty) {
  Origin origin{Vec3f::from(settings.origin), {}, 0};
  key_of_point(grid, origin.point, origin.key);
  origin.code = morton_code(origin.key);
  if (settings.quantize) {
    quantize(context, grid, points, n, codes_, voxels_);
    list_centres(grid, voxels_, centres_);
    if (settings.count && !empty) counts_.take(codes_, voxels_);
    points = centres_.data(), n = centres_.size() / 3;
  }
  const auto walk = GGSLAM_DISPATCH(context.isa, walk_rays);
  const auto flush = [&](Worker& worker) {
    if (worker.batch.count == 0) return;
    worker.free.insert(origin.code);
    walk(worker.batch, origin.code, worker.free);
    worker.batch.count = 0;
  };
  context.pool.parallel_for(n, kRayChunk, [&](std::size_t begin, std::size_t end, int thread) {
    Worker& worker = *workers_[thread];
    for (std::size_t i = begin; i < end; ++i) {
      const Vec3f point = Vec3f::from(points + 3 * i);
      Vec3f cut;
      Vec3i key;
      if (!key_of_point(grid, point, key)) continue;
      const Vec3i whole = key;
      const bool beyond = cut_at_range(origin, point, settings.max_range, cut);
      if (beyond && !key_of_point(grid, cut, key)) continue;
      const std::uint64_t code = morton_code(key);
      if (!beyond && !empty) worker.occupied.insert(code);
      // OctoMap leaves out the last voxel of a ray that is cut, so that what was there once stays for ever.
      if (empty || (settings.last_voxel && beyond && !(key == whole))) worker.free.insert(code);
      if (code == origin.code) continue;
      ++worker.rays;
      prepare_ray(grid, origin, beyond ? cut : point, code, worker.batch);
      if (worker.batch.count == kRayBatch) flush(worker);
    }
    flush(worker);
  });
}

}  // namespace ggslam
