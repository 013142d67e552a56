# SPDX-License-Identifier: Apache-2.0
"""The quantiser of positions within the tree (ISO/IEC 23090-9, first edition: scaled geometry).

The encoder has one quantiser for all nodes, told at the root: positions of a slice become the nearest multiples of the
step, counted from the slice's lowest corner. Decoded positions stay in voxels of the grid, so a decoder places the
points without knowing of it; nodes with quantisers of their own are decoded, but not written.

Whole coordinates may lie half-way between two steps. Rounding them all up would shift the cloud (by half a voxel on
average where the step is even), so they go up or down by turns from step to step. Points of one plane stay together: it
may still move by half a step. Points that are no whole voxels are rounded once, not to voxels first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from ggslam.coding.geometry_syntax import MAX_DEPTH
from ggslam.coding.quantization import QuantizationTuning

Value = TypeVar("Value", int, np.ndarray)


class PositionQuantiser:
    """Steps of 2^(qp / 8) (8 + qp % 8) / 8 of a voxel, whole divisions: 1 at qp 0, 2 at 8, 3 at 12, 4 at 16.

    Args:
        qp: 0 and above.
    """

    def __init__(self, qp: int) -> None:
        self.qp = qp
        self._shift = qp >> 3
        self._eighths = (8 + (qp & 7)) << self._shift

    @property
    def step(self) -> float:
        """Voxels."""
        return self._eighths / 8

    @property
    def reach(self) -> int:
        """Voxels that a coordinate moves at most, up or down."""
        return 0 if self.qp == 0 else -(-self._eighths // 16)

    def steps(self, positions: np.ndarray) -> np.ndarray:
        """The multiples that a decoder puts nearest to positions, in voxels and not below -0.5: int32 of their shape.
        """
        if self.qp == 0:
            return positions.astype(np.int32)
        below = np.maximum(positions // self.step, 0).astype(np.int64)
        past = 2 * positions - self._voxels(below) - self._voxels(below + 1)
        turn = (below ^ below >> 1 ^ below >> 2 ^ below >> 3) & 1  # as often 1 as 0, whatever the divisions of the step
        half_way = np.abs(past) <= 2 * QuantizationTuning.rounding
        return (below + np.where(half_way, turn == 1, past > 0)).astype(np.int32)

    def bits(self, highest: Sequence[int]) -> list[int]:
        """Bits of the sides of a tree whose points have these highest multiples: none has to be rounded down, if the
        tree can be so large."""
        if self.qp == 0:
            return [int(value).bit_length() for value in highest]
        needed = (max(self._shift + n.bit_length(), self._voxels(n).bit_length()) for n in highest)
        return [min(bits, MAX_DEPTH) for bits in needed]

    def restore(self, steps: np.ndarray, bits: Sequence[int]) -> np.ndarray:
        """What a decoder makes of multiples int32 [N, 3] in a tree with sides of 2^bits: voxels."""
        if self.qp == 0:
            return steps
        most = np.array([(1 << side) - 1 for side in bits], np.int64)
        steps = np.minimum(steps, most >> self._shift)
        return np.minimum(self._voxels(steps.astype(np.int64)), most).astype(np.int32)

    def _voxels(self, steps: Value) -> Value:
        """Multiples of the step as voxels, rounded."""
        return (steps * self._eighths + 4) >> 3
