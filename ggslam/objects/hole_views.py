# SPDX-License-Identifier: Apache-2.0
"""What views tell about the place that a removed object leaves: what it hid, what shows now, where there is nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors
from ggslam.scene.camera import Camera

COVERED = 0.3
"""Share of a pixel's colour from which the object is said to cover it."""
SOLID = 0.8
"""Alpha from which a pixel is said to show a surface; the rest of it would be black."""
_RESIDUE_VIEWS = 64
_SELDOM = 0.15
"""Weight without the object, as a share of what it has now in the object's pixels, up to which it was just hidden."""
_CLEAR = 0.5
"""Share of its weight in pixels without the object up to which a Gaussian is a trace of it."""


@dataclass(frozen=True)
class View:
    """A place from which the map is looked at.

    Attributes:
        camera: its intrinsics.
        T_camera_world: float64 [4, 4].
        color: recorded uint8 [H, W, 3], if the recording is at hand.
        depth: recorded float32 [H, W], metres, 0 = none; likewise.
    """

    camera: Camera
    T_camera_world: np.ndarray
    color: np.ndarray | None = None
    depth: np.ndarray | None = None

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
        z, c = local[:, 2], self.camera
        safe = np.maximum(z, 1e-6)
        column, row = np.rint(c.fx * local[:, 0] / safe + c.cx), np.rint(c.fy * local[:, 1] / safe + c.cy)
        inside = (z > 0.05) & (column >= 0) & (row >= 0) & (column < c.width) & (row < c.height)
        return np.where(inside, row * c.width + column, 0).astype(np.int64), z, inside


@dataclass(frozen=True)
class HoleView:
    """A view of a hole.

    Attributes:
        view: from where.
        covered: bool [H, W], pixels that the removed object covered.
        before: depth [H, W] with the object, metres, 0 where nothing is.
        now: depth [H, W] without it, likewise.
    """

    view: View
    covered: np.ndarray
    before: np.ndarray
    now: np.ndarray


def depth_tolerance(depth: np.ndarray) -> np.ndarray:
    """By how much depths of one surface may differ between a map's renders, metres."""
    return 0.015 + 0.01 * depth


def look(kept: Gaussians, removed: Gaussians, views: Sequence[View], count: int) -> list[HoleView]:
    """The views in which the removed object covered most, at most `count`; those that show little of it are left out."""
    rasterizer, both = CpuRasterizer(), marked(kept, removed)
    seen = [_hole_view(kept, both, view, rasterizer) for view in facing(removed, views)]
    areas = np.array([v.covered.sum() for v in seen], int)
    order = np.argsort(-areas, kind="stable")[:count]
    return [seen[i] for i in order if areas[i] > max(8, 0.05 * areas[order[0]])]


def looked_again(kept: Gaussians, views: Sequence[HoleView]) -> list[HoleView]:
    """The same views with what they show of `kept` now."""
    rasterizer, out = CpuRasterizer(), []
    for v in views:
        image = rasterizer.forward(kept, v.view.camera, v.view.T_camera_world, features=False)
        out.append(replace(v, now=solid_depth(image.alpha, image.expected_depth)))
    return out


def marked(kept: Gaussians, removed: Gaussians) -> GaussianTensors:
    """Both sets together with two features: the first is 1 for the removed, the second is 0."""
    tensors = {name: torch.cat([getattr(kept, name), getattr(removed, name)]) for name in PARAMETERS[:-1]}
    mark = torch.zeros(len(tensors["means"]), 2)
    mark[len(kept.means) :, 0] = 1
    return GaussianTensors(**tensors, features=mark)


def facing(gaussians: Gaussians, views: Sequence[View], most: int = 48) -> list[View]:
    """Views that have a good part of some Gaussians in the image, spread evenly if they are more than `most`."""
    means = gaussians.means.numpy()
    return spread([view for view in views if view.project(means)[2].mean() > 0.3], most)


def _hole_view(kept: Gaussians, both: GaussianTensors, view: View, rasterizer: CpuRasterizer) -> HoleView:
    out = rasterizer.forward(both, view.camera, view.T_camera_world)
    covered = out.features[0].numpy() > COVERED if out.features is not None else np.zeros(out.depth.shape, bool)
    before = solid_depth(out.alpha, out.expected_depth)
    out = rasterizer.forward(kept, view.camera, view.T_camera_world, features=False)
    return HoleView(view, covered, before, solid_depth(out.alpha, out.expected_depth))


def solid_depth(alpha: torch.Tensor, depth: torch.Tensor) -> np.ndarray:
    """Depth [H, W] where a surface is shown, else 0; the caller's own."""
    return np.where(alpha.numpy() > SOLID, depth.numpy(), 0).astype(np.float32)


def residue(kept: Gaussians, removed: Gaussians, views: Sequence[View]) -> np.ndarray:
    """Which of the kept Gaussians are no observation of what is there without the object, bool [N].

    What such a Gaussian adds to the views goes mostly to pixels that the object covers, or nowhere: it was trained to
    look like the object or to mend its colour from behind, or is the object's under a wrong label (masks are wrong by a
    pixel along outlines), or was hidden nearly all the time and only shows now. Those far from the object, by its own
    size, stay.
    """
    own, means = removed.means.numpy(), kept.means.numpy()
    reach = float(np.linalg.norm(np.ptp(own, axis=0)))
    near = np.isfinite(cKDTree(own).query(means, distance_upper_bound=reach)[0])
    both, rasterizer = marked(kept, removed), CpuRasterizer()
    alone = GaussianTensors(**{name: getattr(both, name)[: len(near)] for name in PARAMETERS})
    weights = torch.zeros(len(near), 3)
    for view in spread([view for view in views if view.project(means[near])[2].any()], _RESIDUE_VIEWS):
        image = rasterizer.forward(both, view.camera, view.T_camera_world).features
        assert image is not None
        covered = (image[0] > COVERED).float()
        covered = torch.nn.functional.max_pool2d(covered[None, None], 3, 1, 1)[0, 0]
        weights[:, :2] += _pixel_weights(rasterizer, [1 - covered, covered])[: len(near)]
        if covered.any():
            rasterizer.forward(alone, view.camera, view.T_camera_world)
            weights[:, 2] += _pixel_weights(rasterizer, [covered, covered])[:, 0]
    clear, through, now = weights.numpy().T
    return near & ((clear <= _CLEAR * (clear + through)) | (clear <= _SELDOM * now))


def _pixel_weights(rasterizer: CpuRasterizer, areas: Sequence[torch.Tensor]) -> torch.Tensor:
    """What each Gaussian of the last rendering added to some areas (images of 0 and 1), float32 [N, areas]: the
    derivative of a feature image's sum over an area is the sum of the Gaussian's weights there."""
    gradients = rasterizer.backward(None, grad_features=torch.stack(list(areas)))
    assert gradients.features is not None
    return gradients.features


def spread(views: Sequence[View], most: int) -> list[View]:
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
        pixel, z, inside = v.view.project(points)
        before, now, covered = (image.reshape(-1)[pixel] for image in (v.before, v.now, v.covered))
        tolerance = depth_tolerance(z)
        through += inside & (before > z + tolerance)
        seen += inside & ~covered & (np.abs(before - z) <= tolerance)
        hidden += inside & covered & (before < z + tolerance)
        shows += inside & ((now == 0) | (now > z - tolerance))
    return (hidden > 0.25 * (hidden + seen)) & (shows > 0) & (through <= 0.2 * (through + seen + hidden))
