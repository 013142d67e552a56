// SPDX-License-Identifier: Apache-2.0
// The C interface of fusing a view.
#include <cmath>

#include "common/host.cuh"
#include "volumes/fuse_voxels.cuh"

using namespace ggslam::cuda;

namespace {

double floor_div(double a, double b) { return std::floor(a / b); }

BlockCamera camera_of(const FuseJob& job) {
  BlockCamera c = block_camera(job.width, job.height, job.fx, job.fy, job.cx, job.cy, job.rotation, job.translation,
                               static_cast<double>(job.map.voxel) * kSide);
  c.truncation = job.map.truncation, c.max_depth = job.settings.max_depth, c.free_share = job.settings.free_share;
  return c;
}

// Cubes that enclose what is in view, at most kMostCells.
SearchCells cells_of(const BlockCamera& c) {
  double low[3], high[3];
  seen_box(c, static_cast<double>(c.max_depth) + static_cast<double>(c.truncation), low, high);
  SearchCells cells{};
  cells.side = 4;
  double count[3];
  do {
    cells.side *= 2;
    const double edge = cells.side * c.block, most = kKeyOffset / cells.side - 1;
    for (int a = 0; a < 3; ++a) {  // what is farther than keys reach is not looked at
      const double first = std::fmax(floor_div(low[a], edge), -most), last = std::fmin(floor_div(high[a], edge), most);
      count[a] = std::fmax(last - first + 1, 0.0);
      cells.first[a] = static_cast<std::int32_t>(std::fmin(first, most));
      cells.count[a] = static_cast<std::int32_t>(count[a]);
    }
  } while (count[0] * count[1] * count[2] > kMostCells);
  return cells;
}

VoxelView voxel_view_of(const FuseJob& job) {
  VoxelView v{};
  v.depth = job.prepared, v.eroded = job.settings.clearing > 0 ? job.eroded : nullptr;
  v.width = job.width, v.height = job.height;
  v.fx = job.fx, v.fy = job.fy, v.cx = job.cx, v.cy = job.cy;
  v.truncation = job.map.truncation, v.voxel = job.map.voxel, v.edge = job.settings.edge;
  v.clearing = job.settings.clearing, v.max_depth = job.settings.max_depth;
  v.weight_scale = static_cast<float>(ggslam::volumes::kFullWeight) / job.map.max_weight;
  v.max_free_weight = job.settings.max_free_weight * v.weight_scale;
  for (int k = 0; k < 9; ++k) v.rotation[k] = job.rotation[k];
  for (int a = 0; a < 3; ++a) {
    v.translation[a] = job.translation[a];
    for (int b = 0; b < 3; ++b)
      v.step[b][a] = static_cast<float>(static_cast<double>(job.map.voxel) * job.rotation[3 * a + b]);
  }
  return v;
}

OctantView octant_view_of(const FuseJob& job, const BlockCamera& c) {
  constexpr int kOctants = 2 * kSide;  // along the edge of a block
  OctantView v{};
  v.octant = 0.5 * static_cast<double>(job.map.voxel);
  v.across = 1.0 / static_cast<double>(job.fx), v.down = 1.0 / static_cast<double>(job.fy);
  v.cx = static_cast<double>(job.cx), v.cy = static_cast<double>(job.cy);
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) v.axes[3 * a + b] = job.rotation[3 * b + a];
    const double position = c.position[a] / (kOctants * v.octant), corner = std::floor(position);
    v.corner[a] = static_cast<std::int32_t>(corner);
    v.origin[a] = static_cast<float>(kOctants * (position - corner));
  }
  return v;
}

RayView ray_view_of(const FuseJob& job, const BlockCamera& c) {
  RayView v{};
  v.voxel = static_cast<double>(job.map.voxel);
  v.across = 1.0 / static_cast<double>(job.fx), v.down = 1.0 / static_cast<double>(job.fy);
  v.cx = static_cast<double>(job.cx), v.cy = static_cast<double>(job.cy);
  v.truncation = static_cast<double>(job.map.truncation / job.map.voxel);
  v.radius = ggslam::volumes::kRayRadius / v.voxel;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) v.axes[3 * a + b] = job.rotation[3 * b + a];
    const double position = c.position[a] / v.voxel, corner = std::floor(position / kSide);
    v.corner[a] = static_cast<std::int32_t>(corner);
    v.position[a] = position - kSide * corner;
    v.depth_offset -= v.axes[3 * a + 2] * v.position[a];
  }
  return v;
}

void prepare_images(const FuseJob& job, const TilePyramid& pyramid, cudaStream_t stream) {
  const std::int64_t pixels = static_cast<std::int64_t>(job.width) * job.height;
  launch(prepare_depth_kernel, blocks_for(pyramid.first[1], kPixelThreads), kPixelThreads, stream, job, pyramid);
  launch(finish_tiles_kernel, 1, kTotalThreads, stream, job, pyramid);
  if (job.settings.clearing > 0) launch(erode_kernel, blocks_for(pixels, kPixelThreads), kPixelThreads, stream, job);
}

// All that is started takes its arguments by value.
void fuse(const FuseJob& job, cudaStream_t stream) {
  const TilePyramid pyramid = pyramid_of(job.width, job.height);
  const BlockCamera camera = camera_of(job);
  const SearchCells cells = cells_of(camera);
  const std::int64_t pixels = static_cast<std::int64_t>(job.width) * job.height;
  prepare_images(job, pyramid, stream);
  int level = 0;
  for (int side = cells.side; side >= 1; side /= 2, ++level) {
    const std::int64_t blocks = level == 0 ? blocks_for(cells.all(), kListThreads) : job.grid;
    launch(search_kernel, blocks, kListThreads, stream, job, pyramid, camera, cells, level, side);
  }
  launch(admit_kernel, 1, kWarp, stream, job);
  launch(make_blocks_kernel, job.grid, kListThreads, stream, job);
  launch(settle_kernel, 1, kWarp, stream, job.map);
  if (job.map.points != nullptr)
    launch(mark_points_kernel, blocks_for(pixels, kPixelThreads), kPixelThreads, stream, job, octant_view_of(job, camera));
  if (job.rays != nullptr)
    launch(cast_rays_kernel, blocks_for(pixels, kPixelThreads), kPixelThreads, stream, job, ray_view_of(job, camera));
  launch(fuse_kernel, job.grid, kVoxels, stream, job, voxel_view_of(job));
}

}  // namespace

GGSLAM_EXPORT std::int64_t ggslam_cuda_fuse_tiles(std::int32_t width, std::int32_t height) {
  const TilePyramid pyramid = pyramid_of(width, height);
  return 2 * pyramid.first[pyramid.levels];
}

GGSLAM_EXPORT int ggslam_cuda_fuse(const FuseJob* job) {
  return on_device(job->device, [&] {
    fuse(*job, static_cast<cudaStream_t>(job->stream));
    return cudaSuccess;
  });
}
