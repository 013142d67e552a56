# SPDX-License-Identifier: Apache-2.0
"""Whether poses and depth belong together: pairs of depth images are laid over each other by the poses, read as they
stand and as they are often written, with depth as it stands and in other units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points
from ggslam.sequences.pose_conventions import CONVENTIONS, OURS, PoseConvention
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class PoseDoubtTuning(Tuning):
    """How true poses are compared with depth."""

    baseline_m = 0.15
    """Distance from which two frames are compared, in metres."""
    turn_deg = 12.0
    """Rotation from which two frames are compared, in degrees."""
    lookahead = 40
    """Most frames between the two."""
    grid = 24
    """Rows and columns of the pixels that are compared."""
    min_pixels = 200
    """Fewest pixels that are seen twice."""
    ratios = np.geomspace(1 / 12, 12, 35)
    """Factors that depth is multiplied by in search of its unit; 1 is in the middle."""


def _with_axes(x: float, y: float) -> Callable[[np.ndarray], np.ndarray]:
    """Poses of a camera whose images have their axes times these."""
    axes = np.diag([x, y, 1.0, 1.0])
    return lambda T: T @ axes


SIDES = {
    "mirrored": PoseConvention("a world seen in a mirror: left and right of the images exchanged", _with_axes(-1, 1)),
    "flipped": PoseConvention("images stored upside down", _with_axes(1, -1)),
    "turned": PoseConvention("images turned by 180 degrees", _with_axes(-1, -1)),
}
"""How colour and depth may be stored together, so that one fits the other and the world is another one than that of
the poses."""
READINGS = {**CONVENTIONS, **SIDES}


@dataclass(frozen=True)
class PoseDoubt:
    """How well neighbouring depth images agree by the poses.

    Attributes:
        error: median relative difference of depth as it stands.
        convention, ratio: reading of the poses (of `READINGS`), and factor on depth, that agree best.
        best: median relative difference with these.
    """

    error: float
    convention: str
    ratio: float
    best: float

    @property
    def wrong_convention(self) -> bool:
        """Whether the poses are clearly of another kind."""
        return self.convention != OURS and self.best < 0.4 * self.error and self.error > 0.004

    @property
    def wrong_scale(self) -> bool:
        """Whether depth clearly has another unit."""
        off = abs(np.log(self.ratio)) > np.log(1.4)
        return self.convention == OURS and bool(off) and self.best < 0.5 * self.error and self.error > 0.006


def pairs_apart(sequence: Sequence, frames: list[Frame]) -> list[tuple[Frame, Frame]]:
    """Pairs of a frame and a later one that the camera has moved a little from by then, both with poses."""
    pairs = []
    for frame in frames:
        later = _later(sequence, frame.index)
        if frame.T_world_camera is None or later is None:
            continue
        try:
            pairs.append((frame, sequence.frame(later, masks=False)))
        except SequenceError:
            continue
    return pairs


def _later(sequence: Sequence, index: int) -> int | None:
    """The first frame that is far enough from `index`, or the last one looked at."""
    poses = sequence.ground_truth
    if poses is None or index + 1 >= len(poses):
        return None
    steps = inverse(poses[index][None]) @ poses[index + 1 : index + 1 + PoseDoubtTuning.lookahead]
    known = np.flatnonzero(np.isfinite(steps).all((1, 2)))
    if not len(known):
        return None
    turn = np.degrees(np.arccos(np.clip((np.trace(steps[known, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    far = (np.linalg.norm(steps[known, :3, 3], axis=1) > PoseDoubtTuning.baseline_m) | (turn > PoseDoubtTuning.turn_deg)
    return index + 1 + int(known[int(far.argmax())] if far.any() else known[-1])


def doubt_poses(pairs: list[tuple[Frame, Frame]]) -> PoseDoubt | None:
    """Looks for the reading of the poses and the unit of depth that agree best; None if too little is seen twice."""
    error = _error(pairs, CONVENTIONS[OURS], 1.0, PoseDoubtTuning.min_pixels)
    if error is None:
        return None
    # A reading that sees less than half as much twice can look good by chance.
    fewest = max(PoseDoubtTuning.min_pixels, _seen_twice(pairs) // 2)
    best = PoseDoubt(error, OURS, 1.0, error)
    for name, convention in READINGS.items():
        for ratio in PoseDoubtTuning.ratios if name == OURS else (1.0,):
            found = _error(pairs, convention, float(ratio), fewest if name == OURS else PoseDoubtTuning.min_pixels)
            if found is not None and found < best.best:
                best = PoseDoubt(error, name, float(ratio), found)
    return best


def _seen_twice(pairs: list[tuple[Frame, Frame]]) -> int:
    return sum(len(_differences(a, b, CONVENTIONS[OURS], 1.0)) for a, b in pairs)


def _error(pairs: list[tuple[Frame, Frame]], convention: PoseConvention, ratio: float, fewest: int) -> float | None:
    errors = [_differences(a, b, convention, ratio) for a, b in pairs]
    known = np.concatenate(errors) if errors else np.zeros(0)
    return float(np.median(known)) if len(known) >= fewest else None


def _differences(frame: Frame, other: Frame, convention: PoseConvention, ratio: float) -> np.ndarray:
    """|seen - predicted| / predicted for pixels of `frame` that fall into `other`."""
    assert frame.T_world_camera is not None and other.T_world_camera is not None
    step = max(1, min(frame.depth.shape) // PoseDoubtTuning.grid)
    points = frame.camera.rays()[::step, ::step] * frame.depth[::step, ::step, None].astype(np.float32)
    points = points.reshape(-1, 3) * np.float32(ratio)
    points = points[points[:, 2] > 0]
    T_world_frame, T_world_other = map(convention.convert, (frame.T_world_camera, other.T_world_camera))
    points = transform_points(points, inverse(T_world_other) @ T_world_frame)
    rows, columns, inside = other.camera.project(points, nearest=0.02 * ratio)
    predicted, seen = points[inside, 2], other.depth[rows[inside], columns[inside]] * np.float32(ratio)
    return np.abs(seen - predicted)[seen > 0] / predicted[seen > 0]
