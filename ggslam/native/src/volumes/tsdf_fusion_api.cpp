// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"
#include "interface/core/volumes.hpp"
#include "volumes/tsdf_scratch.hpp"

namespace {

ggslam::volumes::FusionScratch& scratch(ggslam::volumes::Tsdf& map) {
  if (!map.scratch) map.scratch = std::make_shared<ggslam::volumes::FusionScratch>();
  return *map.scratch;
}

}  // namespace

GGSLAM_EXPORT void ggslam_tsdf_integrate(void* handle, void* context, const ggslam::volumes::FusionInput* input,
                                         const ggslam::volumes::FusionSettings* settings,
                                         ggslam::volumes::FusionStats* stats) {
  auto& map = *static_cast<ggslam::volumes::Tsdf*>(handle);
  *stats = integrate(map, scratch(map), *static_cast<ggslam::Context*>(context), *input, *settings);
}

GGSLAM_EXPORT int64_t ggslam_tsdf_decay(void* handle, void* context, float factor, int least, int spare_in_view) {
  auto& map = *static_cast<ggslam::volumes::Tsdf*>(handle);
  return decay(map, scratch(map), *static_cast<ggslam::Context*>(context), factor, least, spare_in_view != 0);
}
