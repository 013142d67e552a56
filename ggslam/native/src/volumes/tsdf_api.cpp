// SPDX-License-Identifier: Apache-2.0
// The block store as seen from outside: making, listing, reading and writing blocks.
#include <algorithm>
#include <cstring>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/tsdf.hpp"

using ggslam::volumes::Block;
using ggslam::volumes::BlockCoordinates;
using ggslam::volumes::kFarthestBlock;
using ggslam::volumes::kVoxels;
using ggslam::volumes::PointBlock;
using ggslam::volumes::Tsdf;
using ggslam::volumes::VoxelArrays;
using ggslam::volumes::VoxelBlock;

namespace {

template <class T>
void copy_out(T* to, std::size_t row, const T* from) {
  if (to != nullptr) std::memcpy(to + row * kVoxels, from, kVoxels * sizeof(T));
}

template <class T>
void copy_in(T* to, std::size_t row, const T* from) {
  if (from != nullptr) std::memcpy(to, from + row * kVoxels, kVoxels * sizeof(T));
}

// How many blocks are meant; coordinates of those to be made must be possible.
int64_t check_blocks(int64_t n, const int32_t* at, bool to_make) {
  ggslam::check_array("coordinates", at, n);
  for (int64_t i = 0; to_make && i < 3 * n; ++i)
    ggslam::check_range("coordinates", at[i], -kFarthestBlock, kFarthestBlock);
  return n;
}

Tsdf& tsdf(void* handle) { return ggslam::object_of<Tsdf>(handle); }

}  // namespace

GGSLAM_EXPORT void* ggslam_tsdf_create(float voxel, float truncation, float max_weight) try {
  ggslam::check_range("voxel", voxel, 1e-6f, 1e6f);
  ggslam::check_range("truncation", truncation, 1.01f * voxel, 1e6f);
  ggslam::check_range("max_weight", max_weight, 1e-6f, 1e6f);
  return new Tsdf(voxel, truncation, max_weight);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_destroy(void* handle) try {
  delete static_cast<Tsdf*>(handle);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_clear(void* handle) try {
  tsdf(handle).clear();
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_tsdf_size(void* handle) try {
  return tsdf(handle).size();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_tsdf_dense(void* handle) try {
  return tsdf(handle).dense();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_tsdf_bytes(void* handle) try {
  return tsdf(handle).bytes();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT uint32_t ggslam_tsdf_revision(void* handle) try {
  return tsdf(handle).revision;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_list(void* handle, int32_t* at, uint8_t* dense, uint16_t* free_weight, uint8_t* frozen,
                                   uint32_t* revision) try {
  const Tsdf& map = tsdf(handle);
  const auto n = static_cast<int64_t>(map.size());
  const void* const arrays[] = {at, dense, free_weight, frozen, revision};
  for (const void* array : arrays) ggslam::check_array("blocks", array, n);
  for (std::size_t row = 0; row < map.size(); ++row) {
    const Block& b = map.block(row);
    at[3 * row] = b.at.x, at[3 * row + 1] = b.at.y, at[3 * row + 2] = b.at.z;
    dense[row] = b.slot >= 0, free_weight[row] = b.free_weight, frozen[row] = b.frozen, revision[row] = b.revision;
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_read(void* handle, int64_t n, const int32_t* at, const VoxelArrays* out) try {
  const Tsdf& map = tsdf(handle);
  check_blocks(n, at, false);
  ggslam::object_of<VoxelArrays>(out);
  VoxelBlock plain{};
  PointBlock no_points{};
  std::fill_n(plain.value, kVoxels, ggslam::volumes::kFreeValue);
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = map.find({at[3 * i], at[3 * i + 1], at[3 * i + 2]});
    const VoxelBlock* v = row < 0 ? nullptr : map.voxels(map.block(row));
    const PointBlock* p = row < 0 ? nullptr : map.points(map.block(row));
    if (v == nullptr) {
      std::fill_n(plain.weight, kVoxels, row < 0 ? uint16_t{0} : map.block(row).free_weight);
      v = &plain;
    }
    if (p == nullptr) {
      const bool known = row >= 0 && map.counts_points() && map.block(row).free_weight > 0 && map.block(row).slot < 0;
      std::fill_n(no_points.hits, kVoxels, static_cast<uint8_t>(known ? ggslam::volumes::kLeastHits : 0));
      p = &no_points;
    }
    copy_out(out->value, i, v->value);
    copy_out(out->weight, i, v->weight);
    copy_out(out->label, i, v->label);
    copy_out(out->votes, i, v->votes);
    copy_out(out->hits, i, p->hits);
    copy_out(out->octants, i, p->octants);
    if (out->color == nullptr) continue;
    uint8_t* color = out->color + 3 * i * kVoxels;
    for (int k = 0; k < kVoxels; ++k)
      color[3 * k] = v->red[k], color[3 * k + 1] = v->green[k], color[3 * k + 2] = v->blue[k];
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_write(void* handle, int64_t n, const int32_t* at, const VoxelArrays* in) try {
  Tsdf& map = tsdf(handle);
  check_blocks(n, at, true);
  ggslam::object_of<VoxelArrays>(in);
  if (in->hits != nullptr && std::any_of(in->hits, in->hits + n * kVoxels, [](uint8_t h) { return h > 0; }))
    map.count_points();
  ++map.revision;
  for (int64_t i = 0; i < n; ++i) {
    Block& block = map.block(map.insert({at[3 * i], at[3 * i + 1], at[3 * i + 2]}));
    block.revision = map.revision;
    VoxelBlock* v = map.densify(block);
    copy_in(v->value, i, in->value);
    copy_in(v->weight, i, in->weight);
    copy_in(v->label, i, in->label);
    copy_in(v->votes, i, in->votes);
    if (PointBlock* p = map.points(block)) copy_in(p->hits, i, in->hits), copy_in(p->octants, i, in->octants);
    if (in->color == nullptr) continue;
    const uint8_t* color = in->color + 3 * i * kVoxels;
    for (int k = 0; k < kVoxels; ++k)
      v->red[k] = color[3 * k], v->green[k] = color[3 * k + 1], v->blue[k] = color[3 * k + 2];
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_write_free(void* handle, int64_t n, const int32_t* at, const uint16_t* weight) try {
  Tsdf& map = tsdf(handle);
  ggslam::check_array("weight", weight, check_blocks(n, at, true));
  ++map.revision;
  for (int64_t i = 0; i < n; ++i) {
    Block& block = map.block(map.insert({at[3 * i], at[3 * i + 1], at[3 * i + 2]}));
    block.revision = map.revision;
    map.collapse(block, weight[i]);
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_erase(void* handle, int64_t n, const int32_t* at) try {
  Tsdf& map = tsdf(handle);
  check_blocks(n, at, false);
  ++map.revision;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = map.find({at[3 * i], at[3 * i + 1], at[3 * i + 2]});
    if (row >= 0) map.erase(row);
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_freeze(void* handle, int frozen) try {
  Tsdf& map = tsdf(handle);
  for (std::size_t row = 0; row < map.size(); ++row) map.block(row).frozen = frozen != 0;
  return 0;
} GGSLAM_CATCH_ALL
