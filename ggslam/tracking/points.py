# SPDX-License-Identifier: Apache-2.0
"""Points of a frame: a grid over its depth image, each with normal and covariance from its neighbours."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.system.array_forms import Form, Points32
from ggslam.system.medians import median
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import UNBOUNDED, DepthNoise, PointSettings


class PointTuning(Tuning):
    """Shape of a frame's points."""

    thickness = 0.01
    """Thickness of a point's disc along its normal, relative to its width."""


class PointSource(Protocol):
    """Points of a frame, which may still have to be computed or fetched."""

    def __len__(self) -> int:
        """Number of points."""

    @property
    def median_depth(self) -> float:
        """Median depth in metres; 0 without points."""

    def median_depth_if_known(self) -> float | None:
        """Median depth in metres; None if that would have to be waited for."""

    def read(self) -> FramePoints:
        """The points on the host."""

    def send(self) -> None:
        """They will be read soon: what has to be fetched is on its way from now on."""

    def expect_look(self) -> None:
        """The `MatchedMedians` of their alignment will be asked for."""


@savable()
@dataclass(frozen=True)
class FramePoints:
    """Points of one depth image, in its camera's frame.

    Attributes:
        points: float32 [n, 3], metres.
        normals: float32 [n, 3], unit, towards the camera.
        covariances: float32 [n, 6], xx xy xz yy yz zz, regularised: median eigenvalue 1 (equation 1 of GS-ICP).
        pixels: int32 [n, 2], column and row.
        weights: float32 [n], (sigma(1 m) / sigma(z))^2, bounded: see `largest_weight`.
        depths: float32 [n], metres along the axis of the camera that saw each; None: z of the points, all of which one
            camera saw.
    """

    points: Points32
    normals: Points32
    covariances: Annotated[np.ndarray, Form("f4", "n", 6, finite=True)]
    pixels: Annotated[np.ndarray, Form("i4", "n", 2)]
    weights: Annotated[np.ndarray, Form("f4", "n", finite=True)]
    depths: Annotated[np.ndarray, Form("f4", "n", finite=True)] | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def median_depth(self) -> float:
        """Median depth in metres; 0 without points."""
        return median(self.z) if len(self.points) else 0.0

    @property
    def z(self) -> np.ndarray:
        """Depth of each along the axis of the camera that saw it, float32 [n], metres; noise follows from it."""
        return self.points[:, 2] if self.depths is None else self.depths

    def median_depth_if_known(self) -> float | None:
        """See `PointSource`."""
        return self.median_depth

    def read(self) -> FramePoints:
        """See `PointSource`."""
        return self

    def send(self) -> None:
        """Nothing: they are here."""

    def expect_look(self) -> None:
        """Nothing: they are here."""


class DeferredPoints:
    """Points of a frame that are extracted when they are read: keyframes need them, not every tracker does.

    Args:
        extract: gives them.
        median_depth: estimate of their median depth, metres, that needs no extraction.
        source: what they are extracted from; None: that is here.
    """

    def __init__(
        self, extract: Callable[[], FramePoints], median_depth: float, source: PointSource | None = None
    ) -> None:
        self._extract, self._source = extract, source
        self._points: FramePoints | None = None
        self.median_depth = median_depth
        """Metres, an estimate."""

    def __len__(self) -> int:
        return len(self.read())

    def median_depth_if_known(self) -> float | None:
        """See `PointSource`."""
        return self.median_depth

    def read(self) -> FramePoints:
        """The points, extracted by the first call."""
        if self._points is None:
            self._points = self._extract()
        return self._points

    def send(self) -> None:
        """See `PointSource`."""
        if self._source is not None:
            self._source.send()

    def expect_look(self) -> None:
        """Nothing: no alignment tells of them."""


def grid_stride(pixels: int, count: int) -> int:
    """Pixel stride at which a regular grid over `pixels` pixels with depth has about `count` points."""
    return max(1, round(math.sqrt(pixels / count)))


def check_depth(depth: np.ndarray, camera: Camera) -> None:
    """Looks whether a depth image fits its camera.

    Raises:
        ValueError: it has another shape.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth is {depth.shape}, expected {(camera.height, camera.width)} of the camera")


def largest_weight(depth: np.ndarray, settings: PointSettings, noise: DepthNoise, stride: int) -> float:
    """What a point may weigh at most, `PointSettings.near_weight` times one at the median depth.

    By noise alone a point at 1 m weighs as much as eighty at 3 m with a depth camera whose noise goes with the square:
    what comes near and moves would take the camera along.

    Args:
        depth: float32 [H, W], metres.
        stride: pixels between the points.
    """
    if settings.near_weight >= UNBOUNDED:  # the usual: no weight comes near
        return settings.near_weight
    z = depth[::stride, ::stride]
    z = z[(z >= settings.min_depth) & (z <= settings.max_depth)]
    usual = noise.sigma(1.0) / noise.sigma(median(z)) if len(z) else 1.0
    return settings.near_weight * usual**2


def native_points_settings(
    camera: Camera, settings: PointSettings, noise: DepthNoise, stride: int, depth: np.ndarray
) -> structures.DepthPointsSettings:
    """The core's form of the settings, for points of `depth` [H, W], `stride` pixels apart."""
    return structures.DepthPointsSettings(
        camera.fx, camera.fy, camera.cx, camera.cy, noise.constant, noise.square, settings.min_depth,
        settings.max_depth, settings.min_thickness, settings.max_elongation, settings.min_neighbours,
        largest_weight(depth, settings, noise, stride), camera.width, camera.height, stride, settings.window,
        max(1, round(camera.width / 320)),
    )  # fmt: skip


def extract_points(
    depth: np.ndarray, camera: Camera, settings: PointSettings, noise: DepthNoise, context: NativeContext
) -> FramePoints:
    """Points, normals and regularised covariances of a depth image.

    A neighbour counts if its depth differs by no more than a steep surface and three times the depth noise allow. The
    depth noise is taken off the measured thickness before the shape is regularised.

    Args:
        depth: float32 [H, W], metres, 0 where unknown.
        camera: its intrinsics.

    Raises:
        ValueError: `depth` has another shape than `camera`.
    """
    check_depth(depth, camera)
    depth = np.ascontiguousarray(depth, np.float32)
    stride = grid_stride(int(np.count_nonzero(depth > 0)), settings.count)
    room = math.ceil(camera.width / stride) * math.ceil(camera.height / stride)
    found = FramePoints(
        np.empty((room, 3), np.float32), np.empty((room, 3), np.float32), np.empty((room, 6), np.float32),
        np.empty((room, 2), np.int32), np.empty(room, np.float32),
    )  # fmt: skip
    arguments = native_points_settings(camera, settings, noise, stride, depth)
    arrays = (found.points, found.normals, found.covariances, found.pixels, found.weights)
    out = structures.DepthPointsOutput(*(address(array) for array in arrays))
    count = load_library().ggslam_depth_points(context.handle, address(depth), arguments, out)
    return FramePoints(*(array[:count] for array in arrays))


def disc_points(points: np.ndarray, normals: np.ndarray, noise: DepthNoise) -> FramePoints:
    """Points of a frame of which only float32 points and normals [n, 3] were kept; their shapes are discs."""
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    covariances = np.stack(
        [(i == j) - (1 - PointTuning.thickness) * normals[:, i] * normals[:, j] for i, j in pairs], 1
    )
    sigma = noise.constant + noise.square * points[:, 2].astype(float) ** 2
    weights = (noise.sigma(1.0) / sigma) ** 2
    pixels = np.zeros((len(points), 2), np.int32)
    return FramePoints(points, normals, covariances.astype(np.float32), pixels, weights.astype(np.float32))
