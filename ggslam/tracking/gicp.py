# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of a frame's points against the map's own Gaussians."""

from __future__ import annotations

import ctypes
import enum
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.origin import moved_pose
from ggslam.system.tuning import Tuning
from ggslam.tracking.observability import PointSpread, about_point, observability
from ggslam.tracking.photometric import PhotometricPoints, PhotometricReference
from ggslam.tracking.points import FramePoints, PointSource
from ggslam.tracking.settings import AlignSettings, DepthNoise, PhotometricSettings, TargetSettings


class GicpTarget:
    """The map as the tracker sees it: Gaussians gathered in voxels of two sizes. Never changes once built."""

    def __init__(self) -> None:
        self._library = load_library()
        self._handle: int | None = self._library.ggslam_gicp_target_create()
        self.voxel = 0.0
        """Edge of a fine voxel, metres."""
        self.origin = np.zeros(3)
        """Where in the world, float64 [3], the target's coordinates are zero; `align` takes and gives world poses."""
        self.composed_with: TargetSettings | None = None
        """Settings of the parts, if it was made by `target_parts.composed_target`."""
        self._unfinished: tuple[NativeContext, structures.TargetSettings] | None = None

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_gicp_target_destroy(self._handle)

    @property
    def handle(self) -> int:
        """Pointer for the core."""
        if self._unfinished is not None:
            context, settings = self._unfinished
            self._library.ggslam_gicp_target_finish(context.handle, self.gathered_handle, settings)
            self._unfinished = None
        return self.gathered_handle

    @property
    def gathered_handle(self) -> int:
        """Pointer for those functions of the core that do not need the voxels' shapes."""
        assert self._handle is not None
        return self._handle

    @property
    def settings_to_finish(self) -> structures.TargetSettings | None:
        """What the voxels' shapes are still to be made with, if they are."""
        unfinished = self._unfinished
        return None if unfinished is None else unfinished[1]

    @classmethod
    def from_gaussians(
        cls,
        gaussians: GaussianMap,
        settings: TargetSettings,
        context: NativeContext,
        camera_positions: np.ndarray | None = None,
        voxel: float | None = None,
    ) -> GicpTarget:
        """Gathers a map's Gaussians.

        A voxel's mean is that of its Gaussians' means, weighted by opacity over area; its shape joins their own
        regularised covariances with the scatter of the means in the voxel and its neighbours. A Gaussian's normal is
        the direction of its smallest scale.

        Args:
            gaussians: the map; only read.
            settings: voxel sizes and bounds.
            context: threads to work on.
            camera_positions: [K, 3] world positions of the keyframes that `birth_keyframe` counts; they turn normals
                to the side the surface was seen from. Without them the third axis of a disc is taken to point there.
            voxel: edge of a fine voxel in metres instead of the settings'.
        """

        def array(tensor: torch.Tensor) -> np.ndarray:
            return np.ascontiguousarray(tensor.detach().cpu().numpy())

        return cls.from_arrays(
            array(gaussians.means), array(gaussians.quaternions), array(gaussians.log_scales),
            array(gaussians.opacity_logits), settings, context, array(gaussians.birth_keyframe), camera_positions,
            voxel,
        )  # fmt: skip

    @classmethod
    def from_arrays(
        cls,
        means: np.ndarray,
        quaternions: np.ndarray,
        log_scales: np.ndarray,
        opacity_logits: np.ndarray,
        settings: TargetSettings,
        context: NativeContext,
        birth: np.ndarray | None = None,
        camera_positions: np.ndarray | None = None,
        voxel: float | None = None,
        base: GicpTarget | None = None,
        finish: bool = True,
        like: GicpTarget | None = None,
    ) -> GicpTarget:
        """As `from_gaussians`, from contiguous float32 arrays [n, 3], [n, 4] wxyz, [n, 3], [n]; `birth` int32 [n].

        With `base` the result holds what that target holds, too, as if built from both sets of Gaussians at once; it
        must have been made with the same settings. The cost then goes with the new Gaussians and the base's voxels.

        With `finish` false the voxels' shapes, most of the work, are left to who needs them: a GPU makes its own, and
        the core makes them in the thread that first aligns to the target, on the threads of `context`.

        `like` is a target that holds much the same: shapes of voxels where it does are copied. Without `base`.
        """
        target = cls()
        cameras = 0 if camera_positions is None else len(camera_positions)
        positions = np.ascontiguousarray(np.zeros((1, 3)) if camera_positions is None else camera_positions, np.float32)
        target.voxel = settings.voxel if voxel is None else voxel
        if base is not None and base.composed_with is not None:
            raise ValueError("a target composed of parts can only grow by parts")
        arrays = (means, quaternions, log_scales, opacity_logits)
        given = structures.TargetInput(
            *(address(a) for a in arrays), None if birth is None else address(birth),
            address(positions), len(means), cameras,
        )  # fmt: skip
        arguments = native_target_settings(settings, target.voxel)
        earlier = None if base is None else base.gathered_handle
        build = target._library.ggslam_gicp_target_build if finish else target._library.ggslam_gicp_target_gather
        if like is not None and base is None and finish:
            build, earlier = target._library.ggslam_gicp_target_build_like, like.handle
        build(context.handle, target.gathered_handle, earlier, given, arguments)
        target._unfinished = None if finish else (context, arguments)
        return target

    def __len__(self) -> int:
        """Number of fine voxels."""
        return self._library.ggslam_gicp_target_size(self.gathered_handle, 0)

    def voxels(self, level: int = 0) -> dict[str, np.ndarray]:
        """Copies of a level's (0 fine, 1 coarse) means [n, 3], normals [n, 3], covariances [n, 6], weights [n]. Means
        are relative to `origin`."""
        count = self._library.ggslam_gicp_target_size(self.handle, level)
        rows = np.empty((count, 16), np.float32)
        self._library.ggslam_gicp_target_voxels(self.handle, level, address(rows))
        return {"means": rows[:, :3], "weights": rows[:, 3], "normals": rows[:, 4:7], "covariances": rows[:, 8:14]}

    def normals(self, voxels: np.ndarray) -> np.ndarray:
        """Unit normals float32 [n, 3] of fine voxels by index [n]; zero where that is negative."""
        indices = np.ascontiguousarray(voxels, np.int32)
        found = np.empty((len(indices), 3), np.float32)
        self._library.ggslam_gicp_target_normals(self.handle, address(indices), len(indices), address(found))
        return found


def native_target_settings(settings: TargetSettings, voxel: float) -> structures.TargetSettings:
    """The core's form of the settings, with `voxel` metres for the edge of a fine voxel."""
    return structures.TargetSettings(
        voxel, math.log(settings.min_opacity / (1 - settings.min_opacity)), settings.min_thickness,
        settings.max_thickness, settings.max_elongation, settings.scatter_weight, settings.neighbour_weight,
    )  # fmt: skip


class AlignmentStatus(enum.Enum):
    """How reliable an alignment is."""

    OK = "ok"
    DEGENERATE = "degenerate"
    """Some direction of motion is not seen by the geometry; see `weak_directions`."""
    LOST = "lost"
    """Too few matches."""


@dataclass(frozen=True)
class MatchedMedians:
    """Of the points that have a match.

    Attributes:
        count: how many they are.
        squared_distance: median of their squared point-to-plane distances, square metres.
        depth: their median depth, metres.
    """

    count: int
    squared_distance: float
    depth: float


@dataclass(frozen=True)
class PointMatches:
    """What each point of a frame was matched to.

    Attributes:
        voxels: int32 [n], index of the fine voxel, -1 without.
        squared_distances: float32 [n], squared point-to-plane distances, infinite without match.
    """

    voxels: np.ndarray
    squared_distances: np.ndarray

    def read(self) -> PointMatches:
        """See `MatchSource`."""
        return self

    def medians(self, points: PointSource) -> MatchedMedians:
        """See `MatchSource`."""
        matched = np.isfinite(self.squared_distances)
        count = int(matched.sum())
        if not count:
            return MatchedMedians(0, 0.0, 0.0)
        squared = np.median(self.squared_distances[matched])
        return MatchedMedians(count, float(squared), float(np.median(points.read().z[matched])))


class MatchSource(Protocol):
    """Matches, which may still have to be fetched."""

    def read(self) -> PointMatches:
        """The matches on the host."""

    def medians(self, points: PointSource) -> MatchedMedians:
        """What the matches of these points, which were aligned, say of them."""


@dataclass(frozen=True)
class AlignmentResult:
    """The pose of a frame and its certainty.

    Attributes:
        T_world_camera: float64 [4, 4].
        status: OK, DEGENERATE or LOST.
        converged: whether the last step was below both tolerances.
        iterations: linearisations at both levels.
        overlap: share of the frame's points with an inlier match: a point-to-plane distance below
            overlap_constant + overlap_sigmas sigma(z).
        rmse: root mean square of the inliers' point-to-plane distances, metres.
        information: float64 [6, 6], inverse covariance of the twist (v, w), translation first, that turns the true
            pose into this one from the left: T_true = exp([v, w]) T_world_camera, in world axes about the world's
            origin; far from it, where that loses digits, take `camera_information`. From the point-to-plane distances
            alone, each with its depth noise and taken as independent (an optimist's view: neighbouring points share
            errors).
        camera_information: the same about the camera centre: p' = p + v + w x (p - c).
        visibility: float64 [6] ascending, the share of points that see each direction of motion (`observability`).
        weak_directions: float64 [k, 6], the directions seen by less than the limit: unit vectors (v, w radius) in world
            axes about the points' centroid, radius their root mean square distance from it.
        matches: of the frame's points; `read` them.
        cost: mean robust cost of the geometry per unit of weight, square metres (plus the photometric part's).
        photometric_residual: mean absolute grey difference to the reference, [0, 1]; 0 without a reference.
        photometric_share: share of the photometric points seen by the reference.
    """

    T_world_camera: np.ndarray
    status: AlignmentStatus
    converged: bool
    iterations: int
    overlap: float
    rmse: float
    information: np.ndarray
    camera_information: np.ndarray
    visibility: np.ndarray
    weak_directions: np.ndarray
    matches: MatchSource
    cost: float
    photometric_residual: float = 0.0
    photometric_share: float = 0.0

    @property
    def degenerate(self) -> bool:
        """Whether some direction of motion is not seen."""
        return len(self.weak_directions) > 0


class GicpTuning(Tuning):
    """Cost of G-ICP."""

    plane_variance = 0.02
    """Variance along the normal of a match of two planes: twice the default thickness. It scales the cost to metres."""


class PhotometricSource(Protocol):
    """The photometric terms of an alignment, made or still to be made."""

    @property
    def settings(self) -> PhotometricSettings:
        """See there."""

    @property
    def has_texture(self) -> bool:
        """False: an alignment told that they have too few points, and was made without them."""


@dataclass(frozen=True)
class PhotometricPart:
    """The photometric terms of an alignment: points of the frame, the image they are compared with, and settings."""

    points: PhotometricPoints
    reference: PhotometricReference
    settings: PhotometricSettings

    @property
    def has_texture(self) -> bool:
        """See `PhotometricSource`."""
        return True


def native_align_settings(
    settings: AlignSettings, noise: DepthNoise, photometric: PhotometricSettings | None = None
) -> structures.AlignSettings:
    """The core's form of the settings."""
    p = photometric or PhotometricSettings()
    # The core weighs the geometric part per point of unit weight, which has the noise of 1 m. However good the depth,
    # a match is no better than the map's surface.
    photometric_weight = p.weight * (max(noise.sigma(1.0), p.surface_sigma) / p.sigma) ** 2
    return structures.AlignSettings(
        settings.translation_tolerance, settings.rotation_tolerance, settings.coarse_kernel_factor,
        noise.constant, noise.square, settings.kernel_constant, settings.kernel_sigmas, settings.overlap_constant,
        settings.overlap_sigmas, settings.min_normal_dot, GicpTuning.plane_variance, settings.coarse_iterations,
        settings.fine_iterations, settings.coarse_points, settings.min_matches, photometric_weight, p.huber,
        p.depth_tolerance,
    )  # fmt: skip


def native_points(points: FramePoints) -> structures.AlignPoints:
    """The core's form of a frame's points, which must stay alive."""
    arrays = (points.points, points.normals, points.covariances, points.weights)
    depths = None if points.depths is None else address(points.depths)
    return structures.AlignPoints(*(address(a) for a in arrays), depths, len(points))


def align(
    source: FramePoints,
    target: GicpTarget,
    T_world_camera_guess: np.ndarray,
    settings: AlignSettings,
    noise: DepthNoise,
    context: NativeContext,
    photometric: PhotometricPart | None = None,
) -> AlignmentResult:
    """Aligns a frame's points to the map, from the coarse voxels to the fine ones.

    Generalised ICP (Segal et al., RSS 2009) with a Geman-McClure kernel, Levenberg-Marquardt with analytic
    Jacobians. The result does not depend on the number of threads.

    Args:
        T_world_camera_guess: [4, 4]; should be right to about a coarse voxel (12 cm) and 10 degrees.
        photometric: grey values to add at the fine level, with gain and offset between the images estimated along.
    """
    guess = moved_pose(T_world_camera_guess, -target.origin)
    matches, squared = np.empty(len(source), np.int32), np.empty(len(source), np.float32)
    result = structures.AlignResult()
    arguments = native_align_settings(settings, noise, photometric.settings if photometric else None)
    load_library().ggslam_gicp_align(
        context.handle, target.handle, native_points(source), arguments,
        photometric.points.native() if photometric else None,
        photometric.reference.native(target.origin) if photometric else None,
        address(guess), address(matches), address(squared), ctypes.byref(result),
    )  # fmt: skip
    return _result(result, source, settings, noise, matches, squared, target.origin)


def _result(
    found: structures.AlignResult,
    source: FramePoints,
    settings: AlignSettings,
    noise: DepthNoise,
    matches: np.ndarray,
    squared: np.ndarray,
    origin: np.ndarray,
) -> AlignmentResult:
    T = moved_pose(np.array(found.pose).reshape(4, 4), origin)
    information = np.array(found.information).reshape(6, 6)
    spread = PointSpread.of(source, noise)
    status, visibility, weak = judge(information, T[:3, :3], spread, bool(found.usable), settings.degenerate_below)
    return AlignmentResult(
        T, status, bool(found.converged), found.coarse_iterations + found.fine_iterations, found.overlap, found.rmse,
        about_point(information, T[:3, 3]), information, visibility, weak, PointMatches(matches, squared),
        found.cost,
        found.photometric_residual, found.photometric_share,
    )  # fmt: skip


def judge(
    information: np.ndarray, R_world_camera: np.ndarray, spread: PointSpread, usable: bool, limit: float
) -> tuple[AlignmentStatus, np.ndarray, np.ndarray]:
    """What an alignment is worth: its status, visibility and weak directions (see `AlignmentResult`).

    Args:
        information: float64 [6, 6] about the camera centre.
        usable: whether there are enough matches.
        limit: as of `observability`.
    """
    visibility, weak = observability(information, R_world_camera, spread, limit)
    if not usable:
        return AlignmentStatus.LOST, visibility, weak
    return AlignmentStatus.DEGENERATE if len(weak) else AlignmentStatus.OK, visibility, weak
