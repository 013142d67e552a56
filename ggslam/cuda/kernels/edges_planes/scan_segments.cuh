// SPDX-License-Identifier: Apache-2.0
// Leaves small segments out of depth images: the rule of RangeSegments in ggslam/tracking/edges_planes/segments.py.
//
// Neighbours that belong together are joined in a forest: each place knows another one of its segment, or itself, and the
// root of a segment is the least of its places whatever the order in which it was joined (S. Komura, "GPU-based
// cluster-labeling algorithm without the use of conventional iteration", 2015).
#pragma once
#include "common/carver.cuh"
#include "edges_planes/scan_lines.cuh"

namespace ggslam::cuda {

constexpr int kSegmentThreads = 128;

struct SegmentWorkspace {
  float *ranges, *apart;  // [h, w]; how far neighbours on one surface may be apart by noise alone
  std::int32_t *parents;  // [h, w] a place of the same segment
  std::int32_t *sizes;    // [h, w] pixels of the segment whose root a place is
  std::size_t bytes;
};

inline SegmentWorkspace segment_workspace(void* block, const ScanSegmentsJob& small) {
  Carver carver(block);
  const std::int64_t places = static_cast<std::int64_t>(small.w) * small.h;
  SegmentWorkspace w;
  w.ranges = carver.take<float>(places), w.apart = carver.take<float>(places);
  w.parents = carver.take<std::int32_t>(places), w.sizes = carver.take<std::int32_t>(places);
  w.bytes = carver.used();
  return w;
}

// Each place is a segment of its own.
__global__ void __launch_bounds__(kSegmentThreads) begin_segments_kernel(FeatureScanJob job, SegmentWorkspace work) {
  const FeatureSettings& s = job.settings;
  const int i = static_cast<int>(blockIdx.x * kSegmentThreads + threadIdx.x);
  if (i >= job.small.w * job.small.h) return;
  const int v = i / job.small.w * s.pitch, u = i % job.small.w * s.pitch;
  const float depth = job.depth[static_cast<std::int64_t>(v) * s.width + u];
  const float z = fabsf(depth) <= 3.4028235e38f ? depth : 0.0f;  // what is not finite was not measured
  const float variance = __fmul_rn(__fmul_rn(s.noise_square, z), z);
  work.ranges[i] = __fmul_rn(z, job.small.lengths[i]);
  work.apart[i] = __fmul_rn(job.small.sigmas, __fadd_rn(s.noise_constant, variance));
  work.parents[i] = i;
  work.sizes[i] = 0;
}

__device__ inline int root_of(const std::int32_t* parents, int place) {
  for (int parent = __ldcg(parents + place); parent != place; parent = __ldcg(parents + place)) place = parent;
  return place;
}

__device__ inline void join_places(std::int32_t* parents, int one, int other) {
  for (;;) {
    one = root_of(parents, one), other = root_of(parents, other);
    if (one == other) return;
    if (one < other) {
      const int least = one;
      one = other, other = least;
    }
    if (atomicCAS(parents + one, one, other) == one) return;
  }
}

// Whether the line through both places makes a large enough angle with the farther one's ray.
__device__ inline bool are_one(const FeatureScanJob& job, const SegmentWorkspace& work, int one, int other, float sine,
                               float versine) {
  const float first = work.ranges[one], second = work.ranges[other];
  const float far = fmaxf(first, second), near = fminf(first, second);
  const float apart = fmaxf(far - near - fmaxf(work.apart[one], work.apart[other]), 0.0f);
  const float beside = __fadd_rn(apart, __fmul_rn(near, versine));
  return near > 0 && __fmul_rn(near, sine) > __fmul_rn(job.small.tangent, beside);
}

// Joins each place with the ones to its right and below it.
__global__ void __launch_bounds__(kSegmentThreads) join_segments_kernel(FeatureScanJob job, SegmentWorkspace work) {
  const ScanSegmentsJob& small = job.small;
  const int i = static_cast<int>(blockIdx.x * kSegmentThreads + threadIdx.x);
  if (i >= small.w * small.h) return;
  const int v = i / small.w, u = i % small.w, across = v * (small.w - 1) + u;
  if (u + 1 < small.w && are_one(job, work, i, i + 1, small.across_sine[across], small.across_versine[across]))
    join_places(work.parents, i, i + 1);
  if (v + 1 < small.h && are_one(job, work, i, i + small.w, small.down_sine[i], small.down_versine[i]))
    join_places(work.parents, i, i + small.w);
}

__global__ void __launch_bounds__(kSegmentThreads) count_segments_kernel(FeatureScanJob job, SegmentWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kSegmentThreads + threadIdx.x);
  if (i < job.small.w * job.small.h && work.ranges[i] > 0) atomicAdd(work.sizes + root_of(work.parents, i), 1);
}

// Depth of the pixels whose place was measured and is of a segment that is large enough.
__global__ void __launch_bounds__(kSegmentThreads) filter_segments_kernel(FeatureScanJob job, SegmentWorkspace work) {
  const FeatureSettings& s = job.settings;
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kSegmentThreads + threadIdx.x;
  if (pixel >= static_cast<std::int64_t>(s.width) * s.height) return;
  const int v = static_cast<int>(pixel / s.width), u = static_cast<int>(pixel % s.width);
  const int place = v / s.pitch * job.small.w + u / s.pitch;
  const bool kept = work.ranges[place] > 0 && work.sizes[root_of(work.parents, place)] >= job.small.least;
  job.small.filtered[pixel] = kept ? job.depth[pixel] : 0.0f;
}

inline void launch_scan_segments(const FeatureScanJob& job, void* workspace, cudaStream_t stream) {
  const SegmentWorkspace work = segment_workspace(workspace, job.small);
  const std::int64_t blocks = blocks_for(static_cast<std::int64_t>(job.small.w) * job.small.h, kSegmentThreads);
  const std::int64_t pixels = static_cast<std::int64_t>(job.settings.width) * job.settings.height;
  launch(begin_segments_kernel, blocks, kSegmentThreads, stream, job, work);
  launch(join_segments_kernel, blocks, kSegmentThreads, stream, job, work);
  launch(count_segments_kernel, blocks, kSegmentThreads, stream, job, work);
  launch(filter_segments_kernel, blocks_for(pixels, kSegmentThreads), kSegmentThreads, stream, job, work);
}

}  // namespace ggslam::cuda
