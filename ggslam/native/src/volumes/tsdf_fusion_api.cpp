// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/tsdf_rays.hpp"
#include "volumes/tsdf_scratch.hpp"

namespace {

ggslam::volumes::FusionScratch& scratch(ggslam::volumes::Tsdf& map) {
  if (!map.scratch) map.scratch = std::make_shared<ggslam::volumes::FusionScratch>();
  return *map.scratch;
}

void check_view(const ggslam::volumes::Tsdf& map, const ggslam::volumes::FusionInput& in) {
  using namespace ggslam;
  check_camera(in.width, in.height, in.fx, in.fy, in.cx, in.cy);
  check_array("depth", in.depth, 1);
  check_rotation(in.rotation);
  // The translation is as long as the camera is far from the origin.
  check_within("position", in.translation, 3, 2.0 * volumes::kSide * volumes::kFarthestBlock * map.voxel);
}

void check_settings(const ggslam::volumes::FusionSettings& settings) {
  using namespace ggslam;
  check_range("min_depth", settings.min_depth, 0.0f, 1e6f), check_range("max_depth", settings.max_depth, 0.0f, 1e6f);
  check_range("free_share", settings.free_share, 0.0f, 1.0f), check_range("clearing", settings.clearing, 0.0f, 1.0f);
  check_range("integrator", settings.integrator, volumes::kProjection, volumes::kHybrid);
  check_range("least_rays", settings.least_rays, 1, 1 << 20);
  check_range("edge", settings.edge, 0.0f, 1e6f);
  check_range("max_free_weight", settings.max_free_weight, 0.0f, 1e6f);
}

}  // namespace

GGSLAM_EXPORT int ggslam_tsdf_integrate(void* handle, void* context, const ggslam::volumes::FusionInput* input,
                                        const ggslam::volumes::FusionSettings* settings,
                                        ggslam::volumes::FusionStats* stats) try {
  auto& map = ggslam::object_of<ggslam::volumes::Tsdf>(handle);
  check_view(map, ggslam::object_of<ggslam::volumes::FusionInput>(input));
  check_settings(ggslam::object_of<ggslam::volumes::FusionSettings>(settings));
  ggslam::object_of<ggslam::volumes::FusionStats>(stats) = integrate(map, scratch(map), ggslam::object_of<ggslam::Context>(context), *input, *settings);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_tsdf_decay(void* handle, void* context, float factor, int least, int spare_in_view) try {
  auto& map = ggslam::object_of<ggslam::volumes::Tsdf>(handle);
  ggslam::check_range("factor", factor, 0.0f, 1.0f);
  ggslam::check_range("least", least, 0, 1 << 16);
  return decay(map, scratch(map), ggslam::object_of<ggslam::Context>(context), factor, least, spare_in_view != 0);
} GGSLAM_CATCH_ALL
