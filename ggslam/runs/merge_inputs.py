# SPDX-License-Identifier: Apache-2.0
"""Reads what merging needs of a run: places, keyframes, and the map with the keyframes' numbers and votes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.loops.places import PlaceIndex
from ggslam.merging.known_run import KnownRun
from ggslam.native.loader import NativeContext
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.runs.folder import RunFolder
from ggslam.runs.starting import arrays_with_prefix, camera_of, scale_of
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.saved_places import KEYFRAME_CAMERAS, PLACES_FILE
from ggslam.tracking.scale import scale_settings
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.surface import MeasuredSurface


def read_known_run(folder: RunFolder, context: NativeContext) -> KnownRun:
    """What merging knows of a run; without its map.

    Args:
        folder: of the run.
        context: threads.

    Raises:
        RunFolderError: the run has no places, or its files do not belong together.
    """
    path = folder.path / PLACES_FILE
    if not path.is_file():
        edited = "its map was edited since: merge or compare first, then edit"
        reason = edited if folder.mark().edits else "made without loops"
        raise RunFolderError(f"{path}: missing, and without places a run cannot be laid over another ({reason})")
    arrays: dict[str, Any] = read_all_arrays(path, "the places of a run")
    try:
        return _known_run(folder, arrays, context)
    except (KeyError, ValueError, IndexError, TypeError, RuntimeError, ConfigError, FormatError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else f"{error}"
        raise RunFolderError(f"{path}: not the places of this run: {reason}") from None


def _known_run(folder: RunFolder, arrays: dict[str, Any], context: NativeContext) -> KnownRun:
    camera, (constant, square) = camera_of(arrays["camera"]), arrays["noise"].tolist()
    scale, config = scale_of(arrays), folder.config()
    tracking = scale_settings(config.tracking, scale)
    places = arrays_with_prefix(arrays, "loops_places_")
    surface = MeasuredSurface(tracking.target, context)
    measured = arrays_with_prefix(arrays, "surface_")
    surface.load(measured)
    poses = np.asarray(arrays["keyframe_poses"], float)
    lists = (len(surface), len(places["numbers"]), len(folder.keyframes().keyframes))
    if poses.shape[1:] != (4, 4) or not np.isfinite(poses).all() or set(lists) != {len(poses)} or not len(poses):
        raise ValueError(f"expected as many surfaces, places and records as poses, {len(poses)}, found {lists}")
    cameras = [camera] * len(poses)
    if KEYFRAME_CAMERAS in arrays:
        cameras = [camera_of(row) for row in arrays[KEYFRAME_CAMERAS]]
    ends = np.cumsum(measured["counts"])[:-1]
    reach = np.repeat(measured["reach"] / np.float32(32767), measured["counts"])[:, None]
    normals = measured["normals"].astype(np.float32)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    loops = folder.loops()
    events = [] if loops is None else [event for event in loops.events if event.kind in ("closed", "joined")]
    closures = [(min(e.old_keyframe, e.keyframe), max(e.old_keyframe, e.keyframe)) for e in events]
    return KnownRun(
        str(folder.path), cameras, tracking, DepthNoise(constant, square), scale, surface,
        np.split(measured["points"].astype(np.float32) * reach, ends), np.split(normals, ends),
        PlaceIndex.from_arrays(camera, places, config.loops.places), poses,
        [pair for pair in closures if 0 <= pair[0] < pair[1] < len(poses)],
    )  # fmt: skip


def read_map(folder: RunFolder) -> tuple[GaussianMap, SegmentedMap | None]:
    """A run's map, whose Gaussians know the keyframes that inserted them and carry their votes, and the same with its
    objects if it has any.

    Raises:
        RunFolderError, FormatError: files are missing, damaged, or do not belong together.
    """
    segmented = folder.segmented_map() if folder.has_objects() else None
    gaussians = folder.gaussians(with_moments=True)
    birth = read_all_arrays(folder.path / PLACES_FILE, "the places of a run").get("birth")
    keyframes = len(folder.keyframes().keyframes)
    if (
        birth is None
        or birth.shape != (len(gaussians),)
        or not (-1 <= birth.min(initial=-1) <= birth.max(initial=-1) < keyframes)
    ):
        raise RunFolderError(f"{folder.path / PLACES_FILE}: not of this map, which has {len(gaussians)} Gaussians")
    gaussians.birth_keyframe[:] = torch.from_numpy(birth.astype(np.int32))
    if segmented is None:
        return gaussians, None
    if segmented.votes is not None:
        slots = segmented.votes.ids.shape[1]
        gaussians.vote_ids[:, :slots] = torch.from_numpy(segmented.votes.ids.astype(np.int32))
        gaussians.vote_weights[:, :slots] = torch.from_numpy(segmented.votes.weights)
    return gaussians, SegmentedMap(gaussians, segmented.classifier, segmented.table, segmented.votes)
