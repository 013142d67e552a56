# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians of two visits' maps show the latest state, where those lie that were moved, and which measured points
still hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.changes.candidates import Candidate
from ggslam.changes.change import Change, Detection
from ggslam.changes.detection import ChangeDetector
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Evidence
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning

OLD: Final = 0
"""Number of the older visit."""
NEW: Final = 1
"""Number of the newer visit."""


class MapUpdateTuning(Tuning):
    """Which points of the older visit are replaced."""

    on_candidate_m = 0.015
    """Largest distance of a measured point from the surface it belongs to, in metres."""
    new_weight = 1e6
    """Weight of a point measured where something came: the newer visit owns its place, however well the older one
    measured what stood there."""


@dataclass(frozen=True)
class Fate:
    """What becomes of the older visit's Gaussians.

    Attributes:
        gone: bool [N], they show what is not there any more.
        moved: bool [N], they show the side of a moved thing that the newer visit did not see; they stay whoever
            measured their places.
    """

    gone: np.ndarray
    moved: np.ndarray


class MapUpdate:
    """Decides what the two visits' maps contribute to the latest state.

    Args:
        detector: which compared the visits.
        found: what it found.
        settings: its settings.
    """

    def __init__(self, detector: ChangeDetector, found: Detection, settings: ChangeSettings) -> None:
        self._detector, self.found, self._settings = detector, found, settings

    # --- the older visit's map ---------------------------------------------------------------------------------------

    def renew(self, gaussians: GaussianMap) -> Fate:
        """Brings moved things of the older visit's map to where they are, and says which of its Gaussians go.

        Args:
            gaussians: of the older visit; changed. Those of what was moved carry one object id from here on.
        """
        points = gaussians.means.numpy().astype(float)
        gone = self._is_gone(NEW, points)
        moved = np.zeros(len(points), bool)
        for change, own in self._rows_of_changes(gaussians):
            assert change.old is not None
            if change.kind == "look":
                own[own] = self._is_seen(points[own])
            if change.T_new_old is None:
                gone |= own
                continue
            gaussians.move(torch.from_numpy(own), torch.from_numpy(change.T_new_old))
            if change.old.ids:
                gaussians.object_id[torch.from_numpy(own & (gaussians.object_id.numpy() > 0))] = change.old.ids[0]
            unseen = np.zeros(len(points), bool)
            unseen[own] = ~self._is_seen(transform_points(points[own], change.T_new_old))
            moved[own], gone[own] = unseen[own], ~unseen[own]
        return Fate(gone, moved)

    def _rows_of_changes(self, gaussians: GaussianMap) -> list[tuple[Change, np.ndarray]]:
        """What changed of the older visit, and its Gaussians, bool [N]; each belongs to the surest one.

        They are gathered before anything moves: what is brought to another thing's old place is not that thing's.
        """
        taken, found = np.zeros(len(gaussians), bool), list[tuple[Change, np.ndarray]]()
        for change in self.found.changes:
            if change.old is not None:
                own = self.rows_of(OLD, change.old, gaussians) & ~taken
                taken |= own
                found.append((change, own))
        return found

    def rows_of(self, number: int, thing: Candidate, gaussians: GaussianMap) -> np.ndarray:
        """bool [N]: the Gaussians of a thing of the older (0) or newer (1) visit: those of its objects, and of what
        belongs to no object those whose surface is the thing's."""
        ids = gaussians.object_id.numpy()
        own = np.isin(ids, thing.ids)
        judged = self._detector.judged[number]
        if thing.ids and len(np.unique(judged.ids[thing.rows])) == 1:
            return own
        among = np.flatnonzero(~own)
        member = np.zeros(len(judged.points), bool)
        member[thing.rows] = True
        apart, nearest = cKDTree(judged.points).query(
            gaussians.means.numpy()[among].astype(float), distance_upper_bound=self._settings.linking_m
        )
        near = np.isfinite(apart)
        own[among[near]] = member[nearest[near]]
        return own

    # --- evidence ----------------------------------------------------------------------------------------------------

    def _look_up(self, number: int, points: np.ndarray) -> Evidence:
        return self._detector.sights[number].look_up(points, self.found.tolerance)

    def _is_gone(self, number: int, points: np.ndarray) -> np.ndarray:
        """bool [n]: seen through by the visit of this number."""
        return self._look_up(number, points).is_gone(self._settings.min_views)

    def _is_seen(self, points: np.ndarray) -> np.ndarray:
        """bool [n]: the newer visit looked there."""
        evidence = self._look_up(NEW, points)
        return evidence.through + evidence.present >= self._settings.min_views

    def weights(self, number: int, points: np.ndarray) -> np.ndarray:
        """What measured points [n, 3] of the older (0) or newer (1) visit count, float64 [n], where it is asked whose
        place one is: nothing if they show what is gone."""
        if number == OLD:
            return self.holds(points).astype(float)
        return np.where(self._is_gone(OLD, points), MapUpdateTuning.new_weight, self._settings.favour)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """bool [n]: whether points that the older visit measured are not of what is gone."""
        gone = self._is_gone(NEW, points)
        things = [c.old for c in self.found.changes if c.old is not None and c.kind != "look"]
        if things:
            rows = np.concatenate([thing.rows for thing in things])
            tree = cKDTree(self._detector.judged[OLD].points[rows])
            gone |= np.isfinite(tree.query(points, distance_upper_bound=MapUpdateTuning.on_candidate_m)[0])
        return ~gone

    def came(self, gaussians: GaussianMap) -> np.ndarray:
        """bool [N]: Gaussians of the newer visit's map that show something added, moved or of another look."""
        own = np.zeros(len(gaussians), bool)
        for change in self.found.changes:
            if change.new is not None:
                own |= self.rows_of(NEW, change.new, gaussians)
        return own

    def shows_changes(self, cameras: list[Camera], T_world_camera: np.ndarray, least: int) -> np.ndarray:
        """bool [K]: whether a view holds `least` or more points of what changed, hidden or not.

        Args:
            cameras: of the views.
            T_world_camera: float64 [K, 4, 4].
            least: points of surfaces, `ChangeSettings.spacing_m` apart.
        """
        points = np.concatenate([np.zeros((0, 3)), *(p for change in self.found.changes for p in self._points(change))])
        shown = []
        for camera, T in zip(cameras, T_world_camera, strict=True):
            inside = camera.project(transform_points(points, inverse(T)))[2]
            shown.append(int(inside.sum()) >= least)
        return np.array(shown, bool)

    def _points(self, change: Change) -> list[np.ndarray]:
        things = ((OLD, change.old), (NEW, change.new))
        return [self._detector.judged[number].points[t.rows] for number, t in things if t is not None]
