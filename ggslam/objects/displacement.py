# SPDX-License-Identifier: Apache-2.0
"""Which objects of an edited map stand where no recording shows them, and which recorded places stand empty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ggslam.errors import InputError
from ggslam.objects.editing import Change
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class DisplacementTuning(Tuning):
    """When an object is back in its place."""

    max_distance_m = 1e-3
    """Largest distance of its points from where they were recorded, in metres."""


class Displacement:
    """Follows edits. What was moved or made by an edit and then goes leaves no hole: no recording shows it there. What
    came back to its recorded place left none either.

    Args:
        motions: of objects that earlier edits displaced, see `motions`.
    """

    def __init__(self, motions: Mapping[int, np.ndarray | None] | None = None) -> None:
        self.motions: dict[int, np.ndarray | None] = dict(motions or {})
        """By object id: the rigid motion [4, 4] from the recorded place, None if there is no such place (duplicates)
        or no such motion (objects merged from displaced and other parts)."""
        self._left: list[tuple[int | None, GaussianTensors]] = []
        self._cut: set[int] = set()

    def follow(self, change: Change, scene: SegmentedMap) -> None:
        """Takes note of an edit that was done to `scene`."""
        for object_id, gaussians in change.left.items():
            if object_id not in self.motions:
                self._left.append((object_id if change.motion is not None else None, gaussians))
            if change.motion is not None:
                self._move(object_id, change.motion, scene)
        self.motions.update(dict.fromkeys(change.made))
        if change.merged is not None:
            kept, merged = change.merged
            self._gather(kept, (kept, merged))
        if change.assigned is not None:
            kept, sources = change.assigned
            self._gather(kept, sources)
            self._cut |= set(sources) - {0, kept}
        present = scene.table.ids()
        self.motions = {i: motion for i, motion in self.motions.items() if i in present}
        self._left = [(i if i in present else None, gaussians) for i, gaussians in self._left]

    def left(self) -> list[GaussianTensors]:
        """What stood at the recorded places that are empty now, as it was."""
        return [gaussians for _, gaussians in self._left if len(gaussians.means)]

    def cut(self) -> list[int]:
        """Objects of which these edits took a part: what borders on the cut is the object, no trace of the part."""
        return sorted(self._cut)

    def ids(self) -> list[int]:
        """Of the displaced objects, rising."""
        return sorted(self.motions)

    def to_json(self) -> dict[str, list[list[float]] | None]:
        """For a JSON file, as `from_json` reads it."""
        return {str(i): None if T is None else T.tolist() for i, T in sorted(self.motions.items())}

    @staticmethod
    def from_json(values: Any) -> Displacement:
        """What `to_json` gave.

        Raises:
            InputError: it is something else.
        """
        if not isinstance(values, dict):
            raise InputError(f"displaced: expected motions by object id, found {values!r:.60}")
        motions = {int(i): None if T is None else np.array(T, float) for i, T in values.items()}
        wrong = [i for i, T in motions.items() if T is not None and (T.shape != (4, 4) or not np.isfinite(T).all())]
        if wrong:
            raise InputError(f"displaced: expected a 4x4 matrix of object {wrong[0]}")
        return Displacement(motions)

    def _move(self, object_id: int, motion: np.ndarray, scene: SegmentedMap) -> None:
        former = self.motions.get(object_id, np.eye(4))
        if former is None:
            return
        total = motion @ former
        points = scene.gaussians.means.numpy()[scene.gaussians.object_id.numpy() == object_id]
        home = inverse(total)
        apart = np.linalg.norm(points @ home[:3, :3].T + home[:3, 3] - points, axis=1)
        if (apart < DisplacementTuning.max_distance_m).all():
            self.motions.pop(object_id, None)
            self._left = [(i, gaussians) for i, gaussians in self._left if i != object_id]
        else:
            self.motions[object_id] = total

    def _gather(self, kept: int, sources: tuple[int, ...]) -> None:
        """An object (0: none) now has Gaussians of these."""
        parts = [self.motions.get(i, np.eye(4)) for i in sources]
        if kept and any(i in self.motions for i in sources):
            first = parts[0]
            same = first is not None and all(part is not None and np.allclose(first, part) for part in parts)
            # Of mixed parts, closing the hole of the one would damage what the other hides: none is closed.
            self.motions[kept] = first if same else None
        # A part alone does not come back to its place.
        self._left = [(None if i in (kept, *sources) else i, gaussians) for i, gaussians in self._left]
