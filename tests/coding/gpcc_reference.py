# SPDX-License-Identifier: Apache-2.0
"""Slow and obvious decoders (ISO/IEC 23090-9, first edition) that the compiled ones are held against: the arithmetic
decoder, attribute coefficients, and the transform without prediction in floating point."""

from __future__ import annotations

import numpy as np


class Probability:
    """Of a zero, in 1/65536."""

    def __init__(self) -> None:
        self.zero = 0x8000


class ArithmeticDecoder:
    """One bit at a time; bytes past the end are 0xff."""

    def __init__(self, data: bytes, adaptation: list[int]) -> None:
        self._bits = (byte >> shift & 1 for byte in [*data, *[0xFF] * 64] for shift in range(7, -1, -1))
        self._adaptation = adaptation
        self._range = 0xFFFF
        self._code = 0
        for _ in range(16):
            self._code = self._code << 1 | next(self._bits)

    def decode(self, p: Probability) -> int:
        bit = self._split(self._narrowed(p.zero))
        if bit:
            p.zero -= self._adaptation[p.zero >> 8]
        else:
            p.zero += self._adaptation[255 - (p.zero >> 8)]
        return bit

    def bypass(self) -> int:
        return self._split(self._narrowed(0x8000))

    def _narrowed(self, zero: int) -> int:
        while self._range <= 0x4000:
            self._range <<= 1
            self._code = self._code << 1 | next(self._bits)
        return self._range * zero >> 16

    def _split(self, zero_part: int) -> int:
        if self._code >= zero_part:
            self._code -= zero_part
            self._range -= zero_part
            return 1
        self._range = zero_part
        return 0


class CoefficientDecoder:
    """Zero runs and triplets."""

    def __init__(self, data: bytes, adaptation: list[int]) -> None:
        self._coder = ArithmeticDecoder(data, adaptation)
        self._run = [Probability() for _ in range(5)]
        self._above_zero = [Probability() for _ in range(7)]
        self._above_one = [Probability() for _ in range(7)]
        self._prefix = [[Probability() for _ in range(3)] for _ in range(2)]
        self._suffix = [[Probability() for _ in range(3)] for _ in range(2)]

    def triplets(self, count: int) -> np.ndarray:
        """int64 [count, 3]."""
        out = np.zeros((count, 3), np.int64)
        at = 0
        while at < count:
            at += self.run()
            if at < count:
                out[at] = self._triplet()
            at += 1
        return out

    def run(self) -> int:
        for value in range(3):
            if not self._coder.decode(self._run[value]):
                return value
        for value in (3, 5, 7, 9):
            if not self._coder.decode(self._run[3]):
                return value + self._coder.bypass()
        order, value = 2, 11
        while self._coder.decode(self._run[4]):
            value += 1 << order
            order += 1
        for bit in range(order - 1, -1, -1):
            value += self._coder.bypass() << bit
        return value

    def _triplet(self) -> tuple[int, int, int]:
        one = self._signed(self._size(0, 0, 1))
        two = self._signed(self._size(1 + (one == 0), 1 + (abs(one) <= 1), 1))
        known = int(one == 0 and two == 0)
        zero_context, one_context = 3 + 2 * (one == 0) + (two == 0), 3 + 2 * (abs(one) <= 1) + (abs(two) <= 1)
        return self._signed(known + self._size(zero_context, one_context, 0)), one, two

    def _size(self, zero_context: int, one_context: int, group: int) -> int:
        if not self._coder.decode(self._above_zero[zero_context]):
            return 0
        if not self._coder.decode(self._above_one[one_context]):
            return 1
        order, value = 1, 2
        while self._coder.decode(self._prefix[group][min(order - 1, 2)]):
            value += 1 << order
            order += 1
        for bit in range(order - 1, -1, -1):
            value += self._coder.decode(self._suffix[group][min(bit, 2)]) << bit
        return value

    def _signed(self, size: int) -> int:
        return -size if size and self._coder.bypass() else size


def inverse_transform(points: np.ndarray, coefficients: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Attributes float64 [N, C] of distinct points [N, 3] in Morton order.

    Args:
        coefficients: quantised, [N, C], in the order of the stream.
        steps: quantiser steps [C].
    """
    depth = max(1, int(points.max()).bit_length())
    weights = [{tuple(p): 1 for p in points.tolist()}]
    for _ in range(depth):
        above: dict[tuple[int, ...], int] = {}
        for node, weight in weights[-1].items():
            parent = tuple(v >> 1 for v in node)
            above[parent] = above.get(parent, 0) + weight
        weights.append(above)
    levels = weights[::-1]
    root = max(level for level in range(depth + 1) if len(levels[level]) == 1)
    stream = iter(coefficients * steps)
    values = {next(iter(levels[root])): next(stream)}
    for level in range(root, depth):
        below: dict[tuple[int, ...], np.ndarray] = {}
        for node in levels[level]:  # in Morton order, as the leaves are
            children = {
                octant: levels[level + 1][child]
                for octant in range(8)
                if (child := _child(node, octant)) in levels[level + 1]
            }
            for octant, value in _inverse_block(children, values[node], stream).items():
                below[_child(node, octant)] = value
        values = below
    return np.array([values[tuple(p)] for p in points.tolist()])


def _child(node: tuple[int, ...], octant: int) -> tuple[int, ...]:
    return 2 * node[0] + (octant >> 2), 2 * node[1] + (octant >> 1 & 1), 2 * node[2] + (octant & 1)


def _inverse_block(children: dict[int, int], dc: np.ndarray, stream: object) -> dict[int, np.ndarray]:
    """Two-point transforms along z, y, x undone in reverse; coefficients in the scan order 0 4 2 1 6 5 3 7."""
    weights = [children.get(octant, 0) for octant in range(8)]
    record = []
    for axis in (1, 2, 4):
        for low in [octant for octant in range(8) if not octant & axis]:
            high = low | axis
            left, right = weights[low], weights[high]
            record.append((low, high, left, right))
            weights[low] = left + right
            weights[high] = left + right if left and right else 0
    values: list = [None] * 8
    values[0] = dc
    for octant in (4, 2, 1, 6, 5, 3, 7):
        if weights[octant]:
            values[octant] = next(stream)  # type: ignore[call-overload]
    for low, high, left, right in reversed(record):
        if left and right:
            a, b = np.sqrt(left / (left + right)), np.sqrt(right / (left + right))
            values[low], values[high] = a * values[low] - b * values[high], b * values[low] + a * values[high]
        elif right:
            values[low], values[high] = None, values[low]
    return {octant: values[octant] for octant in children}


class SiblingTreeDecoder:
    """Positions of a tree that splits all axes, with contexts from siblings only, one point a leaf, and quantisers.

    Args:
        data: the payload.
        tables: of the standard.
    """

    def __init__(self, data: bytes, tables: dict) -> None:
        self._coder, self._tables = ArithmeticDecoder(data, tables["entropy_lut_256"]), tables
        self._single, self._occupancy = Probability(), [Probability() for _ in range(32)]
        self._maps = [[127] * size for size in (9, 18, 35, 68, 69, 134, 135, 136)]
        self._has_offset, self._sign, self._prefix = Probability(), Probability(), Probability()
        self.qps: list[int] = []
        """Quantisers of the nodes that have one, in the order of the stream."""

    def positions(self, depth: int, slice_qp: int | None) -> np.ndarray:
        """int64 [N, 3], in the order of the stream; `slice_qp` None: the stream has no quantisers."""
        nodes = [((0, 0, 0), 0, 1, 0)]  # position, octant, occupancy of the parent, quantiser
        known, where, found = slice_qp is None, 0, []
        for size in range(depth, 0, -1):
            here = not known and self._coder.bypass() == 1
            if here:
                known, where = True, size
            below = []
            for position, octant, siblings, qp in nodes:
                if here:
                    qp = slice_qp + self._offset()
                    self.qps.append(qp)
                left = size - qp // 8
                occupancy = 1 if left <= 0 else self._occupied(octant, siblings if size < depth else 0)
                for child in (octant for octant in range(8) if occupancy >> octant & 1):
                    if left <= 1:
                        leaf = [v >> -min(left - 1, 0) for v in _child(position, child)]
                        found.append([self._restored(v, where, qp) for v in leaf])
                    else:
                        below.append((_child(position, child), child, occupancy, qp))
            nodes = below
        return np.array(found)

    @staticmethod
    def _restored(value: int, side: int, qp: int) -> int:
        """The low bits, those below the node that told the quantiser, are steps of 2^(qp / 8) (1 + qp % 8 / 8)."""
        shift = qp // 8
        coded = max(side - shift, 0)
        high, low = value >> coded, value % (1 << coded)
        eighths = low * (8 + qp % 8) * 2**shift
        return high * 2**side + min((eighths + 4) // 8, 2**side - 1)

    def _offset(self) -> int:
        if not self._coder.decode(self._has_offset):
            return 0
        order, value = 0, 1
        while self._coder.decode(self._prefix):
            value += 1 << order
            order += 1
        value += sum(self._coder.bypass() << bit for bit in range(order - 1, -1, -1))
        return -value if self._coder.decode(self._sign) else value

    def _occupied(self, octant: int, siblings: int) -> int:
        pattern = 0
        for axis, (upper, lower) in enumerate(((1, 2), (8, 4), (32, 16))):
            bit = 4 >> axis
            if siblings >> (octant ^ bit) & 1:
                pattern |= lower if octant & bit else upper
        if pattern == 0 and self._coder.decode(self._single):
            return 1 << (self._coder.bypass() << 2 | self._coder.bypass() << 1 | self._coder.bypass())
        kind = self._tables["neigh64to6"][pattern]
        kinds = [kind] * 4 + [self._tables["neigh9to5"][kind]] * 2 + [self._tables["neigh9to3"][kind]]
        order = self._tables["octant_permutation_per_pattern"][str(pattern)]
        zeros, occupancy, before = 6 if pattern == 0 else 7, 0, 0
        for bin_ in range(8):
            place = before.bit_count() if pattern == 0 else before + bin_ + 1
            if pattern and bin_ < 7:
                place += kinds[bin_] - 1 << bin_
            bit = 1 if zeros == 0 else self._bin(bin_, place)
            zeros -= 1 - bit
            before |= bit << bin_
            occupancy |= bit << [int(c) for c in order].index(self._tables["occ_bit_order"][bin_])
        return occupancy

    def _bin(self, bin_: int, place: int) -> int:
        entry, delta = self._maps[bin_][place], self._tables["ctx_evolve_delta"]
        bit = self._coder.decode(self._occupancy[entry >> 3])
        self._maps[bin_][place] += delta[(255 - entry) >> 4] if bit else -delta[entry >> 4]
        return bit
