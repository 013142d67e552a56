// SPDX-License-Identifier: Apache-2.0
// A laser scan as depth images to the sides of a cube around the sensor. Neighbouring points are joined by triangles,
// which are drawn exactly: where the scan measured a plane, so do the images, at every pixel.
#pragma once
#include <cstdint>
#include <vector>

#include "abi/core/volumes.hpp"
#include "common/vector.hpp"

namespace ggslam {
struct Context;
}

namespace ggslam::volumes {

class ScanFaces {
 public:
  ScanFaces(const ScanFaceSettings& settings, const float* points, std::size_t n);

  // Draws all triangles into `depth` [faces, size, size], 0 where none is.
  void draw(Context& context, const float* faces, int count, float* depth) const;
  std::size_t triangles() const { return triangles_.size() / 3; }

 private:
  struct Point {
    Vec3f at;
    float range, slope;  // slope: z over the distance from the sensor's axis, which grows with the elevation
  };
  const ScanFaceSettings settings_;
  std::vector<Point> points_;              // column by column, from below
  std::vector<std::uint32_t> first_;       // of each column, and the end
  std::vector<std::uint32_t> triangles_;   // three points each

  void sort_points(const float* points, std::size_t n);
  void join_columns(std::uint32_t left, std::uint32_t right);
  void add_triangle(std::uint32_t a, std::uint32_t b, std::uint32_t c);
  void draw_face(const Mat3f& axes, float* depth) const;
};

}  // namespace ggslam::volumes
