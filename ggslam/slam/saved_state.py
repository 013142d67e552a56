# SPDX-License-Identifier: Apache-2.0
"""The whole state of a `Slam` between two steps, so that another one can go on from there, bit for bit.

What is not named here is saved: an attribute that is added to one of these classes needs no thought unless it holds
something that a constructor has to make (threads, handles, other parts).
"""

from __future__ import annotations

import time
import typing
from collections.abc import Sequence
from typing import Any

import numpy as np

from ggslam.errors import ConfigError, FormatError
from ggslam.features.orb import FeatureView, Landmarks
from ggslam.loops.activity import ActiveKeyframes
from ggslam.loops.condensed import Link
from ggslam.loops.odometry import OdometryTree
from ggslam.loops.parts import KeyframeParts
from ggslam.loops.places import Place, PlaceIndex
from ggslam.loops.pose_graph import PoseGraph
from ggslam.loops.revisits import Revisits
from ggslam.mapping.class_numbers import ClassNumbers
from ggslam.mapping.cpu.class_table import CpuClassTable
from ggslam.mapping.cpu.exposure import ExposureAdam
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.keyframe_exposures import KeyframeExposures
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.cpu.neighbours import NeighbourIndex
from ggslam.mapping.identity import IdentityTimes
from ggslam.mapping.keyframe import ELSEWHERE, Keyframe, PoseAdam
from ggslam.mapping.mapper import LossSums, MapperTimes
from ggslam.mapping.mean_map import MeanMap
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.mapping.sampling import KeyframeSampler
from ggslam.movers.detector import MoverDetector
from ggslam.movers.evidence import CoarseView
from ggslam.movers.found import MoverSight
from ggslam.movers.outdated import EarlierView
from ggslam.movers.patches import Patch
from ggslam.movers.rigid import RigidTracker
from ggslam.movers.surface import MoverSurface
from ggslam.movers.tracks import MoverTracks, Track
from ggslam.movers.trail import Trail
from ggslam.objects.association import Associator
from ggslam.objects.bounding_planes import BoundingPlane, BoundingPlanes
from ggslam.objects.consistency import ConsistencyJudge
from ggslam.objects.evidence import PairEvidence, _Pair
from ggslam.objects.fragments import Fragment, FragmentMemory
from ggslam.objects.table import Observation
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.sequences.moving_pixels import MovingPixels
from ggslam.slam.color_poses import ColorPoses
from ggslam.slam.config import Config
from ggslam.slam.filter_chain import FilterChain
from ggslam.slam.filters.camera_fixtures import CameraFixtures
from ggslam.slam.filters.depth_edges import DepthEdges
from ggslam.slam.filters.earlier_views import EarlierViews
from ggslam.slam.filters.movers import MoverFilter
from ggslam.slam.filters.shutter_times import ShutterTimes
from ggslam.slam.frame_locator import FrameLocator
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.left_parts import LeftPart, LeftParts
from ggslam.slam.loop_closing import LoopCloser, LoopEvent, _Found
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.map_parts import MapParts
from ggslam.slam.map_removal import MapRemoval
from ggslam.slam.object_masks import ObjectMasks
from ggslam.slam.part_start import PartStart
from ggslam.slam.result import LearnedObjects, SlamTimes, TrackedFrame
from ggslam.slam.rig_clock import RigClock
from ggslam.slam.rig_locator import RigLocator
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.run_objects import RunObjects
from ggslam.slam.slam import Slam
from ggslam.slam.step_log import StepLog
from ggslam.system.object_tree import Keeper, Kept, Rule, Rules, describe, restore
from ggslam.system.settings import group_of
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.tracker import FeatureCounts, FeatureTracker
from ggslam.tracking.edges_planes.voxels import FeatureMap
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.keyframes import KeyframeKind, KeyframePolicy
from ggslam.tracking.motion import CameraMotion
from ggslam.tracking.points import FramePoints
from ggslam.tracking.residual_noise import ResidualNoise
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.still_camera import SmallFrame, StillCamera
from ggslam.tracking.surface import MeasuredSurface, _Part
from ggslam.tracking.tracker import TrackerState


def describe_state(slam: Slam, keeper: Keeper | None = None) -> tuple[Any, list[np.ndarray]]:
    """The state of a run between two steps as plain values and arrays (not copied: write them before the next step).

    Args:
        slam: which is not changed.
        keeper: keeps what never changes; None: everything is among the arrays.

    Raises:
        ConfigError: runs of this kind cannot be saved; see `reason_against_saving`.
    """
    reason = reason_against_saving(slam.config)
    if reason is not None:
        raise ConfigError(f"the state of the run cannot be saved: {reason}")
    return describe(slam, RULES, keeper)


def restore_state(slam: Slam, tree: Any, arrays: Sequence[np.ndarray], kept: Kept | None = None) -> None:
    """Brings a fresh `Slam` of the same camera and settings to a state that `describe_state` gave.

    Raises:
        FormatError: it is none, or one of other settings.
    """
    restore(tree, RULES, arrays, kept, into=slam)
    check_state(slam)


def reason_against_saving(config: Config) -> str | None:
    """Why the state of a run with these settings cannot be saved; None: it can."""
    if config.memory_limit_mb:
        return "memory is limited (memory_limit_mb)"
    return None if config.device == "cpu" else f"the map is on a GPU (device: {config.device})"


def check_state(slam: Slam) -> None:
    """Raises FormatError if parts of a state do not fit together, which compiled code would not survive."""
    mapper, surface = slam.mapper, slam.surface
    for number, keyframe in enumerate(mapper.keyframes):
        camera = keyframe.camera  # of another recording, which may have had more
        if keyframe.frame_index != ELSEWHERE:
            if not 0 <= keyframe.camera_number < len(slam.cameras):
                raise FormatError(f"keyframe {number}: not of this recording")
            camera = slam.cameras[keyframe.camera_number]
        shape = (camera.height, camera.width)
        images = (keyframe.color, keyframe.depth)
        empty = all(image.size == 0 for image in images)
        good = empty or (keyframe.color.shape == (*shape, 3) and keyframe.depth.shape == shape)
        typed = keyframe.color.dtype == np.uint8 and keyframe.depth.dtype == np.uint16
        if not (good and typed and keyframe.index == number and keyframe.T_camera_world.shape == (4, 4)):
            raise FormatError(f"keyframe {number}: not of this recording")
    if not all(view.fits() for view in slam.movers.detector.views):
        raise FormatError("views of what may move: not of their camera")
    if not slam.filters.get(EarlierViews).check():
        raise FormatError("views of the map that the run began with: not of their cameras")
    slam.color_poses.check()
    counts = [len(surface), slam.poses.keyframes_made, len(mapper.keyframes)]
    if slam.loops is not None:
        counts += [len(slam.loops.poses), len(slam.loops.places), len(slam.loops.parts.of)]
    if len(set(counts)) > 1:
        raise FormatError(f"numbers of keyframes that do not agree: {counts}")


# --- classes that are saved in a way of their own ---------------------------------------------------------------------


def _save_map(gaussians: GaussianMap) -> dict[str, Any]:
    counters = (
        "sh_degree", "feature_channels", "with_moments", "compact_features", "count", "version", "order", "growth",
    )  # fmt: skip
    rows = {name: array[: gaussians.count] for name, array in gaussians._storage.items()}
    return {**{name: getattr(gaussians, name) for name in counters}, "capacity": gaussians.capacity, "rows": rows}


def _take_map(gaussians: GaussianMap, saved: dict[str, Any]) -> None:
    rows, capacity, count = saved.pop("rows"), saved.pop("capacity"), saved["count"]
    expected = GaussianMap(
        saved["sh_degree"], saved["feature_channels"], with_moments=saved["with_moments"],
        compact_features=saved["compact_features"],
    )  # fmt: skip
    vars(gaussians).update(vars(expected))
    gaussians.append(rows)  # checks them
    if gaussians.count != count or not count <= capacity <= 4 * count + 65536:
        raise ValueError(f"{gaussians.count} Gaussians instead of {count}")
    gaussians.shrink(0)
    gaussians.growth = 0.0
    gaussians.reserve(capacity)
    vars(gaussians).update(saved)


def _save_pool(pool: PixelPool[np.ndarray]) -> dict[str, Any]:
    """What is left of it."""
    return {"pixels": pool.pixels[pool.used :], "vote_weights": pool.vote_weights[pool.used :], "used": 0}


_INDEX_COUNTERS = ("_growth", "_order", "_size", "_stride", "built")


def _save_index(index: NeighbourIndex) -> dict[str, Any]:
    """The tree as its points, which float32 holds."""
    points = None if index._tree is None else np.asarray(index._tree.data).astype(np.float32)
    counters = {name: getattr(index, name) for name in _INDEX_COUNTERS}
    return {**counters, "points": points}


def _take_index(index: NeighbourIndex, saved: dict[str, Any]) -> None:
    for name in _INDEX_COUNTERS:
        setattr(index, name, saved[name])
    index._tree = None if saved["points"] is None else index.tree_of(saved["points"])


def _go_on(times: SlamTimes) -> None:
    """The clock goes on from where it was."""
    times._started = time.perf_counter() - times.wall if times.wall > 0 else None


def _fit_to_scene(slam: Slam) -> None:
    """Settings of the parts, which are not saved, follow the scene again."""
    slam.use_scale(slam.scale)


def _settings_classes(kind: type) -> set[type]:
    """A settings class and those of its groups."""
    found = {kind}
    for declared in typing.get_type_hints(kind).values():
        group = group_of(declared)
        if group is not None:
            found |= _settings_classes(group)
    return found


def _but(*made: str, **more: Any) -> Rule:
    return Rule(frozenset(made), **more)


def _names(*names: str) -> frozenset[str]:
    return frozenset(names)


_LOCATOR_PARTS = (
    "_config", "_surface", "_masks", "_tracker", "_loops", "_pager", "_policy", "_poses", "_filters",
)  # fmt: skip

RULES: Rules = {
    **dict.fromkeys(_settings_classes(Config) - {Config}, Rule(checked=True)),
    Slam: _but("camera", "config", "context", "pager", "start_notes", "schedule", after=_fit_to_scene),
    RigSlam: _but(
        "camera", "rig", "config", "context", "pager", "start_notes", "schedule", after=_fit_to_scene,
        check=RigSlam.check,
    ),
    SlamTimes: _but("_started", growing=_names("tracking_by_frame"), after=_go_on),
    ColorPoses: _but("mapper", "poses", "state", growing=_names("images")),
    EarlierViews: _but("context"),
    FramePoses: Rule(growing=_names("frames"), check=FramePoses.check),
    MapCorrections: _but("_surface", "_mapper", "_pager", "_masks", "publishing"),
    MapParts: _but("_mapper", "_poses", "_corrections", "_loops"),
    RunObjects: _but("_masks"),
    FrameLocator: _but(*_LOCATOR_PARTS),
    RigLocator: _but(*_LOCATOR_PARTS, "_rig", "_engine"),
    MapRemoval: _but("_surface", "_mapper", "_publishing", "is_paged"),
    FilterChain: Rule(),
    MoverFilter: _but("_reads_masks", "_margin", "context"),
    MoverDetector: _but("settings"),
    MoverTracks: _but("recent"),
    MoverSurface: _but("_tree"),
    MovingPixels: Rule(fixed=_names("masks")),
    CoarseView: Rule(fixed=_names("depth", "near", "far", "whole", "smooth")),
    ObjectMasks: _but("settings", "_segment"),
    # tracking
    GicpTracker: _but("_given_engine"),
    FeatureTracker: _but("features", "_extractor"),
    TrackerState: _but("camera", "context", "target"),
    CameraMotion: _but("reference"),
    FeatureView: _but("_features"),
    KeyframePolicy: _but("settings"),
    MeasuredSurface: _but(
        "_context", "_archive", "target", "finish", "_helper", "_begun", after=MeasuredSurface.gather_again,
        check=MeasuredSurface.check,
    ),
    _Part: Rule(fixed=_names("_arrays"), check=_Part.check),
    LocalFeatureMap: _but("settings", "clock", "_aligner"),
    FeatureMap: _but("settings", "_shift", "_mask", "_corners", "_ones", "_isotropic", check=FeatureMap.check),
    # loops
    LoopCloser: _but(
        "settings", "comparison", "_camera", "_surface", "_tracker", "_lock", "_helper", "_begun",
        growing=_names("events"), check=LoopCloser.check,
    ),
    PoseGraph: _but("settings", growing=_names("loops"), check=PoseGraph.check),
    PartStart: _but("target"),
    LeftPart: _but("target"),
    OdometryTree: Rule(growing=_names("parents", "poses", "covariances", "steps"), check=OdometryTree.check),
    PlaceIndex: _but(
        "camera", "settings", "_bits", "_fern_pixels", "_fern_colors", "_fern_depths", "_lists",
        growing=_names("_places"), after=PlaceIndex.list_again, check=PlaceIndex.check,
    ),
    ActiveKeyframes: _but("settings", check=ActiveKeyframes.check),
    Revisits: _but("settings"),
    # mapping
    CpuMapper: _but(
        "settings", "residency", "extra_loss", "_rasterizer", "_loss", "_adam_of_pixel", check=CpuMapper.check
    ),
    GaussianMap: Rule(save=_save_map, take=_take_map),
    Keyframe: Rule(fixed=_names("color", "depth", "mask", "moving"), check=Keyframe.check),
    CpuClassTable: Rule(check=CpuClassTable.check),
    ClassNumbers: Rule(check=ClassNumbers.check),
    KeyframeParts: Rule(check=KeyframeParts.check),
    StepLog: Rule(check=StepLog.check),
    Camera: Rule(checked=True),
    CpuIdentityLearner: _but("settings", "seed"),
    PixelPool: Rule(save=_save_pool),
    NeighbourIndex: Rule(save=_save_index, take=_take_index),
    # plain values
    **dict.fromkeys(
        (CameraFixtures, Trail, Track, MoverSight, Patch, RigidTracker, DepthEdges, DepthNoise,
         ResidualNoise, StillCamera, SmallFrame, KeyframeKind,
         FeatureCounts, TrackedFrame, LoopEvent, _Found, Link, Place, Landmarks, LossSums, MapperTimes,
         KeyframeSampler, MeanMap, PoseAdam, ExposureAdam, KeyframeExposures, IdentityTimes, IdentityClassifier,
         LearnedObjects, Observation, Associator, ConsistencyJudge, PairEvidence, _Pair, Fragment, FragmentMemory,
         BoundingPlanes, BoundingPlane,
         ShutterTimes, RigClock, EarlierView, FramePoints,
         LeftParts, Frame),
        Rule(),
    ),
}  # fmt: skip
"""Classes whose objects a state may hold; no others are ever made of what a file says."""

