# SPDX-License-Identifier: Apache-2.0
"""The surface of a rigid mover. It grows with what frames show, and new frames are registered to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from ggslam.geometry.plane_steps import plane_step
from ggslam.geometry.voxels import voxel_keys
from ggslam.movers.patches import Patch
from ggslam.scene.poses import inverse, orthonormalize, transform_points
from ggslam.system.array_forms import Form, Points64
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class MoverSurfaceTuning(Tuning):
    """Surface of a mover."""

    voxel_m = 0.006
    """Voxel of the kept points in metres."""
    max_points = 6000
    """Points from which a surface no longer grows."""
    color_m = 0.15
    """Distance, in metres, that the step from black to full in one channel equals in the search for partners."""
    normal_m = 0.05
    """The same for a unit of normals: the inside of a thin wall is no partner of its outside."""
    reach_m = 0.03
    """A third of the largest distance of partners, in metres, and the width of the robust kernel."""
    tangent_weight = 0.3
    """Weight of the distance along the surface..."""
    held_voxels = 1.5
    """...up to this many voxels: points beyond the known edge would pull."""
    max_steering = 1000
    """Most points that a fit uses."""
    rounds = 5
    """Searches for partners."""
    inner_steps = 2
    """Steps after each search."""
    min_step = 1e-4
    """Last step of a fit, in metres and radians."""
    max_seen = 50.0
    """Largest weight of a point, in observations."""


@dataclass(frozen=True)
class PatchFit:
    """A patch, registered to a surface.

    Attributes:
        T_patch_surface: float64 [4, 4].
        share: of the patch that lies on the surface.
        rms_m: distance off the surface, root mean square; what is farther than 2 cm counts so.
        apart_m: mean distance of partners in places, colours and normals.
    """

    T_patch_surface: np.ndarray
    share: float
    rms_m: float
    apart_m: float


@savable(not_saved="_tree")
@dataclass
class MoverSurface:
    """Points in the mover's own frame, a few millimetres apart.

    Attributes:
        points, colors, normals: float64 [n, 3] each, as of a `Patch`.
        seen: float64 [n], how often each was seen.
    """

    points: Points64 = field(default_factory=lambda: np.zeros((0, 3)))
    colors: Points64 = field(default_factory=lambda: np.zeros((0, 3)))
    normals: Points64 = field(default_factory=lambda: np.zeros((0, 3)))
    seen: Annotated[np.ndarray, Form("f8", "n")] = field(default_factory=lambda: np.zeros(0))
    _tree: cKDTree | None = None

    def __len__(self) -> int:
        return len(self.points)

    def add(self, patch: Patch) -> None:
        """Takes in a patch in the mover's frame: means of what falls into one voxel and faces one way."""
        if len(self) > MoverSurfaceTuning.max_points:
            return
        points = np.concatenate([self.points, patch.points])
        normals = np.concatenate([self.normals, patch.normals])
        axis = np.abs(normals).argmax(1)
        side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
        keys = voxel_keys(points, MoverSurfaceTuning.voxel_m)
        _, place = np.unique(8 * (keys % (1 << 60)) + side, return_inverse=True)
        weight = np.concatenate([self.seen, np.ones(len(patch))])
        total = np.bincount(place, weight)
        values = np.concatenate([points, np.concatenate([self.colors, patch.colors]), normals], 1)
        mean = np.stack([np.bincount(place, weight * column) for column in values.T], 1) / total[:, None]
        self.points, self.colors, normals = mean[:, :3], mean[:, 3:6], mean[:, 6:]
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        self.seen, self._tree = np.minimum(total, MoverSurfaceTuning.max_seen), None

    def fit(
        self, patch: Patch, T_patch_surface: np.ndarray, margin: float, rounds: int = MoverSurfaceTuning.rounds
    ) -> PatchFit:
        """Brings the patch upon the surface.

        Args:
            patch: in any frame.
            T_patch_surface: [4, 4] to begin with.
            margin: metres up to which a point lies on the surface.
            rounds: searches for partners; none: it is judged where it is.
        """
        some, T = patch.some(MoverSurfaceTuning.max_steering), inverse(T_patch_surface)
        for _ in range(rounds):
            moved = some.move(T)
            apart, partners = self._partners(moved, 3 * MoverSurfaceTuning.reach_m)
            pairs = np.isfinite(apart)
            if pairs.sum() < 12:
                break
            p, q, n = moved.points[pairs], self.points[partners[pairs]], self.normals[partners[pairs]]
            total = np.eye(4)
            for _ in range(MoverSurfaceTuning.inner_steps):
                off = p - q
                along = off - (off * n).sum(1, keepdims=True) * n
                near = (along**2).sum(1) < (MoverSurfaceTuning.held_voxels * MoverSurfaceTuning.voxel_m) ** 2
                step = plane_step(p, q, n, MoverSurfaceTuning.reach_m, MoverSurfaceTuning.tangent_weight, near)
                total, p = step @ total, transform_points(p, step)
            T = orthonormalize(total @ T)
            if np.abs(total - np.eye(4)).max() < MoverSurfaceTuning.min_step:
                break
        moved = some.move(T)
        apart, partners = self._partners(moved, np.inf)
        plane = np.abs(((moved.points - self.points[partners]) * self.normals[partners]).sum(1))
        rms = float(np.sqrt((np.minimum(plane, 0.02) ** 2).mean()))
        apart_m = float(np.minimum(apart, 3 * MoverSurfaceTuning.reach_m).mean())
        return PatchFit(inverse(T), float((plane < margin).mean()), rms, apart_m)

    def _partners(self, patch: Patch, reach: float) -> tuple[np.ndarray, np.ndarray]:
        if self._tree is None:
            self._tree = cKDTree(_joint(self.points, self.colors, self.normals), balanced_tree=False)
        apart, rows = self._tree.query(_joint(patch.points, patch.colors, patch.normals), distance_upper_bound=reach)
        return apart, rows


def _joint(points: np.ndarray, colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return np.concatenate([points, MoverSurfaceTuning.color_m * colors, MoverSurfaceTuning.normal_m * normals], 1)
