// SPDX-License-Identifier: Apache-2.0
// Alignment of a frame's points to a target: Levenberg-Marquardt from the coarse voxels to the fine ones, without the
// host. One launch linearises at the candidate pose, and the block that finishes last sums up what all blocks found, in
// their order, and takes the step. The host starts as many launches as the iterations that are allowed; those that come
// after convergence return at once.
#pragma once
#include "common/host.cuh"
#include "common/warp_reduction.cuh"
#include "tracking/levenberg_marquardt.cuh"

namespace ggslam::cuda {

constexpr int kAlignThreads = 128;
constexpr int kAlignWarps = kAlignThreads / kWarp;
constexpr int kAlignBlocksPerProcessor = 4;  // lets a thread have 128 registers: points are few, latency is what counts
constexpr int kSumStride = 48;  // sums of a block: the most that either kind of point has
static_assert(kAlignThreads > kUnknowns * (kUnknowns + 1), "each entry of the normal equations has a thread");
static_assert(kGreySums <= kSumStride && kAlignSums <= kWarp && kReportSums <= kWarp, "there is room for all sums");

struct AlignBlocks {
  std::int64_t points, grey;  // blocks of points, then of textured ones
};

struct AlignWorkspace {
  AlignState* state;
  std::uint32_t* arrived;  // blocks of the launch that are done; 0 between launches
  double* sums;            // [blocks, kSumStride]
  float* searched_at;      // [room, 3] where `match` was searched from
  std::size_t bytes;
};

inline AlignBlocks align_blocks(const AlignJob& job, bool coarse) {
  // At the coarse level every n-th point is used, n = max(1, count / coarse_points) rounded down: never twice as many.
  const std::int64_t coarse_points = 2 * static_cast<std::int64_t>(job.settings.coarse_points);
  const std::int64_t points = coarse && coarse_points < job.room ? coarse_points : job.room;
  const std::int64_t blocks = blocks_for(points, kAlignThreads);
  return {blocks > 0 ? blocks : 1, coarse ? 0 : blocks_for(job.photometric_points.count, kAlignThreads)};
}

inline AlignWorkspace align_workspace(void* block, std::int64_t blocks, std::int64_t room) {
  Carver carver(block);
  AlignWorkspace w;
  w.arrived = carver.take<std::uint32_t>(1);  // first: the caller zeroes it once
  w.state = carver.take<AlignState>(1);
  w.sums = carver.take<double>(blocks * kSumStride);
  w.searched_at = carver.take<float>(3 * room);
  w.bytes = carver.used();
  return w;
}

// What the threads of a block need to know of the state.
struct BlockView {
  FloatPose pose;
  float gain, bias;
  bool active, fresh;
};

__device__ inline void set_view(const double* rotation, const double* translation, double gain, double bias,
                                BlockView& view) {
  set_float_pose(rotation, translation, view.pose);
  view.gain = static_cast<float>(gain), view.bias = static_cast<float>(bias);
}

// The state, word by word by all threads of the block.
__device__ inline void copy_state(const AlignState& from, AlignState& to) {
  static_assert(sizeof(AlignState) % sizeof(double) == 0, "the state consists of whole words");
  const double* in = reinterpret_cast<const double*>(&from);
  double* out = reinterpret_cast<double*>(&to);
  for (unsigned w = threadIdx.x; w < sizeof(AlignState) / sizeof(double); w += kAlignThreads) out[w] = in[w];
}

// Sums of the block's threads, written behind those of the blocks before it. Starts with a barrier.
template <int kCount>
__device__ inline void write_block_sums(float (&values)[kCount], int first, double* sums,
                                        float (&room)[kAlignWarps][kWarp]) {
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const float sum = sum_over_warp(values, lane);
  __syncthreads();
  room[warp][lane] = sum;
  __syncthreads();
  if (warp != 0 || lane >= kCount) return;
  double total = 0;
#pragma unroll
  for (int w = 0; w < kAlignWarps; ++w) total += room[w][lane];
  sums[first + lane] = total;
}

// The same for the sums of a textured point, which are too many for the lanes of a warp.
__device__ inline void write_grey_sums(const float (&values)[kGreySums], double* sums,
                                       float (&room)[kAlignWarps][kWarp]) {
  float low[kWarp], high[kGreySums - kWarp];
#pragma unroll
  for (int k = 0; k < kWarp; ++k) low[k] = values[k];
#pragma unroll
  for (int k = kWarp; k < kGreySums; ++k) high[k - kWarp] = values[k];
  write_block_sums(low, 0, sums, room);
  write_block_sums(high, kWarp, sums, room);
}

// Whether this block is the last of its launch to come here; it then sees what all others wrote.
__device__ inline bool is_last_block(std::uint32_t* arrived, bool* room) {
  __threadfence();
  __syncthreads();
  if (threadIdx.x == 0) {
    *room = atomicAdd(arrived, 1u) == gridDim.x - 1;
    if (*room) *arrived = 0;  // for the next launch
  }
  __syncthreads();
  if (*room) __threadfence();
  return *room;
}

// Sums blocks [begin, end), in order: four threads of a value each take every fourth block.
__device__ inline void sum_blocks(const double* sums, std::int64_t begin, std::int64_t end, int count,
                                  double (&parts)[kAlignWarps][kSumStride]) {
  for (int k = static_cast<int>(threadIdx.x % kWarp); k < count; k += kWarp) {
    double total = 0;
    for (std::int64_t b = begin + threadIdx.x / kWarp; b < end; b += kAlignWarps) total += __ldcg(sums + b * kSumStride + k);
    parts[threadIdx.x / kWarp][k] = total;
  }
}

// Joins what the four threads of each value found. Starts and ends with a barrier.
__device__ inline void join_parts(int count, double (&parts)[kAlignWarps][kSumStride]) {
  __syncthreads();
  for (int k = static_cast<int>(threadIdx.x); k < count; k += kAlignThreads)
#pragma unroll
    for (int w = 1; w < kAlignWarps; ++w) parts[0][k] += parts[w][k];
  __syncthreads();
}

// Textured points in use; 0: there is no photometric part.
__device__ inline int textured_points(const AlignJob& job) {
  if (job.textured == nullptr) return job.photometric_points.count;
  return *job.textured >= job.least_textured ? *job.textured : 0;
}

// What textured points that are lost cost, and all others: a point that leaves the image costs what a badly fitting one
// does.
__device__ inline double grey_cost(const AlignJob& job, const double (&total)[kSumStride]) {
  const double points = textured_points(job), lost = points - total[kGreyCount];
  const double huber = static_cast<double>(job.settings.huber);
  return job.settings.photometric_weight / points * (total[kGreyCost] + lost * huber * huber);
}

// Place of entry (i, j) in the upper triangle of an n x n matrix.
__device__ inline int triangle_place(int i, int j, int n) {
  const int low = min(i, j), high = max(i, j);
  return low * n - low * (low - 1) / 2 + high - low;
}

// The normal equations from the sums over points, and over textured points if `grey` is not null: geometry per unit of
// weight, grey values per point. All threads of the block take part.
__device__ inline void set_equations(const AlignJob& job, const double (&total)[kSumStride], const double* grey,
                                     const AlignState& s, NormalEquations& out) {
  const double f = 1 / fmax(total[kWeight], 1e-30);
  const double g = grey ? static_cast<double>(job.settings.photometric_weight) / textured_points(job) : 0;
  // Weak prior on gain 1 and bias 0, so that an image without contrast leaves them where they are.
  const double prior = grey ? 1e-4 * job.settings.photometric_weight : 0;
  const int thread = static_cast<int>(threadIdx.x);
  if (thread < kUnknowns * kUnknowns) {
    const int i = thread / kUnknowns, j = thread % kUnknowns;
    double entry = i < 6 && j < 6 ? f * total[kMatrix + triangle_place(i, j, 6)] : 0;
    if (grey) entry += g * grey[kGreyMatrix + triangle_place(i, j, kUnknowns)];
    out.h[i][j] = entry + (i == j && i >= 6 ? prior : 0);
  } else if (thread < kUnknowns * (kUnknowns + 1)) {
    const int i = thread - kUnknowns * kUnknowns;
    double entry = i < 6 ? f * total[kRight + i] : 0;
    if (grey) entry += g * grey[kGreyRight + i];
    out.b[i] = entry + (i == 6 ? prior * (1 - s.candidate_gain) : i == 7 ? -prior * s.candidate_bias : 0);
  } else if (thread == kAlignThreads - 1) {
    out.cost = f * total[kCostSum];
    out.matches = total[kMatches];
    out.grey_count = grey ? grey[kGreyCount] : 0;
  }
}

// One linearisation at the candidate, and the step after it. `begins`: the first of an alignment, which starts at the
// guess. Without `kGreys` there are no blocks of textured points.
template <bool kGreys>
__global__ void __launch_bounds__(kAlignThreads, kAlignBlocksPerProcessor)
    descend_kernel(AlignJob job, AlignWorkspace work, int phase, int point_blocks, bool begins) {
  GGSLAM_SHARED BlockView view;
  GGSLAM_SHARED AlignState state;
  GGSLAM_SHARED NormalEquations next;
  GGSLAM_SHARED float room[kAlignWarps][kWarp];
  GGSLAM_SHARED double parts[kAlignWarps][kSumStride], grey_parts[kAlignWarps][kSumStride];
  GGSLAM_SHARED bool last;
  const int thread = static_cast<int>(threadIdx.x), block = static_cast<int>(blockIdx.x);
  if (thread == 0) {
    const AlignState& s = *work.state;
    view.active = begins || s.phase == phase;
    view.fresh = begins || s.fresh != 0;
    if (begins)
      set_view(job.guess, job.guess + 9, 1, 0, view);
    else
      set_view(s.candidate.r, s.candidate.t, s.candidate_gain, s.candidate_bias, view);
  }
  __syncthreads();
  if (!view.active) return;
  double* own_sums = work.sums + static_cast<std::int64_t>(block) * kSumStride;
  const bool coarse = phase == kCoarsePhase;
  if (!kGreys || block < point_blocks) {
    const int count = job.points.header->count, step = coarse ? max(1, count / max(1, job.settings.coarse_points)) : 1;
    const std::int64_t i = (static_cast<std::int64_t>(block) * kAlignThreads + thread) * step;
    float sums[kAlignSums] = {};
    if (i < count)
      align_terms(job, coarse ? job.coarse : job.fine, view.pose, work.searched_at, static_cast<int>(i), view.fresh,
                  coarse ? static_cast<float>(job.settings.coarse_kernel_factor) : 1, sums);
    write_block_sums(sums, 0, own_sums, room);
  } else {
    const int i = (block - point_blocks) * kAlignThreads + thread;
    float sums[kGreySums] = {};
    if (i < textured_points(job)) photometric_terms(job, view.pose, view.gain, view.bias, i, sums);
    write_grey_sums(sums, own_sums, room);
  }
  if (!is_last_block(work.arrived, &last)) return;
  if (!begins)
    copy_state(*work.state, state);
  else if (thread == 0)
    start_alignment(state, job);
  sum_blocks(work.sums, 0, point_blocks, kAlignSums, parts);
  if (kGreys) sum_blocks(work.sums, point_blocks, gridDim.x, kGreySums, grey_parts);
  join_parts(kAlignSums, parts);
  if (kGreys) join_parts(kGreySums, grey_parts);
  const bool greys = kGreys && textured_points(job) > 0;
  set_equations(job, parts[0], greys ? grey_parts[0] : nullptr, state, next);
  __syncthreads();
  if (thread == 0) {
    if (greys) next.cost += grey_cost(job, grey_parts[0]);
    advance(state, next, job.settings, greys);
  }
  __syncthreads();
  copy_state(state, *work.state);
}

// Writes the results from the sums at the pose found.
__device__ inline void write_results(const AlignJob& job, const AlignState& s, const double (&total)[kSumStride],
                                     const double* grey) {
  double* out = job.results;
  const PointsHeader header = *job.points.header;
  for (int i = 0; i < 9; ++i) out[kPose + i] = s.pose.r[i];
  for (int i = 0; i < 3; ++i) out[kPose + 9 + i] = s.pose.t[i];
  for (int k = 0; k < 21; ++k) out[kInformation + k] = total[kPlanes + k];
  out[kCost] = total[kReportCost] / fmax(total[kReportWeight], 1e-30);
  out[kOverlap] = total[kInliers] / max(1, header.count);
  out[kRmse] = sqrt(total[kSquared] / fmax(1.0, total[kInliers]));
  out[kPhotometricResidual] = grey ? grey[kGreyAbsolute] / fmax(1.0, grey[kGreyCount]) : 0;
  out[kPhotometricShare] = grey ? grey[kGreyCount] / textured_points(job) : 0;
  out[kCoarseIterations] = s.coarse_iterations, out[kFineIterations] = s.fine_iterations;
  out[kConverged] = s.converged;
  out[kUsable] = total[kReportMatches] >= job.settings.min_matches;
  out[kPointCount] = header.count, out[kMedianDepth] = header.median_depth;
  const double weight = total[kMoment0], f = weight > 0 ? 1 / weight : 0;
  double squared = f * total[kMoment2];
  out[kSpreadTotal] = weight;
  for (int a = 0; a < 3; ++a) {
    const double mean = f * total[kMoment1 + a];
    squared -= mean * mean;
    out[kCentroid + a] = header.count > 0 ? mean + job.points.points[a] : 0;
  }
  out[kRadius] = sqrt(fmax(squared, 0.0));
}

// What the matches at the pose found say.
template <bool kGreys>
__global__ void __launch_bounds__(kAlignThreads, kAlignBlocksPerProcessor)
    report_kernel(AlignJob job, AlignWorkspace work, int point_blocks) {
  GGSLAM_SHARED BlockView view;
  GGSLAM_SHARED float room[kAlignWarps][kWarp];
  GGSLAM_SHARED double parts[kAlignWarps][kSumStride], grey_parts[kAlignWarps][kSumStride];
  GGSLAM_SHARED bool last;
  const int thread = static_cast<int>(threadIdx.x), block = static_cast<int>(blockIdx.x);
  const AlignState& state = *work.state;
  if (thread == 0) set_view(state.pose.r, state.pose.t, state.gain, state.bias, view);
  __syncthreads();
  double* own_sums = work.sums + static_cast<std::int64_t>(block) * kSumStride;
  if (!kGreys || block < point_blocks) {
    const std::int64_t i = static_cast<std::int64_t>(block) * kAlignThreads + thread;
    float sums[kReportSums] = {};
    if (i < job.points.header->count) report_terms(job, view.pose, work.searched_at, static_cast<int>(i), sums);
    write_block_sums(sums, 0, own_sums, room);
  } else {
    const int i = (block - point_blocks) * kAlignThreads + thread;
    float sums[kGreySums] = {};
    if (i < textured_points(job)) photometric_terms(job, view.pose, view.gain, view.bias, i, sums);
    write_grey_sums(sums, own_sums, room);
  }
  if (!is_last_block(work.arrived, &last)) return;
  sum_blocks(work.sums, 0, point_blocks, kReportSums, parts);
  if (kGreys) sum_blocks(work.sums, point_blocks, gridDim.x, kGreySums, grey_parts);
  join_parts(kReportSums, parts);
  if (kGreys) join_parts(kGreySums, grey_parts);
  if (thread != 0) return;
  const bool greys = kGreys && textured_points(job) > 0;
  write_results(job, state, parts[0], greys ? grey_parts[0] : nullptr);
  job.results[kTextured] = kGreys ? (job.textured ? *job.textured : job.photometric_points.count) : 0;
  if (greys) job.results[kCost] += grey_cost(job, grey_parts[0]);
}

}  // namespace ggslam::cuda
