// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "rendering/mesh_picture.hpp"

GGSLAM_DECLARE_KERNEL(void mesh_picture_project(const MeshPictureInput& in, std::size_t begin, std::size_t end,
                                                ProjectedVertex* out))
GGSLAM_DECLARE_KERNEL(void mesh_picture_band(const MeshPictureInput& in, const ProjectedVertex* vertices, int top,
                                             int bottom, float* inverse_z, uint8_t* picture))

using namespace ggslam;

namespace {

void check_picture(const MeshPictureInput& in) {
  check_range("width", in.width, 1, kMostPixelsAlong);
  check_range("height", in.height, 1, kMostPixelsAlong);
  check_array("positions", in.positions, in.vertices), check_array("colors", in.colors, in.vertices);
  check_array("triangles", in.triangles, in.count);
  const std::size_t corners = elements(in.count, 3);
  for (std::size_t i = 0; i < corners; ++i)
    if (in.triangles[i] < 0 || in.triangles[i] >= in.vertices)
      refuse("triangles: expected vertices below %lld, found %d", static_cast<long long>(in.vertices), in.triangles[i]);
}

}  // namespace

GGSLAM_EXPORT int ggslam_draw_mesh(void* context_, const MeshPictureInput* in, float* inverse_z, uint8_t* picture) try {
  Context& context = object_of<Context>(context_);
  check_picture(object_of<MeshPictureInput>(in));
  check_array("inverse_z", inverse_z, 1), check_array("picture", picture, 1);
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
  return 0;
} GGSLAM_CATCH_ALL
