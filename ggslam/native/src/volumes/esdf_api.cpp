// SPDX-License-Identifier: Apache-2.0
// The distance field as seen from outside.
#include <algorithm>
#include <limits>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(void esdf_query(const ggslam::volumes::QueryInput& in, std::size_t begin, std::size_t end,
                                      float* distance, float* gradient, uint8_t* known, uint8_t* stale))

using namespace ggslam;
using namespace ggslam::volumes;

namespace {

constexpr float kMostDistance = 2001;  // voxels; the core counts them in 16 bits

Esdf& field(void* handle) { return object_of<Esdf>(handle); }

}  // namespace

GGSLAM_EXPORT void* ggslam_esdf_create(void* tsdf, float max_distance) try {
  const Tsdf& map = object_of<Tsdf>(tsdf);
  check_range("max_distance", max_distance / map.voxel, 1e-6f, kMostDistance);
  return new Esdf(map, max_distance);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_destroy(void* handle) try {
  delete static_cast<Esdf*>(handle);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_clear(void* handle) try {
  field(handle).clear();
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_write(void* handle, const FieldParts* parts_) try {
  const FieldParts& parts = object_of<FieldParts>(parts_);
  const void* const arrays[] = {parts.at, parts.known, parts.negative, parts.crossed, parts.distance, parts.gradient,
                                parts.owner};
  for (const void* array : arrays) check_array("blocks", array, parts.blocks);
  const void* const of_sites[] = {parts.site_block, parts.site_voxel, parts.site_at, parts.site_normal,
                                  parts.site_radius};
  for (const void* array : of_sites) check_array("sites", array, parts.sites);
  for (int64_t s = 0; s < parts.sites; ++s) {
    check_range("site_block", parts.site_block[s], s > 0 ? parts.site_block[s - 1] : 0, static_cast<int32_t>(parts.blocks) - 1);
    check_range("site_voxel", parts.site_voxel[s], 0, kVoxels - 1);
  }
  for (int64_t v = 0; v < kVoxels * parts.blocks; ++v)
    if (parts.owner[v] != kNobody) check_range("owner", static_cast<int64_t>(parts.owner[v]), int64_t{0}, kVoxels * parts.blocks - 1);
  field(handle).take(parts);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_esdf_size(void* handle) try {
  return static_cast<int64_t>(field(handle).size());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_esdf_bytes(void* handle) try {
  return static_cast<int64_t>(field(handle).bytes());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_update(void* handle, void* context, double budget_ms, const double* place,
                                     FieldStats* stats) try {
  Esdf& f = field(handle);
  double voxels[3];
  if (place != nullptr) (ggslam::Vec3d::from(place) / static_cast<double>(f.voxel())).to(voxels);
  object_of<FieldStats>(stats) =
      f.update(object_of<ggslam::Context>(context), {budget_ms, place == nullptr ? nullptr : voxels});
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_recompute(void* handle, void* context, FieldStats* stats) try {
  object_of<FieldStats>(stats) = field(handle).recompute(object_of<ggslam::Context>(context));
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_list(void* handle, int32_t* at) try {
  const BlockTable& table = field(handle).table();
  check_array("coordinates", at, static_cast<int64_t>(table.size()));
  for (std::size_t row = 0; row < table.size(); ++row) {
    const BlockCoordinates b = table.at(row);
    at[3 * row] = b.x, at[3 * row + 1] = b.y, at[3 * row + 2] = b.z;
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_read(void* handle, int64_t n, const int32_t* at, float* distance) try {
  const Esdf& f = field(handle);
  check_array("coordinates", at, n), check_array("distance", distance, n);
  for (int64_t i = 0; i < n; ++i) {
    const int32_t row = f.table().find({at[3 * i], at[3 * i + 1], at[3 * i + 2]});
    const FieldVoxels* voxels = row < 0 ? nullptr : f.block(row).voxels.get();
    for (int v = 0; v < kVoxels; ++v)
      distance[i * kVoxels + v] = voxels ? voxels->distance[v] : std::numeric_limits<float>::quiet_NaN();
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_esdf_sites(void* handle, float* points, float* normals, float* radii) try {
  const Esdf& f = field(handle);
  if (points != nullptr) check_array("normals", normals, 1), check_array("radii", radii, 1);
  int64_t n = 0;
  for (std::size_t row = 0; row < f.size(); ++row) {
    const ggslam::Vec3f first = ggslam::cast<float>(kSide * vector_of(f.table().at(row))) + ggslam::Vec3f::all(0.5f);
    for (const Site& site : f.block(row).sites) {
      if (points != nullptr) {
        (f.voxel() * (first + ggslam::Vec3f::from(site.at))).to(points + 3 * n);
        std::copy_n(site.normal, 3, normals + 3 * n);
        radii[n] = f.voxel() * site.radius;
      }
      ++n;
    }
  }
  return n;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_esdf_query(void* handle, void* context_, int64_t n, const double* points, float* distance,
                                    float* gradient, uint8_t* known, uint8_t* stale) try {
  ggslam::Context& context = object_of<ggslam::Context>(context_);
  const Esdf& f = field(handle);
  const void* const arrays[] = {points, distance, gradient, known, stale};
  for (const void* array : arrays) check_array("points", array, n);
  std::vector<const FieldVoxels*> voxels(f.size());
  std::vector<uint8_t> blocks_stale(f.size());
  for (std::size_t row = 0; row < f.size(); ++row)
    voxels[row] = f.block(row).voxels.get(), blocks_stale[row] = f.block(row).waits > 0;
  const QueryInput in{f.table().view(), voxels.data(), blocks_stale.data(), f.voxel(), points};
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_query);
  context.pool.parallel_for(static_cast<std::size_t>(n), 4096, [&](std::size_t begin, std::size_t end, int) {
    kernel(in, begin, end, distance, gradient, known, stale);
  });
  return 0;
} GGSLAM_CATCH_ALL
