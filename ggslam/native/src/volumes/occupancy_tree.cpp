// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_tree.hpp"

#include <algorithm>

namespace ggslam {
namespace {

bool one_value(const OccupancyBlock& block) {
  for (const std::uint64_t word : block.known)
    if (word != ~std::uint64_t{0}) return false;
  return std::all_of(block.value, block.value + kBlockVoxels, [&](float v) { return v == block.value[0]; });
}

bool one_leaf(const Cell child[8]) {
  for (int i = 0; i < 8; ++i)
    if (child[i].kind != CellKind::leaf || child[i].value != child[0].value) return false;
  return true;
}

}  // namespace

Cell OccupancyTree::find(std::uint64_t block_code) const {
  Cell cell = root;
  for (int depth = 0; cell.kind == CellKind::node; ++depth)
    cell = nodes[cell.index].child[child_of_block(block_code, depth)];
  return cell;
}

// Replaces a leaf or an unknown cell by a node of eight like it.
void OccupancyTree::split(Cell& cell) {
  const std::uint32_t index = nodes.take();
  for (Cell& child : nodes[index].child) child = cell;
  cell = {CellKind::node, index, 0};
}

OccupancyBlock& OccupancyTree::open(std::uint64_t block_code) {
  Cell* cell = &root;
  for (int depth = 0; depth < kBlockDepth; ++depth) {
    if (cell->kind != CellKind::node) split(*cell);
    cell = &nodes[cell->index].child[child_of_block(block_code, depth)];
  }
  if (cell->kind != CellKind::block) {
    const bool leaf = cell->kind == CellKind::leaf;
    const std::uint32_t index = blocks.take();
    OccupancyBlock& block = blocks[index];
    std::fill_n(block.value, kBlockVoxels, leaf ? cell->value : 0.0f);
    std::fill_n(block.known, kBlockVoxels / 64, leaf ? ~std::uint64_t{0} : 0);
    *cell = {CellKind::block, index, 0};
  }
  return blocks[cell->index];
}

// Makes a leaf of a node whose children are equal leaves.
void OccupancyTree::fold(Cell& cell) {
  const OccupancyNode& node = nodes[cell.index];
  if (!one_leaf(node.child)) return;
  const float value = node.child[0].value;
  nodes.give_back(cell.index);
  cell = {CellKind::leaf, 0, value};
}

void OccupancyTree::collapse(std::uint64_t block_code) {
  Cell* path[kBlockDepth + 1] = {&root};
  for (int depth = 0; depth < kBlockDepth; ++depth) {
    if (path[depth]->kind != CellKind::node) return;
    path[depth + 1] = &nodes[path[depth]->index].child[child_of_block(block_code, depth)];
  }
  Cell& cell = *path[kBlockDepth];
  if (cell.kind != CellKind::block || !one_value(blocks[cell.index])) return;
  const float value = blocks[cell.index].value[0];
  blocks.give_back(cell.index);
  cell = {CellKind::leaf, 0, value};
  for (int depth = kBlockDepth - 1; depth >= 0 && path[depth + 1]->kind == CellKind::leaf; --depth) fold(*path[depth]);
}

Cell OccupancyTree::make_block(const OccupancyBlock& content) {
  if (one_value(content)) return {CellKind::leaf, 0, content.value[0]};
  const std::uint32_t index = blocks.take();
  blocks[index] = content;
  return {CellKind::block, index, 0};
}

Cell OccupancyTree::make_node(const Cell child[8]) {
  if (one_leaf(child)) return child[0];
  const std::uint32_t index = nodes.take();
  std::copy_n(child, 8, nodes[index].child);
  return {CellKind::node, index, 0};
}

void OccupancyTree::clear() {
  root = {};
  nodes = {};
  blocks = {};
}

}  // namespace ggslam
