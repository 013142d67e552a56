# SPDX-License-Identifier: Apache-2.0
"""Where a mover is, frame after frame, by the surface that it showed before; whether it is one rigid thing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ggslam.movers.found import Kind
from ggslam.movers.patches import Patch
from ggslam.movers.surface import MoverSurface, PatchFit
from ggslam.scene.poses import inverse, orthonormalize, se3_exp, so3_log
from ggslam.system.array_forms import Form, Pose
from ggslam.system.savable import savable

AS_GOOD = 1.2
"""A mover stands still as long as the pose that it had explains what is seen that well against the best one."""
STILL_RMS_M = 0.0015
"""...or leaves no more than this off its surface."""
STILL_SHARE = 0.95
"""...if this share lies on its surface."""
GROWS, RIGID = 0.7, 0.8
"""Share of a patch on the surface from which the surface takes it in; median share of rigid things."""
FEWEST_FITS, LATEST_FITS = 5, 7
"""Fits that tell rigid from not rigid; the latest ones count."""
SEEN_SHARE = 0.5
"""Less of a patch than this on the surface says nothing of where it stands."""
KEPT_FITS = 8
"""Fits of a mover that stands, whose scatter tells how well its place is known."""
_SMOOTH = 0.7
"""Weight of the newest motion in the mean of the latest."""
_HIDDEN_SHARE = 0.6
"""A mover is found again only where so much is seen as before it was hidden."""
_TURNS = 0.35
"""Radians about each axis, from what is expected, where one is looked for that was hidden..."""
_TURN_COSTS_M = 0.004
"""...and metres of misfit that a turn of a radian away from it has to be worth: many things look alike from all
sides."""


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
        return "unknown" if len(self.shares) < FEWEST_FITS else "rigid"

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
        if area < (_HIDDEN_SHARE if hidden else 0.25) * self.size:
            return None
        fit = self._fit(patch, frame, margin, hidden)
        still = self.surface.fit(patch, self.T_world_mover, margin, 0)
        enough = still.share > STILL_SHARE and still.rms_m < STILL_RMS_M
        as_good = still.rms_m <= AS_GOOD * fit.rms_m and still.share >= max(SEEN_SHARE, fit.share - 0.02)
        self.stands = enough or as_good
        if self.stands:
            self.scatter = [*self.scatter[1 - KEPT_FITS :], fit.T_patch_surface]
            fit = still
        else:
            self.scatter = []
            self.shares.append(fit.share)
            latest = self.shares[-LATEST_FITS:]
            if len(latest) >= FEWEST_FITS and np.median(latest) < RIGID:
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
            for angle in (-2 * _TURNS, -_TURNS, _TURNS, 2 * _TURNS):
                start = middle.copy()
                start[:3, :3] = se3_exp(np.concatenate([np.zeros(3), angle * axis]))[:3, :3] @ start[:3, :3]
                starts.append(start)
        fits = [self.surface.fit(patch, start, margin, 12) for start in starts]
        return min(fits, key=lambda fit: fit.apart_m + _TURN_COSTS_M * _angle(expected, fit.T_patch_surface))

    def _middle_of(self, T: np.ndarray) -> np.ndarray:
        return np.asarray(self.surface.points.mean(0) @ T[:3, :3].T + T[:3, 3])

    def _accept(self, fit: PatchFit, patch: Patch, area: float, frame: int) -> None:
        T, before = fit.T_patch_surface, self.T_world_mover
        if self.frame >= 0 and frame - self.frame == 1:
            turn = so3_log(T[:3, :3] @ before[:3, :3].T)
            newest = np.concatenate([T[:3, 3] - before[:3, 3], turn])
            self.velocity = _SMOOTH * newest + (1 - _SMOOTH) * self.velocity
        self.T_world_mover, self.frame = orthonormalize(T), frame
        if fit.share >= GROWS:
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
