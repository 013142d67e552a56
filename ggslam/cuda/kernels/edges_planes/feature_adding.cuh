// SPDX-License-Identifier: Apache-2.0
// Adds a scan to the local map: the rules of FeatureMap.add in ggslam/tracking/edges_planes/voxels.py.
//
// Features are sorted by the slot of their voxel, and those of a slot keep their order. One thread then has a slot: of
// its voxels the one with the largest key stays, and what was measured in it is added up in the order of the scan.
#pragma once
#include "common/carver.cuh"
#include "common/sorting.cuh"
#include "edges_planes/feature_table.cuh"
#include "native/formulas/symmetric3.hpp"

namespace ggslam::cuda {

constexpr int kAddThreads = 128;

struct AddWorkspace {
  std::int64_t* keys;                   // [room]
  std::uint32_t *slots, *sorted_slots;  // [room]
  std::uint32_t *numbers, *sorted;      // [room] of the features
  void* scratch;
  std::size_t scratch_bytes, bytes;
};

inline AddWorkspace add_workspace(void* block, std::int64_t room) {
  Carver carver(block);
  AddWorkspace w;
  w.keys = carver.take<std::int64_t>(room);
  w.slots = carver.take<std::uint32_t>(room), w.sorted_slots = carver.take<std::uint32_t>(room);
  w.numbers = carver.take<std::uint32_t>(room), w.sorted = carver.take<std::uint32_t>(room);
  w.scratch_bytes = sorting_bytes(room);
  w.scratch = carver.take<char>(static_cast<std::int64_t>(w.scratch_bytes));
  w.bytes = carver.used();
  return w;
}

__device__ inline FloatPose pose_of(const FeatureAddJob& job) {
  FloatPose pose;
#pragma unroll
  for (int i = 0; i < 9; ++i) pose.rotation[i] = job.pose[i];
#pragma unroll
  for (int i = 0; i < 3; ++i) pose.translation[i] = job.pose[9 + i];
  return pose;
}

// Where feature i of a scan is.
__device__ inline const float* scan_point(const FeatureArrays& scan, int i) {
  const int planes = scan.header->planes;
  return i < planes ? scan.planes + 3 * static_cast<std::int64_t>(i)
                    : scan.edges + 3 * static_cast<std::int64_t>(i - planes);
}

// Key and slot of each feature's voxel; there is none in the slot beyond the last.
__global__ void __launch_bounds__(kAddThreads) feature_keys_kernel(FeatureAddJob job, AddWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kAddThreads + threadIdx.x);
  if (i >= job.room) return;
  const int planes = job.scan.header->planes, edges = job.scan.header->edges;
  work.numbers[i] = static_cast<std::uint32_t>(i);
  work.slots[i] = static_cast<std::uint32_t>(job.table.slots);
  if (i >= planes + edges) return;
  float p[3];
  place_point(pose_of(job), scan_point(job.scan, i), p);
  work.keys[i] = voxel_key(job.table, p, i >= planes, 0.0f);
  work.slots[i] = static_cast<std::uint32_t>(slot_of(job.table, work.keys[i]));
}

// xx xy xz yy yz zz
__device__ inline void outer_square(const float (&v)[3], float (&out)[6]) {
  out[0] = v[0] * v[0], out[1] = v[0] * v[1], out[2] = v[0] * v[2];
  out[3] = v[1] * v[1], out[4] = v[1] * v[2], out[5] = v[2] * v[2];
}

// What a scan measured in a voxel, about its centre.
struct VoxelSums {
  float weight, mean[3], scatter[6], normal[3], patches;
};

__device__ inline void add_measurement(const FeatureAddJob& job, const FloatPose& pose, int i, const float (&centre)[3],
                                       VoxelSums& sums) {
  const bool edge = i >= job.scan.header->planes;
  float p[3], x[3], products[6], normal[3] = {0, 0, 0}, normals[6];
  place_point(pose, scan_point(job.scan, i), p);
  if (!edge) rotate(pose.rotation, job.scan.normals + 3 * static_cast<std::int64_t>(i), normal);
  const float disc = edge ? 0.0f : job.scan.discs[i];
#pragma unroll
  for (int a = 0; a < 3; ++a) x[a] = p[a] - centre[a];
  outer_square(x, products);
  outer_square(normal, normals);
  sums.weight += 1;
#pragma unroll
  for (int a = 0; a < 3; ++a) sums.mean[a] += x[a], sums.normal[a] += normal[a];
#pragma unroll
  for (int k = 0; k < 6; ++k)
    sums.scatter[k] += products[k] + disc * disc * ((k == 0 || k == 3 || k == 5 ? 1.0f : 0.0f) - normals[k]);
  sums.patches += disc > 0;
}

// Sums become mean and scatter about it.
__device__ inline void centre_sums(VoxelSums& sums) {
  float products[6];
#pragma unroll
  for (int a = 0; a < 3; ++a) sums.mean[a] /= sums.weight;
  outer_square(sums.mean, products);
#pragma unroll
  for (int k = 0; k < 6; ++k) sums.scatter[k] -= sums.weight * products[k];
}

// Axis and variance of a voxel; variance 0 where it is neither plane nor edge.
__device__ inline float shape_of(const FeatureTable& table, const float (&scatter)[6], float weight, float patches,
                                 bool edge, float (&axis)[3]) {
  float covariance[6], values[3], axes[3][3];
#pragma unroll
  for (int k = 0; k < 6; ++k) covariance[k] = scatter[k] / weight;
  eigen_symmetric3(covariance, values, axes);
  const float largest = larger_of(values[0], 0), middle = larger_of(values[1], 0), smallest = larger_of(values[2], 0);
#pragma unroll
  for (int a = 0; a < 3; ++a) axis[a] = edge ? axes[0][a] : axes[2][a];
  const bool is_plane = middle > table.plane_ratio * smallest && (weight >= table.min_plane_points || patches > 0);
  const bool is_edge = largest > table.edge_ratio * middle && weight >= table.min_edge_points;
  const float variance = larger_of(edge ? middle : smallest, 1e-9f);
  return (edge ? is_edge : is_plane) ? variance : 0.0f;
}

// Joins what was measured with what the table has (T. Chan, G. Golub and R. LeVeque, 1979), and renews the surface.
__device__ inline void merge_voxel(const FeatureTable& table, std::int64_t slot, std::int64_t key,
                                   const float (&centre)[3], const VoxelSums& sums) {
  const bool is_new = table.keys[slot] != key;
  float* surface = table.surfaces + 8 * slot;
  float* old_scatter = table.scatters + 6 * slot;
  const float old_weight = is_new ? 0.0f : table.weights[slot], weight = old_weight + sums.weight;
  const float share = sums.weight / weight, patches = (is_new ? 0.0f : surface[7]) + sums.patches;
  float step[3], products[6], scatter[6], mean[3], axis[3];
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const float old_mean = is_new ? sums.mean[a] : surface[a] - centre[a];
    step[a] = sums.mean[a] - old_mean;
    mean[a] = old_mean + share * step[a] + centre[a];
  }
  outer_square(step, products);
#pragma unroll
  for (int k = 0; k < 6; ++k)
    scatter[k] = (is_new ? 0.0f : old_scatter[k]) + sums.scatter[k] + old_weight * share * products[k];
  const float variance = shape_of(table, scatter, weight, patches, (key & kEdgeBit) > 0, axis);
  float along = 0;
#pragma unroll
  for (int a = 0; a < 3; ++a) along += axis[a] * (sums.patches > 0 ? sums.normal[a] : is_new ? 0.0f : surface[3 + a]);
  const float shrink = smaller_of(table.max_weight / weight, 1.0f);
  table.keys[slot] = key;
  table.weights[slot] = weight * shrink;
#pragma unroll
  for (int a = 0; a < 3; ++a) surface[a] = mean[a], surface[3 + a] = along < 0 ? -axis[a] : axis[a];
  surface[6] = variance, surface[7] = patches;
#pragma unroll
  for (int k = 0; k < 6; ++k) old_scatter[k] = scatter[k] * shrink;
}

__device__ inline void centre_of(const FeatureTable& table, std::int64_t key, float (&centre)[3]) {
  const float voxel = (key & kEdgeBit) > 0 ? table.edge_voxel : table.plane_voxel;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const std::int64_t cell = (key >> (40 - 20 * a) & kCoordinateMask) - kVoxelOffset;
    centre[a] = __fmul_rn(static_cast<float>(cell) + 0.5f, voxel);
  }
}

// The thread of the first feature of a slot has the slot.
__global__ void __launch_bounds__(kAddThreads) merge_features_kernel(FeatureAddJob job, AddWorkspace work) {
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kAddThreads + threadIdx.x;
  if (first >= job.room) return;
  const std::uint32_t slot = work.sorted_slots[first];
  if (slot >= job.table.slots || (first > 0 && work.sorted_slots[first - 1] == slot)) return;
  std::int64_t key = work.keys[work.sorted[first]], end = first + 1;
  for (; end < job.room && work.sorted_slots[end] == slot; ++end) key = max(key, work.keys[work.sorted[end]]);
  float centre[3];
  centre_of(job.table, key, centre);
  const FloatPose pose = pose_of(job);
  VoxelSums sums{};
  for (std::int64_t k = first; k < end; ++k) {
    const std::uint32_t i = work.sorted[k];
    if (work.keys[i] == key) add_measurement(job, pose, static_cast<int>(i), centre, sums);
  }
  centre_sums(sums);
  merge_voxel(job.table, slot, key, centre, sums);
}

inline int bits_of(std::int64_t number) {
  int bits = 0;
  while (number >> bits) ++bits;
  return bits;
}

inline cudaError_t launch_add(const FeatureAddJob& job, cudaStream_t stream) {
  const AddWorkspace work = add_workspace(job.workspace, job.room);
  const std::int64_t blocks = blocks_for(job.room, kAddThreads);
  launch(feature_keys_kernel, blocks, kAddThreads, stream, job, work);
  const cudaError_t sorted = sort_pairs(work.scratch, work.scratch_bytes, work.slots, work.sorted_slots, work.numbers,
                                        work.sorted, job.room, bits_of(job.table.slots), stream);
  launch(merge_features_kernel, blocks, kAddThreads, stream, job, work);
  return sorted;
}

}  // namespace ggslam::cuda
