# SPDX-License-Identifier: Apache-2.0
"""Tracks a rigid mover by its surface, and decides whether it is rigid."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ggslam.movers.mover_table import Kind
from ggslam.movers.patches import Patch
from ggslam.movers.surface import MoverSurface, PatchFit
from ggslam.scene.poses import inverse, orthonormalize, se3_exp, so3_log
from ggslam.system.array_forms import Form, Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class RigidTuning(Tuning):
    """Motion of a rigid mover."""

    same_fit = 1.2
    """Misfit of the old pose, in multiples of the best one's, up to which a mover counts as standing still."""
    still_rms_m = 0.0015
    """Misfit of the old pose, in metres, below which a mover also counts as standing still..."""
    still_share = 0.95
    """...if this share of it lies on its surface."""
    min_growing = 0.7
    """Smallest share of a patch on the surface for the surface to grow by it."""
    min_rigid = 0.8
    """Smallest median share of a rigid mover."""
    min_fits = 5
    """Fewest fits that tell rigid from not rigid."""
    latest_fits = 7
    """Latest fits that count."""
    min_seen = 0.5
    """Smallest share of a patch on the surface that tells a pose."""
    kept_fits = 8
    """Fits of a standing mover whose scatter is its uncertainty."""
    newest_weight = 0.7
    """Weight of the newest motion in the running mean."""
    min_size = 0.6
    """Smallest visible size of a mover that was hidden, as a share of its size before."""
    turn_rad = 0.35
    """Rotation about each axis, in radians, that is tried for a mover that was hidden."""
    turn_cost_m = 0.004
    """Misfit, in metres per radian, that such a rotation must save: many things look alike from all sides."""


@savable()
@dataclass
class RigidTracker:
    """Follows one mover.

    Attributes:
        T_world_mover: float64 [4, 4] in the latest frame that showed it; its own frame has the world's axes where it
            was first seen, and its origin in the middle of what was seen of it there.
        surface: in its own frame.
        frame: index of that frame; -1: none yet.
        size: square metres facing the camera, about, when it was last seen well.
        shares: of each fit while it moved.
        flexible: whether it was found to change its shape.
        scatter: float64 [4, 4] each, where the latest fits had it since it stands.
        velocity: metres and radians a frame, [6].
        stands: whether it stands where it stood the frame before.
    """

    T_world_mover: Pose = field(default_factory=lambda: np.eye(4))
    surface: MoverSurface = field(default_factory=MoverSurface)
    frame: int = -1
    size: float = 0.0
    shares: list[float] = field(default_factory=list)
    velocity: Annotated[np.ndarray, Form("f8", 6, finite=True)] = field(default_factory=lambda: np.zeros(6))
    stands: bool = False
    flexible: bool = False
    scatter: list[Pose] = field(default_factory=list)

    @property
    def kind(self) -> Kind:
        """Whether it keeps its shape."""
        if self.flexible:
            return "not rigid"
        return "unknown" if len(self.shares) < RigidTuning.min_fits else "rigid"

    def predict(self, frame: int) -> np.ndarray:
        """T_world_mover expected in a frame."""
        gap = 0 if self.stands else frame - self.frame
        T = self.T_world_mover.copy()
        turn = se3_exp(np.concatenate([np.zeros(3), gap * self.velocity[3:]]))
        T[:3, :3], T[:3, 3] = turn[:3, :3] @ T[:3, :3], T[:3, 3] + gap * self.velocity[:3]
        return T

    def follow(self, patch: Patch, area: float, frame: int, margin: float) -> PatchFit | None:
        """Where it is in a frame.

        Args:
            patch: what the frame shows of it, world.
            area: square metres facing the camera, about.
            frame: index.
            margin: metres up to which points lie on its surface.

        Returns:
            How it fits; None: too little is seen of it, and it is where it was as far as is known.
        """
        if self.frame < 0:
            self.T_world_mover[:3, 3] = patch.points.mean(0)
            fit = PatchFit(self.T_world_mover, 1.0, 0.0, 0.0)
            self._accept(fit, patch, area, frame)
            return fit
        if self.flexible:
            return self._follow_middle(patch, frame)
        hidden = frame - self.frame > 2
        if area < (RigidTuning.min_size if hidden else 0.25) * self.size:
            return None
        fit = self._fit(patch, frame, margin, hidden)
        still = self.surface.fit(patch, self.T_world_mover, margin, 0)
        enough = still.share > RigidTuning.still_share and still.rms_m < RigidTuning.still_rms_m
        seen = still.share >= max(RigidTuning.min_seen, fit.share - 0.02)
        as_good = still.rms_m <= RigidTuning.same_fit * fit.rms_m and seen
        self.stands = enough or as_good
        if self.stands:
            self.scatter = [*self.scatter[1 - RigidTuning.kept_fits :], fit.T_patch_surface]
            fit = still
        else:
            self.scatter = []
            self.shares.append(fit.share)
            latest = self.shares[-RigidTuning.latest_fits:]
            if len(latest) >= RigidTuning.min_fits and np.median(latest) < RigidTuning.min_rigid:
                self.flexible = True
                return self._follow_middle(patch, frame)
        self._accept(fit, patch, area, frame)
        return fit

    def _follow_middle(self, patch: Patch, frame: int) -> PatchFit:
        """Of what changes its shape only the middle is followed."""
        T = np.eye(4)
        T[:3, 3] = patch.points.mean(0)
        self.T_world_mover, self.frame, self.stands = T, frame, False
        return PatchFit(T, 0.0, 0.0, 0.0)

    def _fit(self, patch: Patch, frame: int, margin: float, hidden: bool) -> PatchFit:
        expected = self.predict(frame)
        if not hidden:
            return self.surface.fit(patch, expected, margin)
        middle = expected.copy()
        middle[:3, 3] += patch.points.mean(0) - self._middle_of(expected)
        starts = [expected, middle]
        for axis in np.eye(3):
            for angle in (times * RigidTuning.turn_rad for times in (-2, -1, 1, 2)):
                start = middle.copy()
                start[:3, :3] = se3_exp(np.concatenate([np.zeros(3), angle * axis]))[:3, :3] @ start[:3, :3]
                starts.append(start)
        fits = [self.surface.fit(patch, start, margin, 12) for start in starts]
        return min(fits, key=lambda fit: fit.apart_m + RigidTuning.turn_cost_m * _angle(expected, fit.T_patch_surface))

    def _middle_of(self, T: np.ndarray) -> np.ndarray:
        return np.asarray(self.surface.points.mean(0) @ T[:3, :3].T + T[:3, 3])

    def _accept(self, fit: PatchFit, patch: Patch, area: float, frame: int) -> None:
        T, before = fit.T_patch_surface, self.T_world_mover
        if self.frame >= 0 and frame - self.frame == 1:
            turn = so3_log(T[:3, :3] @ before[:3, :3].T)
            newest = np.concatenate([T[:3, 3] - before[:3, 3], turn])
            self.velocity = RigidTuning.newest_weight * newest + (1 - RigidTuning.newest_weight) * self.velocity
        self.T_world_mover, self.frame = orthonormalize(T), frame
        if fit.share >= RigidTuning.min_growing:
            self.surface.add(patch.move(inverse(T)))
            self.size = max(area, 0.9 * self.size)

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world."""
        self.T_world_mover = T_new_old @ self.T_world_mover
        self.scatter = [T_new_old @ T for T in self.scatter]
        turn = T_new_old[:3, :3]
        self.velocity = np.concatenate([turn @ self.velocity[:3], turn @ self.velocity[3:]])


def _angle(A: np.ndarray, B: np.ndarray) -> float:
    return float(np.linalg.norm(so3_log(A[:3, :3] @ B[:3, :3].T)))
