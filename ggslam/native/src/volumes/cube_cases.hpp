// SPDX-License-Identifier: Apache-2.0
// How a surface cuts a cube whose corners are inside or outside (W. Lorensen and H. Cline, "Marching Cubes", 1987).
#pragma once
#include <cstdint>
#include <vector>

namespace ggslam::volumes {

// An edge of the cube: from the corner with offsets x, y, z (0 or 1) along an axis.
struct CubeEdge {
  uint8_t axis, x, y, z;
};

// Corner x + 2 y + 4 z of the cube is bit x + 2 y + 4 z of a case, set where it is inside.
class CubeCases {
 public:
  CubeCases();
  static const CubeCases& instance();

  CubeEdge edges[12];
  // Edges of the triangles of a case, three each, counter-clockwise seen from outside.
  const uint8_t* begin(int number) const { return corners_.data() + first_[number]; }
  int triangles(int number) const { return (first_[number + 1] - first_[number]) / 3; }

 private:
  int first_[257];
  std::vector<uint8_t> corners_;
};

}  // namespace ggslam::volumes
