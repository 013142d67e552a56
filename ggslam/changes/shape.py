# SPDX-License-Identifier: Apache-2.0
"""The surface of an object, and the alignment of other surfaces with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.geometry.plane_steps import plane_step
from ggslam.scene.poses import orthonormalize
from ggslam.system.tuning import Tuning


class ShapeTuning(Tuning):
    """How partners on two surfaces are found."""

    color_scale_m = 0.08
    """Metres that a full step in one colour channel counts as in the search for partners."""
    normal_scale_m = 0.06
    """Metres that a radian between normals counts as there."""
    side_scale_m = 0.02
    """Metres that a radian between viewing directions counts as in the search for neighbours."""
    tangent_weight = 0.1
    """Weight of the distance along the surface, which colours constrain, against the distance off it."""
    min_pairs = 12
    """Fewest pairs of points that a step is made from."""
    min_step = 2e-5
    """Largest entry of a step, metres or radians, below which the refinement ends."""


@dataclass(frozen=True)
class Shape(ColoredSurface):
    """The surface of an object, in the world."""

    @staticmethod
    def from_views(points: np.ndarray, colors: np.ndarray, toward: np.ndarray) -> Shape:
        """A surface, with directions [n, 3] to the cameras that saw it: both faces of a thin thing are told apart."""
        return Shape(
            points, colors, turn_toward(estimate_normals(points, beside=ShapeTuning.side_scale_m * toward), toward)
        )

    def sample(self, count: int, rng: np.random.Generator) -> Shape:
        """Some of its points."""
        return self.at(rng.permutation(len(self))[:count])

    def joint(self) -> np.ndarray:
        """Places and colours, [n, 6] metres."""
        return np.concatenate([self.points, ShapeTuning.color_scale_m * self.colors], 1)

    def joint_with_sides(self) -> np.ndarray:
        """Places, colours and normals, [n, 9] metres."""
        return np.concatenate([self.joint(), ShapeTuning.normal_scale_m * self.normals], 1)


class Target:
    """A surface that others are aligned with: point-to-plane, and along the surface by colours.

    Args:
        shape: the surface.
        faces: only what faces the same way may be the same: the other face of something thin is not.
    """

    def __init__(self, shape: Shape, faces: bool = False) -> None:
        self.shape = shape
        self._places = Shape.joint_with_sides if faces else Shape.joint
        self._tree = cKDTree(self._places(shape))

    def refine(
        self, other: Shape, T: np.ndarray, reach: float, free: np.ndarray | None = None, steps: int = 25
    ) -> np.ndarray:
        """Gauss-Newton from a motion [4, 4] that is about right; `free` [6, k]: twists that it may take, about the
        middle; None: all."""
        free = np.eye(6) if free is None else free
        for _ in range(steps):
            placed = other.move(T)
            moved = placed.points
            apart, nearest = self._tree.query(self._places(placed), distance_upper_bound=3 * reach, workers=-1)
            pairs = np.isfinite(apart)
            if pairs.sum() < ShapeTuning.min_pairs:
                return T
            partners = nearest[pairs]
            partner, normal = self.shape.points[partners], self.shape.normals[partners]
            step = plane_step(moved[pairs], partner, normal, reach, ShapeTuning.tangent_weight, free=free)
            T = orthonormalize(step @ T)
            if np.abs(step - np.eye(4)).max() < ShapeTuning.min_step:
                break
        return T
