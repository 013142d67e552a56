# SPDX-License-Identifier: Apache-2.0
"""Maps of the package `pyoctomap`, for programs that hold their map there.

Three ways into an OcTree, fastest first:
- keep an `OccupancyMap` and call `to_octomap` when the tree is needed;
- `insert_rebuilding`: tree to `OccupancyMap`, native insertion, back to a new tree. Its time grows with the map;
- `insert_batched`: changes the tree itself. The voxels of a scan are found natively, each once and neighbours together,
  so OctoMap is spared its hash of every step of every ray; what remains is one descent from the root for each voxel
  and one tuple, as the package takes voxels one by one.
"""

from __future__ import annotations

import ctypes
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.abi.core import InsertResult
from ggslam.errors import FormatError, MissingDependency
from ggslam.native.loader import NativeContext, load_library
from ggslam.volumes.occupancy import OccupancyMap, ScanCounts
from ggslam.volumes.occupancy_arrays import contiguous_points, output_bytes
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.octomap_files import decode_octomap, full_octomap
from ggslam.volumes.quantization import key_centers

_CHUNK = 8192
"""Voxels handed over at once: their tuples stay in the processor's cache."""


def to_octomap(occupancy: OccupancyMap) -> Any:
    """The map as a `pyoctomap.OcTree`, with all log-odds and the settings of the sensor model.

    Raises:
        MissingDependency: `pyoctomap` is not installed.
    """
    pyoctomap = _package()
    tree = pyoctomap.OcTree(occupancy.resolution)
    if occupancy.summary().known_box is not None:
        with tempfile.TemporaryDirectory() as folder:  # the package reads trees from files only
            file = Path(folder) / "map.ot"
            file.write_bytes(full_octomap(occupancy))
            tree = tree.read(str(file))
    if tree is None:
        raise FormatError("pyoctomap could not read the map it was given")
    settings = occupancy.settings
    tree.setProbHit(settings.probability_hit)
    tree.setProbMiss(settings.probability_miss)
    tree.setClampingThresMin(settings.probability_minimum)
    tree.setClampingThresMax(settings.probability_maximum)
    tree.setOccupancyThres(settings.probability_occupied)
    return tree


def from_octomap(tree: Any, context: NativeContext | None = None, quantize: bool = True) -> OccupancyMap:
    """A `pyoctomap.OcTree` as a map of its own, with the tree's log-odds and settings.

    Raises:
        ConfigError: the tree's settings are out of range.
        FormatError: the tree cannot be read.
    """
    settings = OccupancySettings(
        probability_hit=tree.getProbHit(), probability_miss=tree.getProbMiss(),
        probability_minimum=tree.getClampingThresMin(), probability_maximum=tree.getClampingThresMax(),
        probability_occupied=tree.getOccupancyThres(), quantize=quantize, last_voxel=False,
    )  # fmt: skip
    if tree.size() == 0:
        return OccupancyMap(tree.getResolution(), settings, context)
    return decode_octomap(tree.write(), "the pyoctomap tree", settings, context)


def insert_batched(
    tree: Any,
    points: np.ndarray,
    origin: np.ndarray,
    max_range: float | None = None,
    context: NativeContext | None = None,
    quantize: bool = True,
) -> ScanCounts:
    """Inserts one scan into a `pyoctomap.OcTree`, with the result of its insertPointCloud.

    Args:
        tree: changed in place, with its own settings.
        points: [N, 3] in the world, metres.
        origin: [3], where the sensor stands.
        max_range: metres; rays to farther points end there, without a hit.
        context: threads to find the voxels with.
        quantize: one ray per occupied voxel (as `discretize=True`); False: one per point.

    Raises:
        ValueError, ConfigError: as `OccupancyMap.insert`.
    """
    resolution = tree.getResolution()
    finder = OccupancyMap(resolution, OccupancySettings(quantize=quantize, last_voxel=False), context)
    keys, counts = scan_keys(finder, points, origin, max_range)
    for occupied, part in ((False, keys[: counts.free]), (True, keys[counts.free :])):
        for first in range(0, len(part), _CHUNK):
            centers = key_centers(part[first : first + _CHUNK], resolution)
            tree.updateNodes(list(zip(*(column.tolist() for column in centers.T), strict=True)), occupied, False)
    return counts


def insert_rebuilding(
    tree: Any,
    points: np.ndarray,
    origin: np.ndarray,
    max_range: float | None = None,
    context: NativeContext | None = None,
    quantize: bool = True,
) -> Any:
    """Inserts one scan natively and returns a new `pyoctomap.OcTree`; `tree` stays as it is.

    Arguments and errors as `insert_batched`.
    """
    occupancy = from_octomap(tree, context, quantize)
    occupancy.insert(points, origin, max_range)
    return to_octomap(occupancy)


def scan_keys(
    occupancy: OccupancyMap, points: np.ndarray, origin: np.ndarray, max_range: float | None = None
) -> tuple[np.ndarray, ScanCounts]:
    """The voxels that a scan sees on a map's grid, without changing the map.

    Returns:
        keys uint16 [M, 3], the free voxels first, then the occupied ones, and how many there are of each.

    Raises:
        ValueError, ConfigError: as `OccupancyMap.insert`.
    """
    points = contiguous_points(points)
    settings, result = occupancy.native_settings(origin, max_range), InsertResult()
    size = load_library().ggslam_occupancy_scan_keys(
        occupancy.context.handle, occupancy.handle, points.ctypes.data, len(points),
        ctypes.byref(settings), ctypes.byref(result),
    )  # fmt: skip
    if size < 0:
        raise occupancy.origin_error(origin)
    keys = np.frombuffer(output_bytes(occupancy.handle, size), np.uint16).reshape(-1, 3)
    return keys, ScanCounts(int(result.rays), int(result.free), int(result.occupied))


def _package() -> Any:
    try:
        import pyoctomap
    except ImportError:
        raise MissingDependency("OctoMap trees need the package pyoctomap: pip install 'ggslam[octomap]'") from None
    return pyoctomap
