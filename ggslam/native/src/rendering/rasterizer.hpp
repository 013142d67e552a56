// SPDX-License-Identifier: Apache-2.0
// The differentiable Gaussian rasterizer: what its stages share. The stages themselves are in kernels/:
//
//   project_block    Gaussians -> splats (mean, conic, opacity, colour in the image), tile counts    projection.cpp
//   scatter_block    splats -> per-tile lists of (depth, splat)                                      binning.cpp
//   forward_tile     sort one tile's list by depth, composite it front to back                       tiles_forward.cpp
//   backward_tile    back to front: one gradient slot per (splat, tile) pair                         tiles_backward.cpp
//   gather_block     sum a Gaussian's slots, differentiate the projection, store or apply Adam       gather.cpp
//
// rasterizer.cpp runs them over blocks of Gaussians and over tiles. Blocks and tiles write only to places of their own
// and every sum has a fixed order, so results do not depend on the number of threads.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "common/buffer.hpp"
#include "common/context.hpp"
#include "abi/core/rendering.hpp"
#include "native/formulas/rendering_rules.hpp"

namespace ggslam {

constexpr int kSubBlocks = 32;                  // sub-blocks of a tile, each of as many pixels as a vector has lanes
constexpr int kBaseGradients = 10;              // log-alpha moments 1, r, dy, r^2, r dy, dy^2; colour; depth
constexpr int kSlotStride = 16;                 // floats from one gradient slot to the next: one cache line
constexpr int kSlotsAtOnce = 4;                 // that are read of every splat, be they its own or not
constexpr int kMaxBlocks = 32;
constexpr int kChunk = 64;                      // splats that a tile composites at a time

// schedule [rows][8]: for a Gaussian at its u-th update, row min(u, rows) - 1 holds the step sizes (learning rate over
// 1 - beta1^u) of the seven groups in the order below, then 1 / sqrt(1 - beta2^u).
enum AdamGroup { kMeans, kQuaternions, kLogScales, kOpacityLogits, kShConstant, kShRest, kFeatures, kCorrection };

// One update more, as far as 32 bits count; a negative counter, which may come from a file, begins anew.
inline std::int32_t next_update(std::int32_t updates) {
  return updates < 0 ? 1 : updates + (updates < std::numeric_limits<std::int32_t>::max());
}

// Row of a schedule for a Gaussian at its `updates`-th update.
inline std::size_t schedule_row(std::int32_t updates, std::int32_t rows) {
  return static_cast<std::size_t>(std::clamp(updates, 1, rows) - 1);
}

// --- what the stages hand to one another -----------------------------------------------------------------------------

// Pixels of a sub-block, which are the lanes of a vector, and of a tile along each axis. All are powers of two.
struct TileLayout {
  int lanes, width, height;
};

// Tiles that a splat covers.
struct TileRectangle {
  std::uint16_t x, y, wide, high;
};

// What binning needs to know of a splat.
struct Footprint {
  std::uint32_t depth_bits;
  TileRectangle tiles;
};

// Everything a tile needs to know of a projected Gaussian, in one cache line.
struct alignas(64) Splat {
  float mean_x, mean_y;                // pixels
  // With r = dx - slope_x dy: log2 alpha = log2_opacity + conic_r r^2 + conic_y dy^2. In dx and dy themselves the three
  // terms of a long, thin splat cancel and leave no digits, neither of alpha nor of its moments.
  float slope_x, conic_r, conic_y;
  float log2_opacity;
  float red, green, blue;
  float depth;
  float slope_y;                       // the dy of highest alpha in a column is slope_y dx; in a row, dx is slope_x dy
  std::uint32_t first_pair;            // number of its first (splat, tile) pair, within the block
  std::int32_t gaussian;               // row in the map
  TileRectangle tiles;
};
static_assert(sizeof(Splat) == 64, "a splat fills one cache line");

struct TileEntry {
  std::uint32_t depth_bits;  // the float's bits: ordered like the depth, which is positive
  std::uint32_t splat;
};

struct ThreadScratch {
  Buffer<TileEntry> sorting;
  Buffer<float> pixel_features;     // [sub-blocks][channels][lanes]: accumulated features or their gradients
  Buffer<float> gaussian_features;  // [up to kChunk Gaussians][channels]
  Buffer<float> contributions;      // [up to kChunk * kSubBlocks][2][lanes]: gradients and weights of the backward pass
};

struct Rasterizer {
  explicit Rasterizer(Context& context_) : context(context_), scratch(new ThreadScratch[context_.pool.size()]) {}
  ~Rasterizer() { delete[] scratch; }
  Context& context;
  ThreadScratch* scratch;  // one per thread

  GaussianArrays gaussians{};
  CameraView view{};
  bool as_3dgs = false;     // the last forward was by the rules of 3DGS
  bool ready = false;       // the last forward went well: its lists may be looked at
  int padded_features = 0;  // rendered feature channels, rounded up to a multiple of 4
  TileLayout tile{};
  int tiles_x = 0, tiles_y = 0;

  int blocks = 0;                     // Gaussians [b * block_size, (b + 1) * block_size) form block b
  int block_shift = 0;                // log2 of block_size
  std::int64_t block_size = 0;
  Buffer<Splat> splats;               // those of block b start at b * block_size
  Buffer<Footprint> footprints;       // likewise
  std::int32_t visible[kMaxBlocks];   // number of splats per block
  std::uint64_t pairs[kMaxBlocks];    // number of (splat, tile) pairs per block; then of all blocks before it
  std::uint64_t pair_count = 0;

  Buffer<std::uint32_t> tile_cursor;  // [blocks][tiles + 1]: counts, then where the block's next entry goes; one spare
  Buffer<std::uint32_t> tile_start;   // [tiles + 1]
  Buffer<TileEntry> entries;          // [pairs], tile by tile; sorted by depth by forward_tile; one spare per block
  Buffer<std::uint32_t> contributed;  // [pairs] in the order of entries: sub-blocks to which the splat contributed
  Buffer<float> transmittance;        // [tiles][sub-blocks][lanes], after the last Gaussian
  Buffer<std::int32_t> last_entry;    // [tiles][sub-blocks][lanes]: number in the tile's list of the last contribution

  Buffer<std::uint8_t> slot_used;     // [pairs], Gaussian by Gaussian; some to spare
  Buffer<float> slots;                // [pairs][kSlotStride]
  Buffer<float> feature_slots;        // [pairs][padded_features]
  Buffer<double> block_twist;         // [blocks][6]

  int tiles() const { return tiles_x * tiles_y; }
  // Number of the pair of a splat and a tile: that of its gradient slot. Pairs are numbered Gaussian by Gaussian
  // and, within the splat's rectangle, row by row.
  std::size_t pair_number(std::uint32_t splat_index, const Splat& splat, int tile_x, int tile_y) const {
    return pairs[splat_index >> block_shift] + splat.first_pair +
           static_cast<std::size_t>((tile_y - splat.tiles.y) * splat.tiles.wide + (tile_x - splat.tiles.x));
  }
  std::uint32_t* cursors(int block) const {
    return tile_cursor.data() + static_cast<std::size_t>(block) * static_cast<std::size_t>(tiles() + 1);
  }
  std::int64_t block_begin(int b) const { return b * block_size; }
  std::int64_t block_end(int b) const {
    const std::int64_t end = (b + 1) * block_size;
    return end < gaussians.count ? end : gaussians.count;
  }
};

}  // namespace ggslam

GGSLAM_DECLARE_KERNEL(TileLayout tile_layout())
GGSLAM_DECLARE_KERNEL(void project_block(Rasterizer& r, int block))
GGSLAM_DECLARE_KERNEL(void scatter_block(Rasterizer& r, int block))
GGSLAM_DECLARE_KERNEL(void forward_tile(Rasterizer& r, int tile, const RenderTargets& targets, ThreadScratch& scratch))
GGSLAM_DECLARE_KERNEL(void backward_tile(Rasterizer& r, int tile, const ImageGradients& gradients,
                                         ThreadScratch& scratch))
GGSLAM_DECLARE_KERNEL(void gather_block(Rasterizer& r, int block, const GaussianGradients& gradients,
                                        const AdamArguments* adam, ThreadScratch& scratch))
