# SPDX-License-Identifier: Apache-2.0
"""What a visit saw: its map rendered from its keyframes, and points looked up in these pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.settings import ChangeSettings
from ggslam.geometry.voxels import voxel_keys
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, transform_points
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View
from ggslam.system.tuning import Tuning


class SightingTuning(Tuning):
    """How a visit's pictures become a surface."""

    max_depth_step = 0.05
    """Depth step between neighbours, as a share of the depth, above which a pixel belongs to both surfaces."""
    neighbours = 4
    """Measured points that give the surface at a place."""
    stride = 2
    """Every n-th pixel along each axis is used."""
    pictures_at_once = 8
    """Pictures whose points are gathered before they are thinned, to save memory."""


BYTE = np.float32(1 / 255)
AROUND = np.ones((3, 3), np.uint8)
"""A pixel and those around it."""


@dataclass(frozen=True)
class Picture:
    """A map as a keyframe sees it.

    Attributes:
        camera: of the picture.
        T_camera_world: [4, 4].
        depth: float32 [H, W], median depth in metres; 0 = no surface, or one that was never measured.
        color: uint8 [H, W, 3].
        labels: uint16 [H, W], label with the largest rendering weight.
    """

    camera: Camera
    T_camera_world: np.ndarray
    depth: np.ndarray
    color: np.ndarray
    labels: np.ndarray


@dataclass(frozen=True)
class Evidence:
    """What a visit saw of places that another one had something at.

    Attributes:
        through: int [n], keyframes that saw through the place.
        present: int [n], keyframes that saw a surface there.
        hidden: int [n], keyframes that saw something in front of it.
        color: float32 [n, 3], mean colour of the surface that was seen there; NaN: none was.
        offset: float32 [n], mean of how much farther from the cameras that surface was, as a share of the distance;
            NaN: none was.
    """

    through: np.ndarray
    present: np.ndarray
    hidden: np.ndarray
    color: np.ndarray
    offset: np.ndarray

    def at(self, rows: np.ndarray) -> Evidence:
        """Of some of the places."""
        return Evidence(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def is_gone(self, min_views: int) -> np.ndarray:
        """bool [n]: seen through, by far more than saw something there: at grazing angles maps err."""
        return (self.through >= min_views) & (self.through > 2 * self.present)

    def is_there(self, min_views: int) -> np.ndarray:
        """bool [n]: seen, and not seen through."""
        return (self.present >= min_views) & (self.present >= self.through)


@dataclass(frozen=True)
class Surface:
    """Points of the surfaces of a map.

    Attributes:
        points: float64 [n, 3], world.
        colors: float32 [n, 3] in [0, 1].
        toward: float32 [n, 3], mean of the unit vectors to the cameras that saw it.
        labels: uint16 [n].
        counts: int32 [n], measurements that each was made of.
    """

    points: np.ndarray
    colors: np.ndarray
    toward: np.ndarray
    labels: np.ndarray
    counts: np.ndarray

    @staticmethod
    def empty() -> Surface:
        """Of nothing."""
        none = np.zeros((0, 3), np.float32)
        return Surface(np.zeros((0, 3)), none, none, np.zeros(0, np.uint16), np.zeros(0, np.int32))

    @staticmethod
    def join(parts: Sequence[Surface]) -> Surface:
        """All parts."""
        names = Surface.__dataclass_fields__
        return Surface(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def thin(self, spacing: float) -> Surface:
        """Means over the cells of a grid of this spacing, each label by itself."""
        if not len(self.points):
            return self
        keys = voxel_keys(self.points, spacing)
        order = np.lexsort((self.labels, keys))
        keys, labels = keys[order], self.labels[order]
        first = np.flatnonzero(np.append(True, (np.diff(keys) != 0) | (np.diff(labels) != 0)))
        weights = self.counts[order].astype(np.float64)
        counts = np.add.reduceat(weights, first)
        points, colors, toward = (
            np.add.reduceat(values[order] * weights[:, None], first) / counts[:, None]
            for values in (self.points, self.colors, self.toward)
        )
        return Surface(
            points, colors.astype(np.float32), toward.astype(np.float32), labels[first], counts.astype(np.int32)
        )


@dataclass(frozen=True)
class Visit:
    """A visit's map in the common world.

    Attributes:
        gaussians: with `object_id`.
        cameras, T_world_camera: of its keyframes; float64 [K, 4, 4].
        measured, normals: float64 [n, 3], points that its keyframes measured, and the surface's normals there, world.
        has_objects: whether its Gaussians belong to objects.
    """

    gaussians: GaussianMap
    cameras: list[Camera]
    T_world_camera: np.ndarray
    measured: np.ndarray
    normals: np.ndarray
    has_objects: bool


class Sightings:
    """A visit's map, seen from its own keyframes, as far as it was measured: maps go on behind what was seen.

    Args:
        visit: the map.
        settings: see there.
        context: threads.
    """

    def __init__(self, visit: Visit, settings: ChangeSettings, context: NativeContext) -> None:
        self.settings = settings
        rasterizer, measured = CpuRasterizer(context=context), _Measured(visit, settings)
        self.pictures = [
            _draw(rasterizer, visit.gaussians, smaller(camera, settings.width), inverse(T), settings.opaque)
            for camera, T in zip(visit.cameras, visit.T_world_camera, strict=True)
        ]
        for picture in self.pictures:
            measured.mask(picture)
        # What was not measured may be anything: views say nothing beside it.
        self._views = [
            View.of(picture.depth, picture.camera, T, Margin(), context, whole_only=True)
            for picture, T in zip(self.pictures, visit.T_world_camera, strict=True)
        ]

    def look_up(self, points: np.ndarray, margin: Margin) -> Evidence:
        """What the keyframes saw at world points [n, 3]; surfaces that lie within the margin are one."""
        through, present, hidden = (np.zeros(len(points), np.int32) for _ in range(3))
        color, offset = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        for picture, view in zip(self.pictures, self._views, strict=True):
            answers = replace(view, margin=margin).classify_points(points)
            through += answers.through
            hidden += answers.codes == Sight.HIDDEN
            here = np.flatnonzero((answers.codes >= Sight.BEFORE) & (answers.codes <= Sight.BEHIND))
            pixels = answers.pixels[here]
            present[here] += 1
            color[here] += picture.color.reshape(-1, 3)[pixels] * BYTE
            offset[here] += picture.depth.reshape(-1)[pixels] / answers.z[here] - 1
        seen = np.maximum(present, 1)
        color[present == 0], offset[present == 0] = np.nan, np.nan
        return Evidence(through, present, hidden, color / seen[:, None], offset / seen)

    def surface(self, spacing: float) -> Surface:
        """All surfaces that the keyframes see, as points so far apart."""
        gathered, waiting = Surface.empty(), list[Surface]()
        for number, (picture, view) in enumerate(zip(self.pictures, self._views, strict=True)):
            shown = (view.near > 0) & (view.far - view.near < SightingTuning.max_depth_step * view.far)
            points, counts = back_project(picture, shown), np.ones(int(shown.sum()), np.int32)
            toward = inverse(picture.T_camera_world)[:3, 3] - points
            toward /= np.linalg.norm(toward, axis=1, keepdims=True)
            waiting.append(
                Surface(points, picture.color[shown] * BYTE, toward.astype(np.float32), picture.labels[shown], counts)
            )
            if len(waiting) == SightingTuning.pictures_at_once or number + 1 == len(self.pictures):
                gathered, waiting = Surface.join([gathered, *waiting]).thin(spacing), []
        return gathered


def smaller(camera: Camera, width: int) -> Camera:
    """A camera of images no wider than `width`."""
    if camera.width <= width:
        return camera
    return camera.resize(width, max(1, round(camera.height * width / camera.width)))


def _draw(
    rasterizer: CpuRasterizer, gaussians: GaussianMap, camera: Camera, T_camera_world: np.ndarray, opaque: float
) -> Picture:
    view = rasterizer.forward(gaussians, camera, T_camera_world, features=False, median_depth=True)
    assert view.median_depth is not None
    depth = np.where(view.alpha.numpy() >= opaque, view.median_depth.numpy(), np.float32(0))
    terms = rasterizer.pixel_terms(np.arange(depth.size, dtype=np.int32))
    shown = terms.labels(gaussians.object_id.numpy())[0].reshape(depth.shape)
    color = (np.clip(view.image.numpy(), 0, 1).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)
    return Picture(camera, T_camera_world, depth, color, shown)


class _Measured:
    """Tells which surfaces of a map were measured."""

    def __init__(self, visit: Visit, settings: ChangeSettings) -> None:
        self._visit, self._tree = visit, cKDTree(visit.measured)
        self._within = Margin(settings.measured_m, settings.measured_relative)
        self._around = settings.around_m

    def mask(self, picture: Picture) -> None:
        """Blots out of a picture's depth what was not measured, looked at on every second pixel and row."""
        some = np.zeros(picture.depth.shape, bool)
        some[:: SightingTuning.stride, :: SightingTuning.stride] = (
            picture.depth[:: SightingTuning.stride, :: SightingTuning.stride] > 0
        )
        good = np.zeros(picture.depth.shape, np.uint8)
        good[some] = self._off(back_project(picture, some)) <= self._within(picture.depth[some])
        small = good[::SightingTuning.stride, ::SightingTuning.stride]
        whole = cv2.resize(small, picture.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        picture.depth[whole == 0] = 0

    def _off(self, points: np.ndarray) -> np.ndarray:
        """Distance [n] of points from the surface that was measured near by, metres; infinite: none was."""
        measured, normals = self._visit.measured, self._visit.normals
        if not len(measured):
            return np.full(len(points), np.inf)
        apart, near = self._tree.query(points, SightingTuning.neighbours, distance_upper_bound=self._around, workers=-1)
        near = np.minimum(near, len(measured) - 1)
        off = np.abs(((points[:, None] - measured[near]) * normals[near]).sum(2))
        return np.where(np.isfinite(apart), off, np.inf).min(1)


def back_project(picture: Picture, where: np.ndarray) -> np.ndarray:
    """World points [n, 3] of the pixels that are true in [H, W], by rows."""
    camera, (row, column) = picture.camera, np.nonzero(where)
    z = picture.depth[where].astype(np.float64)
    local = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], 1)
    return transform_points(local, inverse(picture.T_camera_world))
