# SPDX-License-Identifier: Apache-2.0
"""Aligns the cameras of a rig as one body: all their points, in the frame of the first one, in one alignment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, PhotometricPart, PhotometricSource, align
from ggslam.tracking.points import FramePoints, PointSource, check_depth, extract_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings


class RigEngineTuning(Tuning):
    """How a rig is located."""

    min_share = 0.1
    """Fewest points of a camera that is judged, as a share of the points of the camera that has most."""


@dataclass(frozen=True)
class RigView:
    """What one camera of a rig measured at an instant.

    Attributes:
        camera: its intrinsics.
        depth: float32 [H, W], metres, 0 where unknown.
        T_first_camera: float64 [4, 4], from its frame to the first camera's, as they were at that instant.
    """

    camera: Camera
    depth: np.ndarray
    T_first_camera: np.ndarray


class RigTrackingEngine:
    """A `TrackingEngine` for instants of a rig instead of frames. Before a tracker is given an instant, `views` are set
    to what the cameras measured; the depth image that the tracker hands over is not looked at again.

    Args:
        context: threads to work on.
    """

    def __init__(self, context: NativeContext) -> None:
        self._context = context
        self.views: Sequence[RigView] = ()
        self.parts: list[FramePoints] = []
        """Points of each view, in its own camera's frame."""

    @property
    def greys(self) -> None:
        """See `TrackingEngine`."""
        return None

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> FramePoints:
        """Points of all views in the first camera's frame; see `TrackingEngine`."""
        for view in self.views:
            check_depth(view.depth, view.camera)
        self.parts = [extract_points(v.depth, v.camera, settings, noise, self._context) for v in self.views]
        return join_points(self.parts, [view.T_first_camera for view in self.views])

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricSource | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """See `gicp.align`. The overlap is that of the camera whose points fit best: one that sees what was never
        mapped must not make a good pose look doubtful."""
        assert photometric is None or isinstance(photometric, PhotometricPart)
        found = align(source.read(), target, T_world_camera_guess, settings, noise, self._context, photometric)
        told = [overlap for overlap in self.overlaps(found, settings, noise) if overlap is not None]
        return dataclasses.replace(found, overlap=max(told, default=found.overlap))

    def expect_target(self, target: GicpTarget) -> None:
        """Nothing: it is where it is used."""

    def overlaps(self, found: AlignmentResult, settings: AlignSettings, noise: DepthNoise) -> list[float | None]:
        """Share of each view's points with an inlier match; None of a view with too few points to tell.

        Args:
            found: an alignment of the points that `points` gave last.
            settings, noise: it was made with.
        """
        most = max(map(len, self.parts), default=0)
        needed = max(settings.min_matches, RigEngineTuning.min_share * most)
        squared, shares, begin = found.matches.read().squared_distances, list[float | None](), 0
        for part in self.parts:
            limit = settings.overlap_constant + settings.overlap_sigmas * (noise.constant + noise.square * part.z**2)
            inside = squared[begin : begin + len(part)] < limit**2
            shares.append(float(inside.mean()) if len(part) >= needed else None)
            begin += len(part)
        return shares


def join_points(parts: Sequence[FramePoints], T_first_camera: Sequence[np.ndarray]) -> FramePoints:
    """Points of several cameras as those of one.

    Args:
        parts: in the frame of each camera.
        T_first_camera: [4, 4] of each, to the frame of the result.
    """
    moved = [_in_frame(part, T) for part, T in zip(parts, T_first_camera, strict=True)]
    if len(moved) == 1:
        return moved[0]
    return FramePoints(
        np.concatenate([part.points for part in moved]), np.concatenate([part.normals for part in moved]),
        np.concatenate([part.covariances for part in moved]), np.concatenate([part.pixels for part in moved]),
        np.concatenate([part.weights for part in moved]), np.concatenate([part.z for part in moved]),
    )  # fmt: skip


def _in_frame(part: FramePoints, T: np.ndarray) -> FramePoints:
    """The points in another frame; themselves where that is their own."""
    if (np.eye(4) == T).all():
        return part
    R = T[:3, :3]
    xx, xy, xz, yy, yz, zz = part.covariances.T
    full = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)
    turned = R @ full @ R.T
    return FramePoints(
        transform_points(part.points, T).astype(np.float32), (part.normals @ R.T).astype(np.float32),
        np.ascontiguousarray(turned[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], np.float32), part.pixels, part.weights,
        np.ascontiguousarray(part.z),
    )  # fmt: skip
