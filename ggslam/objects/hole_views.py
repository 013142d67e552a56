# SPDX-License-Identifier: Apache-2.0
"""What views tell about the place that a removed object leaves: what it hid, what shows now, where there is nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View
from ggslam.system.tuning import Tuning


class HoleViewTuning(Tuning):
    """What a pixel shows beside a hole."""

    covered = 0.3
    """Share of a pixel's colour from which the object covers it."""
    solid = 0.8
    """Alpha from which a pixel shows a surface."""


RENDERED = Margin()
"""How far depths of one surface may differ between a map's renders."""


@dataclass(frozen=True)
class CameraView:
    """A place from which the map is looked at.

    Attributes:
        camera: its intrinsics.
        T_camera_world: float64 [4, 4].
        frame: number of the recorded frame it is the view of, if any.
    """

    camera: Camera
    T_camera_world: np.ndarray
    frame: int | None = None

    @property
    def position(self) -> np.ndarray:
        """Camera centre in the world, [3]."""
        R, t = self.T_camera_world[:3, :3], self.T_camera_world[:3, 3]
        return -R.T @ t

    def points(self, depth: np.ndarray) -> np.ndarray:
        """World points, float32 [H, W, 3], of a depth image [H, W]."""
        R, t = self.T_camera_world[:3, :3], self.T_camera_world[:3, 3]
        return ((self.camera.back_project(depth) - t) @ R).astype(np.float32)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel index [M] (row-major, int64), depth [M] and whether it falls into the image, of world points [M, 3]."""
        local = points @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        rows, columns, inside = self.camera.project(local, nearest=0.05)
        return rows * self.camera.width + columns, local[:, 2], inside


@dataclass(frozen=True)
class HoleView:
    """A view of a hole.

    Attributes:
        view: from where.
        covered: bool [H, W], pixels that the removed object covered.
        before: depth [H, W] with the object, metres, 0 where nothing is.
        now: depth [H, W] without it, likewise.
        picture: colours float32 [H, W, 3] without it, in [0, 1].
    """

    view: CameraView
    covered: np.ndarray
    before: np.ndarray
    now: np.ndarray
    picture: np.ndarray

    @cached_property
    def sight_before(self) -> View:
        """What it looked through with the object..."""
        return self._sight(self.before)

    @cached_property
    def sight_now(self) -> View:
        """...and without it."""
        return self._sight(self.now)

    def _sight(self, depth: np.ndarray) -> View:
        return View.of(depth, self.view.camera, inverse(self.view.T_camera_world), RENDERED)


def look(kept: Gaussians, removed: Gaussians, views: Sequence[CameraView], count: int) -> list[HoleView]:
    """The views in which the removed object covered most, at most `count`, less those that show little of it."""
    rasterizer, both = CpuRasterizer(), mark_removed(kept, removed)
    seen = [_hole_view(kept, both, view, rasterizer) for view in find_facing_views(removed, views)]
    areas = np.array([v.covered.sum() for v in seen], int)
    order = np.argsort(-areas, kind="stable")[:count]
    return [seen[i] for i in order if areas[i] > max(8, 0.05 * areas[order[0]])]


def look_again(kept: Gaussians, views: Sequence[HoleView]) -> list[HoleView]:
    """The same views with what they show of `kept` now."""
    rasterizer, out = CpuRasterizer(), []
    for v in views:
        image = rasterizer.forward(kept, v.view.camera, v.view.T_camera_world, features=False)
        out.append(replace(v, now=solid_depth(image.alpha, image.expected_depth), picture=_picture(image.image)))
    return out


def mark_removed(kept: Gaussians, removed: Gaussians) -> GaussianTensors:
    """Both sets together with two features: the first is 1 for the removed, the second is 0."""
    tensors = {name: torch.cat([getattr(kept, name), getattr(removed, name)]) for name in PARAMETERS[:-1]}
    mark = torch.zeros(len(tensors["means"]), 2)
    mark[len(kept.means) :, 0] = 1
    return GaussianTensors(**tensors, features=mark)


def find_facing_views(gaussians: Gaussians, views: Sequence[CameraView], most: int = 48) -> list[CameraView]:
    """Views that have a good part of some Gaussians in the image, spread evenly if they are more than `most`."""
    means = gaussians.means.numpy()
    return pick_views([view for view in views if view.project(means)[2].mean() > 0.3], most)


def _hole_view(kept: Gaussians, both: GaussianTensors, view: CameraView, rasterizer: CpuRasterizer) -> HoleView:
    out = rasterizer.forward(both, view.camera, view.T_camera_world)
    covered = (
        out.features[0].numpy() > HoleViewTuning.covered
        if out.features is not None
        else np.zeros(out.depth.shape, bool)
    )
    before = solid_depth(out.alpha, out.expected_depth)
    out = rasterizer.forward(kept, view.camera, view.T_camera_world, features=False)
    return HoleView(view, covered, before, solid_depth(out.alpha, out.expected_depth), _picture(out.image))


def _picture(image: torch.Tensor) -> np.ndarray:
    """The caller's own copy [H, W, 3], in [0, 1], of an image [3, H, W]."""
    return image.numpy().transpose(1, 2, 0).clip(0, 1)


def solid_depth(alpha: torch.Tensor, depth: torch.Tensor) -> np.ndarray:
    """Depth [H, W] where a surface is shown, else 0; the caller's own."""
    return np.where(alpha.numpy() > HoleViewTuning.solid, depth.numpy(), 0).astype(np.float32)


def pick_views(views: Sequence[CameraView], most: int) -> list[CameraView]:
    """At most so many of the views, evenly."""
    pick = np.unique(np.linspace(0, max(0, len(views) - 1), min(most, len(views))).round().astype(int))
    return [views[i] for i in pick]


def could_be_hidden(points: np.ndarray, views: Sequence[HoleView]) -> np.ndarray:
    """Whether surface may be at world points [M, 3] that was never seen, bool [M].

    It may not where a view looked through the point at something behind it (space carving), nor where surface was seen
    all the time. And it must be of use: the object hid it in some view, and it would show now in some view.
    """
    through, seen, hidden, shows = np.zeros((4, len(points)), int)
    for v in views:
        before, now = v.sight_before.classify_points(points), v.sight_now.classify_points(points)
        covered = before.at(v.covered)
        through += before.before
        seen += ~covered & before.same
        hidden += before.inside & covered & ~before.before
        shows += now.inside & ~now.behind
    return (hidden > 0.25 * (hidden + seen)) & (shows > 0) & (through <= 0.2 * (through + seen + hidden))


def is_open(points: np.ndarray, views: Sequence[HoleView]) -> np.ndarray:
    """Whether some view sees nothing, or something behind, at world points [M, 3] that the object hid in it; bool
    [M]."""
    out = np.zeros(len(points), bool)
    for v in views:
        now = v.sight_now.classify_points(points)
        out |= now.at(v.covered) & (now.before | (now.codes == Sight.UNKNOWN))
    return out
