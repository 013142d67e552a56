# SPDX-License-Identifier: Apache-2.0
"""Coloured points sampled from a Gaussian map, on a regular grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.errors import InputError
from ggslam.formats.surface_discs import SurfaceDiscs, disc_samples
from ggslam.scene.gaussian_map import GaussianMap

_CHUNK = 300_000
"""Samples held in memory at a time..."""
_SMALL_CHUNK = 40_000
"""...and where memory is scarce (a sample takes some 350 bytes)."""
_FEW = 50_000
"""Voxels that are sampled, where Gaussians come in parts, before one looks which are finished."""
_BLOCK_EDGE = 0.25
"""Metres: how finely it is known where parts to come reach."""
_MOST_CUBES = 1 << 16
"""Of such blocks, that one Gaussian may reach into for it to be known which: 10 m in each direction."""
USUAL_VOXEL = 0.01
"""Metres."""
_MOST_SAMPLES = 250
"""Of a Gaussian, on average, in voxels that go with the map; a room's has 40 to 120 in voxels of 1 cm."""
_BITS = 21
"""Bits per axis of the packed voxel number."""


@dataclass(frozen=True)
class VoxelCloud:
    """Coloured points on a regular grid, at most one per voxel, sorted by grid coordinate (z fastest).

    Attributes:
        grid: int32 [N, 3] grid coordinates, none negative.
        colors: uint8 [N, 3] RGB.
        object_id: int32 [N], 0 = unlabelled, or None.
        voxel_size: metres.
        origin: float64 [3], metres: where grid coordinate (0, 0, 0) lies; a whole multiple of the voxel size.
    """

    grid: np.ndarray
    colors: np.ndarray
    object_id: np.ndarray | None
    voxel_size: float
    origin: np.ndarray

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def points(self) -> np.ndarray:
        """Positions in metres, float64 [N, 3]: origin + voxel_size * grid."""
        return self.origin + self.voxel_size * self.grid


def sample_points(
    gaussians: GaussianMap, voxel_size: float = 0.01, minimum_opacity: float = 0.3, with_object_id: bool = False
) -> VoxelCloud:
    """Samples a map into a coloured cloud, one point per voxel that a Gaussian visibly fills.

    Gaussians of an RGB-D map stand for pieces of surface, so each gives points of the disc through its mean along its
    two longest axes: its mean and, where it is larger than a voxel, the points of a square lattice at which its own
    alpha, opacity * exp(-d^2 / 2) with the Mahalanobis distance d, is at least `minimum_opacity`.
    Points that share a voxel become one: colours are averaged with these alphas as weights, the object id is the one
    of largest weight. Deterministic.

    Args:
        gaussians: the map; only the view-independent part of its colours is used.
        voxel_size: edge of a voxel in metres.
        minimum_opacity: in (0, 1); fainter Gaussians and the faint outskirts of others are left out.
        with_object_id: whether the points carry the object ids.

    Raises:
        InputError: impossible settings, or a map that spans more than 2^21 voxels.
    """
    if not voxel_size > 0 or not 0 < minimum_opacity < 1:
        raise InputError(f"impossible voxel size {voxel_size} or minimum opacity {minimum_opacity}")
    discs = SurfaceDiscs.of(gaussians, minimum_opacity)
    merged = _add_samples(_Sums.empty(), gaussians, discs, voxel_size, with_object_id)
    return _cloud(merged, voxel_size, with_object_id)


@dataclass(frozen=True)
class MapPart:
    """A part of a map that is not in memory: corners float64 [3] of the box its Gaussians reach to, and how to get
    it."""

    low: np.ndarray
    high: np.ndarray
    load: Callable[[], GaussianMap]

    @staticmethod
    def of(gaussians: GaussianMap) -> MapPart:
        """A map in memory as one part."""
        means = gaussians.means.detach().cpu().numpy().astype(np.float64)
        if not len(means):
            means = np.zeros((1, 3))
        return MapPart(means.min(0), means.max(0), lambda: gaussians)


def sample_parts(
    parts: Sequence[MapPart], voxel_size: float | None = None, minimum_opacity: float = 0.3,
    with_object_id: bool = False,
) -> Iterator[VoxelCloud]:  # fmt: skip
    """Like `sample_points` of all parts together, in clouds one after the other, each with an origin of its own.
    Without a voxel size it goes with the map, see `voxel_size_for`.

    Parts are read twice, and before that once more if a voxel size has to be found: at first to see which cubes of
    space each has samples in. Then they are swept along the longest side of the map, each cut in sections; voxels in
    cubes that no later section reaches are handed out. So no more is in memory than one part, the samples of a section,
    and voxels at the borders of what was done to what was not.
    """
    if not parts:
        return
    voxel_size = voxel_size_for(parts, minimum_opacity) if voxel_size is None else voxel_size
    lows, highs = np.stack([part.low for part in parts]), np.stack([part.high for part in parts])
    axis = int((highs.max(0) - lows.min(0)).argmax())
    order = np.argsort(lows[:, axis], kind="stable").tolist()
    sections: list[np.ndarray | None] = []
    for number in order:
        whole = SurfaceDiscs.of(parts[number].load(), minimum_opacity)
        sections += [_cubes(discs, voxel_size) for discs in whole.cut(axis)]
    blocks, done = _Blocks(sections, voxel_size), 0
    waiting, pending, sampled = _Sums.empty(), [], 0
    for number in order:
        part = parts[number].load()
        for discs in SurfaceDiscs.of(part, minimum_opacity).cut(axis):
            pending.append(_add_samples(_Sums.empty(), part, discs, voxel_size, with_object_id, _SMALL_CHUNK))
            blocks.is_done(done)
            done, sampled = done + 1, sampled + len(pending[-1].key)
            if sampled < max(_FEW, len(waiting.key)) and not blocks.all_done:  # joining costs as much as what waits
                continue
            waiting, pending, sampled = _Sums.of([waiting, *pending]), [], 0
            finished = blocks.are_done(waiting.key)
            if finished.any():
                yield _cloud(waiting.of_rows(finished), voxel_size, with_object_id)
                waiting = waiting.of_rows(~finished)


def voxel_size_for(parts: Sequence[MapPart], minimum_opacity: float = 0.3) -> float:
    """Edge of voxels that suits a map, a whole number of centimetres: 1, and more where Gaussians are much larger than
    a room's, in halls or where depth has a wrong unit. A cloud of those in voxels of 1 cm takes the time and the disk
    of hundreds of rooms."""
    size, mean = 0.0, 2.0 * _MOST_SAMPLES
    while mean > _MOST_SAMPLES:
        size = USUAL_VOXEL * max(1, math.ceil(size / USUAL_VOXEL * math.sqrt(mean / _MOST_SAMPLES)))
        samples = gaussians = 0
        for part in parts:
            discs = SurfaceDiscs.of(part.load(), minimum_opacity)
            samples += int(discs.counts(size).sum())
            gaussians += len(discs.used)
        mean = samples / max(1, gaussians)
    return size


def _cube_edge(voxel_size: float) -> int:
    """Of the cubes that finished space is counted in, voxels."""
    return max(1, round(_BLOCK_EDGE / voxel_size))


def _cubes(discs: SurfaceDiscs, voxel_size: float) -> np.ndarray | None:
    """The cubes that samples may fall into, packed, sorted; None: a Gaussian is so large that they are too many."""
    # A disc reaches along an axis of the world as far as its two half axes do together, and samples are rounded.
    reach = np.sqrt(((discs.axes * discs.reach[:, None, :]) ** 2).sum(2)) + voxel_size
    edge = voxel_size * _cube_edge(voxel_size)
    low, high = (np.floor((discs.means + side * reach) / edge).astype(np.int64) for side in (-1, 1))
    if ((high - low + 1.0).prod(1)).max(initial=0) > _MOST_CUBES:
        return None
    few = ((high - low) <= 1).all(1)
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    found = [np.unique(_pack(np.minimum(low[few] + corner, high[few]))) for corner in corners]
    for a, b in zip(low[~few], high[~few], strict=True):
        axes = [np.arange(start, stop + 1) for start, stop in zip(a, b, strict=True)]
        found.append(_pack(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)))
    return np.unique(np.concatenate(found))


class _Blocks:
    """Tells which voxels no section to come reaches.

    Args:
        of_section: the cubes that each reaches into, from `_cubes`; None: into any.
    """

    def __init__(self, of_section: list[np.ndarray | None], voxel_size: float) -> None:
        self._edge, self._of_section = _cube_edge(voxel_size), of_section
        known = [cubes for cubes in of_section if cubes is not None]
        self._keys, self._to_come = np.unique(np.concatenate([np.empty(0, np.int64), *known]), return_counts=True)
        self._left, self._boundless = len(of_section), len(of_section) - len(known)

    @property
    def all_done(self) -> bool:
        """Whether no section is to come."""
        return self._left == 0

    def is_done(self, section: int) -> None:
        """A section is not to come any more."""
        cubes = self._of_section[section]
        if cubes is None:
            self._boundless -= 1
        else:
            self._to_come[np.searchsorted(self._keys, cubes)] -= 1
        self._left -= 1

    def are_done(self, voxels: np.ndarray) -> np.ndarray:
        """Whether voxels (packed, [N]) lie in the cubes of no section to come, bool [N]."""
        if not len(voxels) or self.all_done:
            return np.ones(len(voxels), bool)
        if self._boundless:
            return np.zeros(len(voxels), bool)
        if not len(self._keys):
            return np.ones(len(voxels), bool)
        key = _pack(_unpack(voxels) // self._edge)
        place = np.searchsorted(self._keys, key).clip(max=len(self._keys) - 1)
        return (self._keys[place] != key) | (self._to_come[place] == 0)


def _add_samples(
    merged: _Sums, gaussians: GaussianMap, discs: SurfaceDiscs, voxel_size: float, with_object_id: bool,
    chunk: int = _CHUNK,
) -> _Sums:  # fmt: skip
    """The sums with those of samples of a map, of which `chunk` are in memory at a time."""
    pending, waiting = [], 0
    for position, weight, color, object_id in disc_samples(gaussians, discs, voxel_size, chunk):
        lattice = np.rint(position / voxel_size)
        if np.abs(lattice).max(initial=0) >= 1 << (_BITS - 1):
            raise InputError(f"the map spans more than 2^{_BITS} voxels of {voxel_size} m")
        labels = object_id if with_object_id else np.zeros_like(object_id)
        part = _Sums.of([_Sums(_pack(lattice.astype(np.int64)), labels, weight, weight[:, None] * color)])
        pending.append(part)
        waiting += len(part.key)
        if waiting > len(merged.key):  # rarely, so that all merging together costs about as much as one sort
            merged, pending, waiting = _Sums.of([merged, *pending]), [], 0
    return _Sums.of([merged, *pending])


def _pack(lattice: np.ndarray) -> np.ndarray:
    """One int64 per voxel from signed coordinates [N, 3]."""
    x, y, z = (lattice + (1 << (_BITS - 1))).T
    return (x << 2 * _BITS) | (y << _BITS) | z


def _unpack(key: np.ndarray) -> np.ndarray:
    limit = (1 << _BITS) - 1
    return np.stack([key >> 2 * _BITS, (key >> _BITS) & limit, key & limit], 1) - (1 << (_BITS - 1))


@dataclass(frozen=True)
class _Sums:
    """Weighted sums per voxel and object: key and label [N] (sorted, unique pairs once joined), weight, colour."""

    key: np.ndarray
    label: np.ndarray
    weight: np.ndarray
    color: np.ndarray

    @staticmethod
    def empty() -> _Sums:
        return _Sums(np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0), np.empty((0, 3)))

    def of_rows(self, chosen: np.ndarray) -> _Sums:
        """Some rows, bool [N]."""
        return _Sums(self.key[chosen], self.label[chosen], self.weight[chosen], self.color[chosen])

    @staticmethod
    def of(parts: list[_Sums]) -> _Sums:
        """All parts together, one row per (voxel, label)."""
        key, label = np.concatenate([p.key for p in parts]), np.concatenate([p.label for p in parts])
        order = np.lexsort((label, key)) if label.any() else np.argsort(key, kind="stable")
        key, label = key[order], label[order]
        starts = np.nonzero(_first_of_runs(key) | _first_of_runs(label))[0]
        if not len(starts):
            return parts[0]
        weight = np.concatenate([p.weight for p in parts])[order]
        color = np.concatenate([p.color for p in parts])[order]
        return _Sums(key[starts], label[starts], np.add.reduceat(weight, starts), np.add.reduceat(color, starts))


def _first_of_runs(values: np.ndarray) -> np.ndarray:
    first = np.ones(len(values), bool)
    first[1:] = values[1:] != values[:-1]
    return first


def _cloud(sums: _Sums, voxel_size: float, with_object_id: bool) -> VoxelCloud:
    if not len(sums.key):
        nothing = np.empty((0, 3), np.int32)
        ids = np.empty(0, np.int32) if with_object_id else None
        return VoxelCloud(nothing, nothing.astype(np.uint8), ids, voxel_size, np.zeros(3))
    # Heaviest label first within each voxel, the smaller id at a tie: the first row of each run then names the object.
    order = np.lexsort((sums.label, -sums.weight, sums.key))
    key, label = sums.key[order], sums.label[order]
    starts = np.nonzero(_first_of_runs(key))[0]
    color = np.add.reduceat(sums.color[order], starts) / np.add.reduceat(sums.weight[order], starts)[:, None]
    lattice = _unpack(key[starts])
    corner = lattice.min(0)
    return VoxelCloud(
        grid=(lattice - corner).astype(np.int32),
        colors=np.rint(255 * color).astype(np.uint8),
        object_id=label[starts] if with_object_id else None,
        voxel_size=voxel_size,
        origin=corner * voxel_size,
    )
