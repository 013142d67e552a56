// SPDX-License-Identifier: Apache-2.0
// The table of cases is made by walking around the faces of the cube. Where a face has two inside corners opposite
// each other, they are kept apart. This looks at the face's own corners only, so the cubes on both sides agree.
#include "volumes/cube_cases.hpp"

#include <utility>

namespace ggslam::volumes {
namespace {

constexpr int kNone = -1;

// Edge between two corners: 4 axis + the corner's other two offsets.
int edge_between(int a, int b) {
  const int low = a < b ? a : b, step = a ^ b;
  const int axis = step == 1 ? 0 : step == 2 ? 1 : 2;
  return 4 * axis + (axis == 0 ? low >> 1 : axis == 1 ? (low & 1) + (low >> 2) * 2 : low & 3);
}

// Corners of a face (across `axis`, on its low or high side), counter-clockwise seen from outside the cube.
void face_corners(int axis, int side, int corners[4]) {
  const int u = 1 << (axis + 1) % 3, v = 1 << (axis + 2) % 3, base = side << axis;
  const int ring[4] = {base, base + u, base + u + v, base + v};
  for (int i = 0; i < 4; ++i) corners[i] = side ? ring[i] : ring[3 - i];
}

// Faces of an edge, as bits.
int faces_of(const CubeEdge& edge) {
  const int offset[3] = {edge.x, edge.y, edge.z};
  int faces = 0;
  for (int axis = 0; axis < 3; ++axis)
    if (axis != edge.axis) faces |= 1 << (2 * axis + offset[axis]);
  return faces;
}

// For each edge the one that follows on the outline of the surface, kNone where the surface does not pass.
void outlines(int number, int next[12]) {
  for (int e = 0; e < 12; ++e) next[e] = kNone;
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      int corner[4];
      face_corners(axis, side, corner);
      const auto inside = [&](int i) { return (number >> corner[i & 3]) & 1; };
      for (int i = 0; i < 4; ++i) {
        if (inside(i) || !inside(i + 1)) continue;  // a run of inside corners begins behind i
        int end = i + 1;
        while (inside(end + 1)) ++end;
        next[edge_between(corner[i], corner[(i + 1) & 3])] = edge_between(corner[end & 3], corner[(end + 1) & 3]);
      }
    }
}

struct Triangulation {
  const std::vector<int>& polygon;
  const CubeEdge* edges;
  std::vector<uint8_t> out;

  // Whether the polygon's corners a < b may be joined: they are neighbours, or the diagonal runs through the inside
  // of the cube. On a face it could coincide with one of the next cube.
  bool joined(int a, int b) const {
    if (b - a == 1 || b - a == static_cast<int>(polygon.size()) - 1) return true;
    return (faces_of(edges[polygon[a]]) & faces_of(edges[polygon[b]])) == 0;
  }

  // Fills the part of the polygon from corner a to b.
  bool fill(int a, int b) {
    if (b - a < 2) return true;
    const std::size_t size = out.size();
    for (int m = a + 1; m < b; ++m) {
      if (!joined(a, m) || !joined(m, b)) continue;
      for (int corner : {a, m, b}) out.push_back(static_cast<uint8_t>(polygon[corner]));
      if (fill(a, m) && fill(m, b)) return true;
      out.resize(size);
    }
    return false;
  }
};

}  // namespace

CubeCases::CubeCases() {
  for (int e = 0; e < 12; ++e) {
    const int axis = e / 4, a = e & 1, b = (e >> 1) & 1;
    const int offset[3][3] = {{0, a, b}, {a, 0, b}, {a, b, 0}};
    edges[e] = {static_cast<uint8_t>(axis), static_cast<uint8_t>(offset[axis][0]),
                static_cast<uint8_t>(offset[axis][1]), static_cast<uint8_t>(offset[axis][2])};
  }
  for (int number = 0; number < 256; ++number) {
    first_[number] = static_cast<int>(corners_.size());
    int next[12];
    outlines(number, next);
    for (int start = 0; start < 12; ++start) {
      std::vector<int> polygon;
      for (int e = start; next[e] != kNone; e = std::exchange(next[e], kNone)) polygon.push_back(e);
      if (polygon.empty()) continue;
      Triangulation triangulation{polygon, edges, {}};
      triangulation.fill(0, static_cast<int>(polygon.size()) - 1);
      corners_.insert(corners_.end(), triangulation.out.begin(), triangulation.out.end());
    }
  }
  first_[256] = static_cast<int>(corners_.size());
}

const CubeCases& CubeCases::instance() {
  static const CubeCases cases;
  return cases;
}

}  // namespace ggslam::volumes
