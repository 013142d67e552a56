// SPDX-License-Identifier: Apache-2.0
#include <limits>
#include <memory>
#include <stdexcept>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/mesh.hpp"

using ggslam::check_array;
using ggslam::Context;
using ggslam::object_of;
using ggslam::volumes::MeshArrays;
using ggslam::volumes::Mesher;
using ggslam::volumes::SurfaceCells;
using ggslam::volumes::Tsdf;

GGSLAM_EXPORT void* ggslam_surface_cells_create(void* context_, void* tsdf, uint16_t min_weight) try {
  Context& context = object_of<Context>(context_);
  return new SurfaceCells(context.pool, context.isa, object_of<Tsdf>(tsdf), min_weight);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_surface_cells_destroy(void* cells) try {
  delete static_cast<SurfaceCells*>(cells);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT void* ggslam_mesher_create(void* context, void* cells, int64_t* sizes) try {
  check_array("sizes", sizes, 2);
  auto mesher = std::make_unique<Mesher>(object_of<Context>(context).pool, object_of<SurfaceCells>(cells));
  if (mesher->vertices() > std::numeric_limits<int32_t>::max()) throw std::runtime_error("too many vertices to number");
  sizes[0] = mesher->vertices(), sizes[1] = mesher->triangles();
  return mesher.release();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_mesher_write(void* context, void* mesher, const MeshArrays* out) try {
  const MeshArrays& to = object_of<MeshArrays>(out);
  const int64_t n = object_of<Mesher>(mesher).vertices();
  check_array("vertices", to.vertices, n), check_array("normals", to.normals, n), check_array("colors", to.colors, n);
  check_array("labels", to.labels, n), check_array("triangles", to.triangles, object_of<Mesher>(mesher).triangles());
  object_of<Mesher>(mesher).write(object_of<Context>(context).pool, *out);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_mesher_destroy(void* mesher) try {
  delete static_cast<Mesher*>(mesher);
  return 0;
} GGSLAM_CATCH_ALL
