// SPDX-License-Identifier: Apache-2.0
// The distance field as seen from outside.
#include <algorithm>
#include <limits>

#include "common/context.hpp"
#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(void esdf_query(const ggslam::volumes::QueryInput& in, std::size_t begin, std::size_t end,
                                      float* distance, float* gradient, uint8_t* known))

using namespace ggslam::volumes;

namespace {

Esdf& field(void* handle) { return *static_cast<Esdf*>(handle); }

}  // namespace

GGSLAM_EXPORT void* ggslam_esdf_create(void* tsdf, float max_distance) {
  return new Esdf(*static_cast<Tsdf*>(tsdf), max_distance);
}

GGSLAM_EXPORT void ggslam_esdf_destroy(void* handle) { delete static_cast<Esdf*>(handle); }
GGSLAM_EXPORT void ggslam_esdf_clear(void* handle) { field(handle).clear(); }
GGSLAM_EXPORT int64_t ggslam_esdf_size(void* handle) { return static_cast<int64_t>(field(handle).size()); }
GGSLAM_EXPORT int64_t ggslam_esdf_bytes(void* handle) { return static_cast<int64_t>(field(handle).bytes()); }

GGSLAM_EXPORT void ggslam_esdf_update(void* handle, void* context, FieldStats* stats) {
  *stats = field(handle).update(*static_cast<ggslam::Context*>(context));
}

GGSLAM_EXPORT void ggslam_esdf_list(void* handle, int32_t* at) {
  const BlockTable& table = field(handle).table();
  for (std::size_t row = 0; row < table.size(); ++row) {
    const BlockCoordinates b = table.at(row);
    at[3 * row] = b.x, at[3 * row + 1] = b.y, at[3 * row + 2] = b.z;
  }
}

GGSLAM_EXPORT void ggslam_esdf_read(void* handle, int64_t n, const int32_t* at, float* distance) {
  const Esdf& f = field(handle);
  for (int64_t i = 0; i < n; ++i) {
    const int32_t row = f.table().find({at[3 * i], at[3 * i + 1], at[3 * i + 2]});
    const FieldVoxels* voxels = row < 0 ? nullptr : f.block(row).voxels.get();
    for (int v = 0; v < kVoxels; ++v)
      distance[i * kVoxels + v] = voxels ? voxels->distance[v] : std::numeric_limits<float>::quiet_NaN();
  }
}

GGSLAM_EXPORT int64_t ggslam_esdf_sites(void* handle, float* points, float* normals) {
  const Esdf& f = field(handle);
  int64_t n = 0;
  for (std::size_t row = 0; row < f.size(); ++row) {
    const BlockCoordinates b = f.table().at(row);
    for (const Site& site : f.block(row).sites) {
      if (points != nullptr) {
        const ggslam::Vec3f voxel = ggslam::cast<float>(kSide * vector_of(b) + voxel_of(site.voxel));
        (f.voxel() * (voxel + ggslam::Vec3f::all(0.5f) + ggslam::Vec3f::from(site.point))).to(points + 3 * n);
        std::copy_n(site.normal, 3, normals + 3 * n);
      }
      ++n;
    }
  }
  return n;
}

GGSLAM_EXPORT void ggslam_esdf_query(void* handle, void* context_, int64_t n, const double* points, float* distance,
                                     float* gradient, uint8_t* known) {
  ggslam::Context& context = *static_cast<ggslam::Context*>(context_);
  const Esdf& f = field(handle);
  std::vector<const FieldVoxels*> voxels(f.size());
  for (std::size_t row = 0; row < f.size(); ++row) voxels[row] = f.block(row).voxels.get();
  const QueryInput in{f.table().view(), voxels.data(), f.voxel(), points};
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_query);
  context.pool.parallel_for(static_cast<std::size_t>(n), 4096, [&](std::size_t begin, std::size_t end, int) {
    kernel(in, begin, end, distance, gradient, known);
  });
}
