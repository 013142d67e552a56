// SPDX-License-Identifier: Apache-2.0
// Runs the stages of the rasterizer over blocks and tiles, and exports them with a C interface.
#include "rendering/rasterizer.hpp"

#include <algorithm>
#include <cstring>

#include "common/guard.hpp"

namespace ggslam {
namespace {

enum Status { kDone = 0, kTooManyPairs = 2 };

void check_input(const GaussianArrays& g, const CameraView& view, const RenderTargets& targets) {
  check_range<std::int64_t>("gaussians", g.count, 0, std::int64_t{1} << 30);
  const void* const arrays[] = {g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh};
  for (const void* array : arrays) check_array("gaussians", array, g.count);
  check_range("sh_coefficients", g.sh_coefficients, 1, 16);
  check_range("active_sh_coefficients", g.active_sh_coefficients, 1, g.sh_coefficients);
  check_range("width", view.width, 1, kMostPixelsAlong);
  check_range("height", view.height, 1, kMostPixelsAlong);
  const float numbers[] = {view.fx, view.fy, view.cx, view.cy, view.near_plane, view.low_pass};
  check_within("camera", numbers, 6, 1e9);
  check_within("close_below", &view.close_below, 1, 0.5);
  check_within("camera's pose", view.camera_world, 12, 1e12);
  check_array("image", targets.image, 1), check_array("depth", targets.depth, 1), check_array("alpha", targets.alpha, 1);
  if (!g.render_features) return;
  check_range("feature_channels", g.feature_channels, 1, 1 << 12);
  check_array("features", g.features, g.count), check_array("rendered features", targets.features, 1);
}

void check_adam(const Rasterizer& r, const AdamArguments& adam) {
  const std::int64_t count = r.gaussians.count;
  const AdamArrays groups[] = {adam.means, adam.quaternions, adam.log_scales, adam.opacity_logits, adam.sh, adam.features};
  for (int k = 0; k < (r.padded_features > 0 ? 6 : 5); ++k)
    for (const void* array : {groups[k].parameters, groups[k].first_moments, groups[k].second_moments})
      check_array("parameters and moments", array, count);
  check_array("updates", adam.updates, count), check_array("schedule", adam.schedule, 1);
  check_range("schedule_rows", adam.schedule_rows, 1, 1 << 30);
}

void check_backward(const Rasterizer& r, const GaussianGradients& out, const AdamArguments* adam) {
  if (!r.ready) refuse("rasterizer: there is no picture to differentiate");
  if (r.as_3dgs) refuse("rasterizer: pictures by the rules of 3DGS have no gradients");
  check_array("twist", out.twist, 6), check_array("touched", out.touched, r.gaussians.count);
  if (adam != nullptr) return check_adam(r, *adam);
  const void* const arrays[] = {out.quaternions, out.log_scales, out.opacity_logits, out.sh};
  for (const void* array : arrays)
    if ((array == nullptr) != (out.means == nullptr)) refuse("gradients: expected all arrays or none");
  if (out.means != nullptr && r.padded_features > 0) check_array("gradients of features", out.features, r.gaussians.count);
}

void prepare(Rasterizer& r, const GaussianArrays& gaussians, const CameraView& view) {
  r.gaussians = gaussians;
  r.view = view;
  r.padded_features = gaussians.render_features ? (gaussians.feature_channels + 3) / 4 * 4 : 0;
  r.tile = GGSLAM_DISPATCH(r.context.isa, tile_layout)();
  r.tiles_x = (view.width + r.tile.width - 1) / r.tile.width;
  r.tiles_y = (view.height + r.tile.height - 1) / r.tile.height;

  // The cut into blocks must not depend on the number of threads: the pose gradient is summed block by block.
  r.block_shift = 10;
  while ((gaussians.count >> r.block_shift) >= kMaxBlocks) ++r.block_shift;
  r.block_size = std::int64_t{1} << r.block_shift;
  r.blocks = static_cast<int>((gaussians.count + r.block_size - 1) >> r.block_shift);

  const std::size_t tiles = r.tiles(), pixels = tiles * r.tile.width * r.tile.height;
  r.splats.reserve(static_cast<std::size_t>(r.blocks) * r.block_size);
  r.footprints.reserve(static_cast<std::size_t>(r.blocks) * r.block_size);
  r.tile_cursor.reserve(r.blocks * (tiles + 1));
  r.tile_start.reserve(tiles + 1);
  r.transmittance.reserve(pixels);
  r.last_entry.reserve(pixels);
  // Scratch is reserved here, never in a kernel.
  for (int t = 0; t < r.context.pool.size(); ++t) {
    r.scratch[t].pixel_features.reserve(std::size_t{kSubBlocks} * r.tile.lanes * r.padded_features);
    r.scratch[t].gaussian_features.reserve(std::size_t{kChunk} * r.padded_features);
    r.scratch[t].contributions.reserve(std::size_t{2} * kChunk * kSubBlocks * r.tile.lanes);
  }
}

// Turns the blocks' tile counts into the places of their entries: tile by tile and, within a tile, block by block, so
// that a tile's list starts in the order of the Gaussians. False if there are too many pairs to number.
bool allot_pairs(Rasterizer& r) {
  r.pair_count = 0;
  for (int b = 0; b < r.blocks; ++b) {
    const std::uint64_t here = r.pairs[b];
    r.pairs[b] = r.pair_count;
    r.pair_count += here;
  }
  if (r.pair_count >= (std::uint64_t{1} << 31)) return false;
  std::uint32_t next = 0, longest = 0;
  const int tiles = r.tiles();
  for (int tile = 0; tile < tiles; ++tile) {
    r.tile_start[tile] = next;
    for (int b = 0; b < r.blocks; ++b) {
      std::uint32_t& cursor = r.cursors(b)[tile];
      const std::uint32_t here = cursor;
      cursor = next;
      next += here;
    }
    longest = std::max(longest, next - r.tile_start[tile]);
  }
  r.tile_start[tiles] = next;
  for (int t = 0; t < r.context.pool.size(); ++t) r.scratch[t].sorting.reserve(longest);
  r.entries.reserve(r.pair_count + kMaxBlocks);
  r.contributed.reserve(r.pair_count + kChunk);  // written in whole chunks
  return true;
}

Status forward(Rasterizer& r, const GaussianArrays& gaussians, const CameraView& view, const RenderTargets& targets) {
  prepare(r, gaussians, view);
  [[maybe_unused]] const Isa isa = r.context.isa;
  ThreadPool& pool = r.context.pool;
  const auto project = GGSLAM_DISPATCH(isa, project_block);
  const auto scatter = GGSLAM_DISPATCH(isa, scatter_block);
  const auto render = GGSLAM_DISPATCH(isa, forward_tile);
  pool.parallel_for(r.blocks, 1, [&](std::size_t b, std::size_t, int) { project(r, static_cast<int>(b)); });
  if (!allot_pairs(r)) return kTooManyPairs;
  pool.parallel_for(r.blocks, 1, [&](std::size_t b, std::size_t, int) { scatter(r, static_cast<int>(b)); });
  pool.parallel_for(r.tiles(), 1, [&](std::size_t tile, std::size_t, int thread) {
    render(r, static_cast<int>(tile), targets, r.scratch[thread]);
  });
  return kDone;
}

Status backward(Rasterizer& r, const ImageGradients& image_gradients, const GaussianGradients& gradients,
                const AdamArguments* adam) {
  [[maybe_unused]] const Isa isa = r.context.isa;
  ThreadPool& pool = r.context.pool;
  const auto differentiate = GGSLAM_DISPATCH(isa, backward_tile);
  const auto gather = GGSLAM_DISPATCH(isa, gather_block);
  r.slots.reserve((r.pair_count + kSlotsAtOnce) * kSlotStride);
  r.feature_slots.reserve(r.pair_count * r.padded_features);
  r.slot_used.reserve(r.pair_count + kSlotsAtOnce);
  r.block_twist.reserve(6 * kMaxBlocks);
  if (r.pair_count > 0) std::memset(r.slot_used.data(), 0, r.pair_count);

  pool.parallel_for(r.tiles(), 1, [&](std::size_t tile, std::size_t, int thread) {
    differentiate(r, static_cast<int>(tile), image_gradients, r.scratch[thread]);
  });
  pool.parallel_for(r.blocks, 1, [&](std::size_t b, std::size_t, int thread) {
    gather(r, static_cast<int>(b), gradients, adam, r.scratch[thread]);
  });
  for (int k = 0; k < 6; ++k) {
    gradients.twist[k] = 0.0;
    for (int b = 0; b < r.blocks; ++b) gradients.twist[k] += r.block_twist[6 * b + k];
  }
  return kDone;
}

}  // namespace
}  // namespace ggslam

using namespace ggslam;

GGSLAM_EXPORT void* ggslam_rasterizer_create(void* context) try {
  return new Rasterizer(object_of<Context>(context));
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_rasterizer_destroy(void* rasterizer) try {
  delete static_cast<Rasterizer*>(rasterizer);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_rasterizer_forward(void* rasterizer, const GaussianArrays* gaussians, const CameraView* view,
                                            const RenderTargets* targets, int as_3dgs) try {
  Rasterizer& r = object_of<Rasterizer>(rasterizer);
  check_input(object_of<GaussianArrays>(gaussians), object_of<CameraView>(view), object_of<RenderTargets>(targets));
  r.as_3dgs = as_3dgs != 0;
  r.ready = false;
  const Status status = forward(r, *gaussians, *view, *targets);
  r.ready = status == kDone;
  return status;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_rasterizer_backward(void* rasterizer, const ImageGradients* image_gradients,
                                             const GaussianGradients* gradients, const AdamArguments* adam) try {
  Rasterizer& r = object_of<Rasterizer>(rasterizer);
  check_backward(r, object_of<GaussianGradients>(gradients), adam);
  return backward(r, object_of<ImageGradients>(image_gradients), *gradients, adam);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_rasterizer_statistics(void* rasterizer, std::int64_t* out) try {
  const Rasterizer& r = object_of<Rasterizer>(rasterizer);
  check_array("out", out, 2);
  out[0] = 0;
  for (int b = 0; b < r.blocks; ++b) out[0] += r.visible[b];
  out[1] = static_cast<std::int64_t>(r.pair_count);
  return 0;
} GGSLAM_CATCH_ALL
