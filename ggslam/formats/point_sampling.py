# SPDX-License-Identifier: Apache-2.0
"""Coloured points sampled from a Gaussian map, on a regular grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.errors import InputError
from ggslam.formats.pending_cubes import PendingCubes
from ggslam.formats.surface_discs import SurfaceDiscs, disc_samples
from ggslam.formats.voxel_cloud import BITS, VoxelCloud, VoxelSums, cloud_of_sums, pack, unpack
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.given_map import given_map
from ggslam.system.tuning import Tuning


class PointSamplingTuning(Tuning):
    """How Gaussians are sampled to a point cloud."""

    samples_at_once = 300_000
    """Samples in memory at a time."""
    few_samples_at_once = 40_000
    """The same where memory is scarce; a sample takes about 350 bytes."""
    voxels_before_check = 50_000
    """Voxels that are sampled before finished ones are looked for, where Gaussians come in parts."""
    block_edge_m = 0.25
    """Side of the blocks that tell where later parts reach, in metres."""
    max_blocks = 1 << 16
    """Most blocks that one Gaussian may reach into to be counted in them: 10 m in each direction."""
    voxel_m = 0.01
    """Side of a voxel where none is given, in metres."""
    max_samples = 250
    """Most samples of a Gaussian on average in voxels chosen for the map; a room has 40 to 120 at 1 cm."""


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
        gaussians: the map, or a model; only the view-independent part of its colours is used.
        voxel_size: edge of a voxel in metres.
        minimum_opacity: in (0, 1); fainter Gaussians and the faint outskirts of others are left out.
        with_object_id: whether the points carry the object ids.

    Raises:
        InputError: impossible settings, no map, or one that spans more than 2^21 voxels.
    """
    gaussians = given_map(gaussians)
    if not voxel_size > 0 or not 0 < minimum_opacity < 1:
        raise InputError(f"impossible voxel size {voxel_size} or minimum opacity {minimum_opacity}")
    discs = SurfaceDiscs.of(gaussians, minimum_opacity)
    merged = _add_samples(VoxelSums.empty(), gaussians, discs, voxel_size, with_object_id)
    return cloud_of_sums(merged, voxel_size, with_object_id)


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
    to_come, done = PendingCubes(sections), 0
    waiting, pending, sampled = VoxelSums.empty(), [], 0
    for number in order:
        part = parts[number].load()
        for discs in SurfaceDiscs.of(part, minimum_opacity).cut(axis):
            pending.append(
                _add_samples(
                    VoxelSums.empty(), part, discs, voxel_size, with_object_id, PointSamplingTuning.few_samples_at_once
                )
            )
            to_come.is_done(done)
            done, sampled = done + 1, sampled + len(pending[-1].key)
            if (
                sampled < max(PointSamplingTuning.voxels_before_check, len(waiting.key)) and not to_come.all_done
            ):  # joining costs as much as what waits
                continue
            waiting, pending, sampled = VoxelSums.of([waiting, *pending]), [], 0
            finished = to_come.are_done(pack(unpack(waiting.key) // _cube_edge(voxel_size)))
            if finished.any():
                yield cloud_of_sums(waiting.of_rows(finished), voxel_size, with_object_id)
                waiting = waiting.of_rows(~finished)


def voxel_size_for(parts: Sequence[MapPart], minimum_opacity: float = 0.3) -> float:
    """Edge of voxels that suits a map, a whole number of centimetres: 1, and more where Gaussians are much larger than
    a room's, in halls or where depth has a wrong unit. A cloud of those in voxels of 1 cm takes the time and the disk
    of hundreds of rooms."""
    size, mean = 0.0, 2.0 * PointSamplingTuning.max_samples
    while mean > PointSamplingTuning.max_samples:
        size = PointSamplingTuning.voxel_m * max(
            1, math.ceil(size / PointSamplingTuning.voxel_m * math.sqrt(mean / PointSamplingTuning.max_samples))
        )
        samples = gaussians = 0
        for part in parts:
            discs = SurfaceDiscs.of(part.load(), minimum_opacity)
            samples += int(discs.counts(size).sum())
            gaussians += len(discs.used)
        mean = samples / max(1, gaussians)
    return size


def _cube_edge(voxel_size: float) -> int:
    """Of the cubes that finished space is counted in, voxels."""
    return max(1, round(PointSamplingTuning.block_edge_m / voxel_size))


def _cubes(discs: SurfaceDiscs, voxel_size: float) -> np.ndarray | None:
    """The cubes that samples may fall into, packed, sorted; None: a Gaussian is so large that they are too many."""
    # A disc reaches along an axis of the world as far as its two half axes do together, and samples are rounded.
    reach = np.sqrt(((discs.axes * discs.reach[:, None, :]) ** 2).sum(2)) + voxel_size
    edge = voxel_size * _cube_edge(voxel_size)
    low, high = (np.floor((discs.means + side * reach) / edge).astype(np.int64) for side in (-1, 1))
    if ((high - low + 1.0).prod(1)).max(initial=0) > PointSamplingTuning.max_blocks:
        return None
    few = ((high - low) <= 1).all(1)
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    found = [np.unique(pack(np.minimum(low[few] + corner, high[few]))) for corner in corners]
    for a, b in zip(low[~few], high[~few], strict=True):
        axes = [np.arange(start, stop + 1) for start, stop in zip(a, b, strict=True)]
        found.append(pack(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)))
    return np.unique(np.concatenate(found))


def _add_samples(
    merged: VoxelSums, gaussians: GaussianMap, discs: SurfaceDiscs, voxel_size: float, with_object_id: bool,
    chunk: int | None = None,
) -> VoxelSums:  # fmt: skip
    """The sums with those of samples of a map, of which `chunk` are in memory at a time (None: as usual)."""
    chunk = PointSamplingTuning.samples_at_once if chunk is None else chunk
    pending, waiting = [], 0
    for position, weight, color, object_id in disc_samples(gaussians, discs, voxel_size, chunk):
        lattice = np.rint(position / voxel_size)
        if np.abs(lattice).max(initial=0) >= 1 << (BITS - 1):
            raise InputError(f"the map spans more than 2^{BITS} voxels of {voxel_size} m")
        labels = object_id if with_object_id else np.zeros_like(object_id)
        part = VoxelSums.of([VoxelSums(pack(lattice.astype(np.int64)), labels, weight, weight[:, None] * color)])
        pending.append(part)
        waiting += len(part.key)
        if waiting > len(merged.key):  # rarely, so that all merging together costs about as much as one sort
            merged, pending, waiting = VoxelSums.of([merged, *pending]), [], 0
    return VoxelSums.of([merged, *pending])
