// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <vector>

#include "common/context.hpp"
#include "rendering/mesh_picture.hpp"

GGSLAM_DECLARE_KERNEL(void mesh_picture_project(const MeshPictureInput& in, std::size_t begin, std::size_t end,
                                                ProjectedVertex* out))
GGSLAM_DECLARE_KERNEL(void mesh_picture_band(const MeshPictureInput& in, const ProjectedVertex* vertices, int top,
                                             int bottom, float* inverse_z, uint8_t* picture))

using namespace ggslam;

GGSLAM_EXPORT void ggslam_draw_mesh(void* context_, const MeshPictureInput* in, float* inverse_z, uint8_t* picture) {
  Context& context = *static_cast<Context*>(context_);
  const auto project = GGSLAM_DISPATCH(context.isa, mesh_picture_project);
  const auto draw = GGSLAM_DISPATCH(context.isa, mesh_picture_band);
  std::vector<ProjectedVertex> vertices(in->vertices);
  context.pool.parallel_for(vertices.size(), 4096, [&](std::size_t begin, std::size_t end, int) {
    project(*in, begin, end, vertices.data());
  });
  const std::size_t rows = std::max(1, in->height / (4 * context.pool.size()));
  context.pool.parallel_for(in->height, rows, [&](std::size_t begin, std::size_t end, int) {
    draw(*in, vertices.data(), static_cast<int>(begin), static_cast<int>(end), inverse_z, picture);
  });
}
