// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"
#include "interface/core/volumes.hpp"
#include "volumes/mesh.hpp"

using ggslam::Context;
using ggslam::volumes::MeshArrays;
using ggslam::volumes::Mesher;
using ggslam::volumes::SurfaceCells;
using ggslam::volumes::Tsdf;

GGSLAM_EXPORT void* ggslam_surface_cells_create(void* context_, void* tsdf, uint16_t min_weight) {
  Context& context = *static_cast<Context*>(context_);
  return new SurfaceCells(context.pool, context.isa, *static_cast<Tsdf*>(tsdf), min_weight);
}

GGSLAM_EXPORT void ggslam_surface_cells_destroy(void* cells) { delete static_cast<SurfaceCells*>(cells); }

GGSLAM_EXPORT void* ggslam_mesher_create(void* context, void* cells, int64_t* sizes) {
  Mesher* mesher = new Mesher(static_cast<Context*>(context)->pool, *static_cast<SurfaceCells*>(cells));
  sizes[0] = mesher->vertices(), sizes[1] = mesher->triangles();
  return mesher;
}

GGSLAM_EXPORT void ggslam_mesher_write(void* context, void* mesher, const MeshArrays* out) {
  static_cast<Mesher*>(mesher)->write(static_cast<Context*>(context)->pool, *out);
}

GGSLAM_EXPORT void ggslam_mesher_destroy(void* mesher) { delete static_cast<Mesher*>(mesher); }
