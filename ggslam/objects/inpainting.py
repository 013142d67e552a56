# SPDX-License-Identifier: Apache-2.0
"""Closes the hole that a removed or moved object leaves: surface that was never seen is guessed from its rim.

1. What the object left behind goes: Gaussians that were trained to look like it (`traces`).
2. Planes along the object's outlines (table top below, wall behind) are continued into what the object hid; views that
   looked past it say where there is none (`rim_planes`, `plane_filling`), patches of the rim give the texture.
3. Pixels that are still open are closed in the image, depth and colour (`view_filling`).
4. If the recording is at hand, the new Gaussians, and only they, are trained on the keyframes' pixels beside the object
   (`hole_refinement`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.objects.hole_refinement import Recorded, refine
from ggslam.objects.hole_views import CameraView, HoleView, look, look_again
from ggslam.objects.plane_filling import as_seen, cover, find_hole, make_chart, paint, widen_hole
from ggslam.objects.removal_artifacts import drop_artifacts, places
from ggslam.objects.rim_planes import RimPlane, find_rim_planes, rim_points
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.segmented_rows import copies_of
from ggslam.objects.view_filling import ViewFillingTuning, close, open_pixels
from ggslam.rendering.types import GaussianTensors
from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class InpaintSettings:
    """How a hole is closed.

    Raises:
        ConfigError: a value outside its range.
    """

    views: int = setting(12, 1, 1000)
    """Views of the hole that are used, those that show most of the object."""
    plane_tolerance_m: float = setting(0.015, 1e-4, 1, "m")
    """Distance from a plane within which surface counts as flat."""
    closings: int = setting(8, 0, 1000)
    """Views, at most, in which open pixels are closed."""
    refine_iterations: int = setting(40, 0, 10**5)
    """Training steps of the new Gaussians, if the recording is at hand."""
    touching_m: float = setting(0.05, 0, 1e3, "m")
    """Removed things nearer to each other than this leave one hole."""


@dataclass(frozen=True)
class Filling:
    """What inpainting did: Gaussians added and dropped (traces of the object); planes that were continued; pixels of
    the object in the worst view that still show nothing."""

    added: int = 0
    dropped: int = 0
    planes: int = 0
    open_pixels: int = 0

    def __add__(self, other: Filling) -> Filling:
        return Filling(
            self.added + other.added, self.dropped + other.dropped, self.planes + other.planes,
            max(self.open_pixels, other.open_pixels),
        )  # fmt: skip


def inpaint(
    scene: SegmentedMap,
    removed: GaussianTensors,
    views: Sequence[CameraView],
    ignored: Sequence[int] = (),
    recorded: Callable[[int], Recorded] | None = None,
    settings: InpaintSettings | None = None,
) -> Filling:
    """Closes the holes where `removed` was; the map is changed in place. Objects are not listed anew.

    Args:
        scene: the map without what was removed.
        removed: Gaussians that were there.
        views: from where the map was seen, best its keyframes.
        ignored: ids of objects that are no part of the surroundings: those that were moved away, perhaps not far.
        recorded: gives the images of a frame by its number (`View.frame`); None: no training.
        settings: see there.
    """
    settings, total = settings or InpaintSettings(), Filling()
    for part in places(removed, settings.touching_m):
        total += _Hole(scene, part, views, ignored, settings).close(recorded)
    return total


class _Hole:
    """One hole while it is closed. New Gaussians are the last rows of the map."""

    def __init__(
        self, scene: SegmentedMap, removed: GaussianTensors, views: Sequence[CameraView], ignored: Sequence[int],
        settings: InpaintSettings,
    ) -> None:  # fmt: skip
        self.scene, self.removed, self.views, self.settings = scene, removed, views, settings
        self.ignored = list(ignored)
        self.old = len(scene.gaussians)

    def surroundings(self) -> np.ndarray:
        """bool [N]: all but the ignored objects. Nothing else of theirs is asked or changed."""
        return ~np.isin(self.scene.gaussians.object_id.numpy(), self.ignored)

    def close(self, recorded: Callable[[int], Recorded] | None) -> Filling:
        """All four steps."""
        kept = copies_of(self.scene.gaussians, self.surroundings())
        views = look(kept, self.removed, self.views, self.settings.views)
        if not views:
            return Filling()
        dropped = drop_artifacts(self.scene, self.removed, self.views, self.ignored)
        self.old -= dropped
        views = look_again(copies_of(self.scene.gaussians, self.surroundings()), views)
        planes = self._continue_planes(views)
        self._close_views(views)
        if recorded is not None and self.added_count:
            refine(self.scene.gaussians, self.old, views, recorded, self.settings.refine_iterations)
        left = [open_pixels(copies_of(self.scene.gaussians, self.surroundings()), view).sum() for view in views]
        return Filling(self.added_count, dropped, planes, int(max(left)))

    @property
    def added_count(self) -> int:
        """New Gaussians so far."""
        return len(self.scene.gaussians) - self.old

    def _continue_planes(self, views: Sequence[HoleView]) -> int:
        cameras = np.array([v.view.position for v in views])
        planes = find_rim_planes(*rim_points(views), cameras, self.settings.plane_tolerance_m)
        kept = copies_of(self.scene.gaussians, self.surroundings())
        focal = float(np.median([v.view.camera.fx for v in views]))
        patches = []
        for plane in planes:
            distance = np.linalg.norm(plane.points - cameras.mean(0), axis=1)
            chart = make_chart(plane, kept, float(np.median(distance)) / focal)
            hole = None if chart is None else find_hole(chart, views, [p for p in planes if p is not plane])
            if chart is not None and hole is not None and hole.any():
                hole = widen_hole(hole)
                patches.append((cover(chart, hole, paint(as_seen(chart, views), hole), plane), plane))
        for patch, plane in patches:
            self._insert(patch, plane)
        return len(patches)

    def _close_views(self, views: Sequence[HoleView]) -> None:
        for _ in range(self.settings.closings):
            kept = copies_of(self.scene.gaussians, self.surroundings())
            counts = np.array([open_pixels(kept, view).sum() for view in views])
            order = np.argsort(-counts, kind="stable")[: int((counts >= ViewFillingTuning.min_pixels).sum())]
            patch = next((p for p in (close(kept, views[i], views) for i in order) if p is not None), None)
            if patch is None:
                return
            self._insert(patch, None)

    def _insert(self, patch: GaussianTensors, plane: RimPlane | None) -> None:
        """Adds Gaussians; each gets label, identity vector and votes of the nearest labelled one of its plane."""
        g = self.scene.gaussians
        donors = self.surroundings() & (g.object_id.numpy() > 0)
        if plane is not None:
            on_it = donors & (np.abs(plane.distance(g.means.numpy())) <= plane.tolerance)
            donors = on_it if on_it.any() else donors
        index = np.flatnonzero(donors)
        nearest = index[cKDTree(g.means.numpy()[index]).query(patch.means.numpy())[1]] if len(index) else None
        rows = g.insert(patch.means, patch.quaternions, patch.log_scales, patch.opacity_logits, torch.zeros(1, 3))
        g.sh[rows, 0] = patch.sh[:, 0]
        if nearest is not None:
            g.object_id[rows] = g.object_id[torch.from_numpy(nearest)]
            g.features[rows] = g.features[torch.from_numpy(nearest)]
        if self.scene.votes is not None:
            votes, count = self.scene.votes, len(patch.means)
            empty = np.zeros((count, votes.ids.shape[1]))
            ids = empty.astype(np.uint16) if nearest is None else votes.ids[nearest]
            weights = empty.astype(np.float32) if nearest is None else votes.weights[nearest]
            self.scene.votes = ObjectVotes(np.concatenate([votes.ids, ids]), np.concatenate([votes.weights, weights]))
