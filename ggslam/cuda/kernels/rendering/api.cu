// SPDX-License-Identifier: Apache-2.0
// The C interface. Calls only start work on the caller's stream; wait is the one that waits, and only for the
// projection. All return 0 or a cudaError_t.
#include <algorithm>
#include <cstring>
#include <new>

#include "rendering/binning.cuh"
#include "rendering/composite_forward.cuh"
#include "rendering/gather_kernel.cuh"
#include "common/host.cuh"
#include "rendering/count_pairs.cuh"
#include "rendering/project_kernel.cuh"
#include "common/sorting.cuh"

namespace ggslam::cuda {
namespace {

constexpr std::uint64_t kRecent = 64;

// Receives the totals of the last kRecent projections on the host; of several that were counted together the largest.
struct Counter {
  Totals* totals = nullptr;  // [kRecent] by turns, page-locked host memory
  std::uint64_t started = 0;
  cudaEvent_t ready = nullptr;  // after the last one's
};

cudaStream_t stream_of(const Rendering& r) { return static_cast<cudaStream_t>(r.stream); }

GaussianWorkspace gaussians_of(const Rendering& r) {
  return gaussian_workspace(r.gaussian_workspace, r.gaussians.count, r.gaussian_sorting_bytes);
}

PairWorkspace pairs_of(const Rendering& r) {
  return pair_workspace(r.pair_workspace, r.pair_capacity, r.pair_sorting_bytes);
}

std::uint32_t float_bits(float x) {
  std::uint32_t bits;
  __builtin_memcpy(&bits, &x, sizeof(bits));
  return bits;
}

// One more than the key of the farthest depth.
std::uint32_t hidden_key(const CameraView& view) { return float_bits(kMaxDepth) - float_bits(view.near_plane) + 1; }

// Calls run(group, number of channels to compile for) for the groups of feature channels; once, without any, if there
// are none.
template <class Run>
void for_each_group(const GaussianArrays& arrays, const Run& run) {
  const int channels = arrays.render_features ? arrays.feature_channels : 0;
  int first = 0;
  do {
    const int count = std::min(channels - first, kMaxFeatureGroup);
    run(FeatureGroup{first, count}, (count + 3) / 4 * 4);
    first += kMaxFeatureGroup;
  } while (first < channels);
}

void send_totals(Counter& counter, const void* totals, cudaStream_t stream) {
  cudaMemcpyAsync(counter.totals + counter.started++ % kRecent, totals, sizeof(Totals), cudaMemcpyDeviceToHost, stream);
  cudaEventRecord(counter.ready, stream);
}

cudaError_t project_all(const Rendering& r, Counter* counter) {
  const GaussianWorkspace w = gaussians_of(r);
  const cudaStream_t stream = stream_of(r);
  const std::uint32_t hidden = hidden_key(r.view);
  const std::int64_t n = r.gaussians.count;
  cudaMemsetAsync(w.totals, 0, sizeof(Totals), stream);
  launch(project_kernel, blocks_for(n, kProjectThreads), kProjectThreads, stream, r.gaussians, view_constants(r.view), r.pose,
         make_grid(r.view), float_bits(r.view.near_plane), hidden, w);
  if (counter != nullptr) send_totals(*counter, w.totals, stream);
  if (n == 0) return cudaSuccess;
  const cudaError_t sorted = sort_pairs(w.sorting, w.sorting_bytes, w.depth_keys, w.sorted_depth_keys, w.rows,
                                        w.rows_by_depth, n, bits_of(hidden), stream);
  if (sorted != cudaSuccess) return sorted;
  launch(gather_counts_kernel, blocks_for(n, kBinThreads), kBinThreads, stream, n, w);
  return running_sum(w.sorting, w.sorting_bytes, w.counts_by_depth, w.pair_ends, n, stream);
}

cudaError_t list_pairs(const Rendering& r, const Grid& grid, const GaussianWorkspace& w, const PairWorkspace& pairs,
                       const PixelWorkspace& pixels) {
  const cudaStream_t stream = stream_of(r);
  const std::uint32_t capacity = pairs.capacity;
  const std::int64_t n = r.gaussians.count;
  // Places that stay unwritten: all ones is beyond every tile, also in the lowest bits by which it is sorted.
  cudaMemsetAsync(pairs.tiles, 0xff, sizeof(std::uint32_t) * capacity, stream);
  launch(write_pairs_kernel, blocks_for(n, kBinThreads), kBinThreads, stream, n, grid, w, pairs);
  cudaError_t status = cudaSuccess;
  if (capacity > 0)
    status = sort_pairs(pairs.sorting, pairs.sorting_bytes, pairs.tiles, pairs.sorted_tiles, pairs.rows,
                        pairs.sorted_rows, capacity, bits_of(static_cast<std::uint32_t>(grid.tiles())), stream);
  launch(tile_starts_kernel, blocks_for(r.pair_capacity + 1, kBinThreads), kBinThreads, stream, w,
         pairs, grid.tiles(), pixels.tile_start, RoomReport{r.overflowed, r.overflows, r.most_pairs});
  return status;
}

cudaError_t composite_all(const Rendering& r) {
  const Grid grid = make_grid(r.view);
  const GaussianWorkspace w = gaussians_of(r);
  const PairWorkspace pairs = pairs_of(r);
  const PixelWorkspace pixels = pixel_workspace(r.pixel_workspace, grid);
  const cudaError_t listed = list_pairs(r, grid, w, pairs, pixels);
  if (listed != cudaSuccess) return listed;
  for_each_group(r.gaussians, [&](const FeatureGroup& group, int compiled) {
    const auto run = [&](auto kernel) {
      launch(kernel, grid.tiles(), kTileThreads, stream_of(r), r.gaussians, grid, w, pairs, pixels, r.targets, group);
    };
    if (compiled == 0) run(composite_kernel<0>);
    if (compiled == 4) run(composite_kernel<4>);
    if (compiled == 8) run(composite_kernel<8>);
    if (compiled == 12) run(composite_kernel<12>);
    if (compiled == 16) run(composite_kernel<16>);
  });
  return cudaSuccess;
}

void differentiate_images(const Rendering& r, const ImageGradients& in, const GradientRows& rows) {
  const Grid grid = make_grid(r.view);
  const GaussianWorkspace w = gaussians_of(r);
  const PairWorkspace pairs = pairs_of(r);
  const PixelWorkspace pixels = pixel_workspace(r.pixel_workspace, grid);
  for_each_group(r.gaussians, [&](const FeatureGroup& group, int compiled) {
    const auto run = [&](auto attached, auto detached) {
      launch(in.detach_features ? detached : attached, grid.tiles(), kTileThreads, stream_of(r), r.gaussians, grid, w,
             pairs, pixels, in, group, rows);
    };
    if (compiled == 0) run(differentiate_kernel<0, false>, differentiate_kernel<0, false>);
    if (compiled == 4) run(differentiate_kernel<4, false>, differentiate_kernel<4, true>);
    if (compiled == 8) run(differentiate_kernel<8, false>, differentiate_kernel<8, true>);
    if (compiled == 12) run(differentiate_kernel<12, false>, differentiate_kernel<12, true>);
    if (compiled == 16) run(differentiate_kernel<16, false>, differentiate_kernel<16, true>);
  });
}

// Writes gradients, or makes a step of Adam with them if there is one.
void gather(const Rendering& r, const GradientRows& rows, const GaussianGradients& out, const AdamStep* adam) {
  const cudaStream_t stream = stream_of(r);
  const std::int64_t n = r.gaussians.count, all = blocks_for(n, kGatherThreads);
  const auto run = [&](auto kernel, const auto& finish) {
    launch(kernel, std::min<std::int64_t>(all, kGatherBlocks), kGatherThreads, stream, r.gaussians,
           view_constants(r.view), r.pose, rows, out.twist, finish);
  };
  const int channels = r.gaussians.render_features ? r.gaussians.feature_channels : 0;
  if (adam != nullptr) {
    run(gather_kernel<StepParameters>, StepParameters{*adam});
    if (channels > 0) launch(step_features_kernel, all, kGatherThreads, stream, n, channels, rows, *adam);
    return;
  }
  run(gather_kernel<WriteGradients>, WriteGradients{out});
  if (out.features != nullptr && channels > 0)
    launch(gather_features_kernel, all, kGatherThreads, stream, n, channels, rows, out.features);
}

cudaError_t differentiate_all(const Rendering& r, const ImageGradients& in, const GaussianGradients& out,
                              const AdamStep* adam, float* row_memory) {
  const cudaStream_t stream = stream_of(r);
  const std::int64_t n = r.gaussians.count;
  const GradientRows rows{row_memory, gradient_stride(r.gaussians), out.touched};
  cudaMemsetAsync(out.twist, 0, 6 * sizeof(double), stream);
  if (n == 0) return cudaSuccess;
  cudaMemsetAsync(out.touched, 0, static_cast<std::size_t>(n), stream);
  launch(clear_rows_kernel, blocks_for(n, kGatherThreads), kGatherThreads, stream, n,
         gaussians_of(r).tile_counts, rows);
  differentiate_images(r, in, rows);
  gather(r, rows, out, adam);
  return cudaSuccess;
}

}  // namespace

void count_pairs(void* counter, const std::int64_t* totals, cudaStream_t stream) {
  send_totals(*static_cast<Counter*>(counter), totals, stream);
}

}  // namespace ggslam::cuda

using namespace ggslam::cuda;
using ggslam::GaussianGradients;
using ggslam::ImageGradients;

GGSLAM_EXPORT int ggslam_cuda_counter_create(int device, void** counter) {
  auto* c = new Counter;
  *counter = c;
  return on_device(device, [&] {
    const std::size_t bytes = kRecent * sizeof(Totals);
    const cudaError_t status = cudaHostAlloc(reinterpret_cast<void**>(&c->totals), bytes, cudaHostAllocDefault);
    if (status != cudaSuccess) return status;
    std::memset(c->totals, 0, bytes);
    return cudaEventCreateWithFlags(&c->ready, cudaEventDisableTiming);
  });
}

GGSLAM_EXPORT void ggslam_cuda_counter_destroy(void* counter) {
  auto* c = static_cast<Counter*>(counter);
  if (c->ready != nullptr) {
    cudaEventSynchronize(c->ready);  // nothing may be written to the totals any more
    cudaEventDestroy(c->ready);
  }
  if (c->totals != nullptr) cudaFreeHost(c->totals);
  delete c;
}

GGSLAM_EXPORT int ggslam_cuda_plan(Rendering* r, Sizes* sizes) {
  return on_device(r->device, [&] {
    r->gaussian_sorting_bytes = static_cast<std::int64_t>(sorting_bytes(r->gaussians.count));
    r->pair_sorting_bytes = static_cast<std::int64_t>(sorting_bytes(r->pair_capacity));
    sizes->gaussian_workspace =
        static_cast<std::int64_t>(gaussian_workspace(nullptr, r->gaussians.count, r->gaussian_sorting_bytes).bytes);
    sizes->pair_workspace =
        static_cast<std::int64_t>(pair_workspace(nullptr, r->pair_capacity, r->pair_sorting_bytes).bytes);
    sizes->pixel_workspace = static_cast<std::int64_t>(pixel_workspace(nullptr, make_grid(r->view)).bytes);
    sizes->gradient_rows = r->gaussians.count * gradient_stride(r->gaussians) * static_cast<std::int64_t>(sizeof(float));
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_project(const Rendering* r, void* counter) {
  return on_device(r->device, [&] { return project_all(*r, static_cast<Counter*>(counter)); });
}

GGSLAM_EXPORT int ggslam_cuda_wait(const void* counter, std::int64_t* totals) {
  const auto* c = static_cast<const Counter*>(counter);
  const cudaError_t status = cudaEventSynchronize(c->ready);
  const Totals& last = c->totals[(c->started + kRecent - 1) % kRecent];
  totals[0] = static_cast<std::int64_t>(last.visible);
  totals[1] = static_cast<std::int64_t>(last.pairs);
  return status;
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_recent_pairs(const void* counter) {
  const volatile Totals* totals = static_cast<const Counter*>(counter)->totals;
  std::uint64_t most = 0;
  for (std::uint64_t i = 0; i < kRecent; ++i) most = std::max<std::uint64_t>(most, totals[i].pairs);
  return static_cast<std::int64_t>(most);
}

GGSLAM_EXPORT int ggslam_cuda_composite(const Rendering* r) {
  return on_device(r->device, [&] { return composite_all(*r); });
}

GGSLAM_EXPORT int ggslam_cuda_render(const Rendering* r, void* counter) {
  return on_device(r->device, [&] {
    const cudaError_t projected = project_all(*r, static_cast<Counter*>(counter));
    return projected != cudaSuccess ? projected : composite_all(*r);
  });
}

GGSLAM_EXPORT int ggslam_cuda_backward(const Rendering* r, const ImageGradients* image_gradients,
                                       const GaussianGradients* gradients, const AdamStep* adam, float* row_memory) {
  return on_device(r->device, [&] { return differentiate_all(*r, *image_gradients, *gradients, adam, row_memory); });
}

