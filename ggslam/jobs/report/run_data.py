# SPDX-License-Identifier: Apache-2.0
"""What reports know of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ggslam.jobs.changes.saved_changes import ChangesShown
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.movers import MoverRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.records.verdict import RunVerdict


@dataclass(frozen=True)
class LevelAxes:
    """Directions in which a path is shown.

    Attributes:
        axes: float [3, 3], rows right, forward and up, unit vectors in the run's world; the first two are level.
        source: what `up` was taken from, some words.
        floor: height of the floor over the world's origin along up, metres; None: no floor was found.
    """

    axes: np.ndarray = field(default_factory=lambda: np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    source: str = "the first camera"
    floor: float | None = None


@dataclass(frozen=True)
class Path3D:
    """Where the camera was.

    Attributes:
        frames: int [N], indices of the frames that were located.
        seconds: float [N], since the first of them.
        positions: float [N, 3] metres, in the run's world: the first camera (x right, y down, z forward).
        truth: float [N, 3], true positions laid upon these (rigidly, least squares), NaN where unknown; None: there
            is no ground truth.
        error_m: float [N], distance to the truth so laid, metres.
        reason: why there is no truth.
        level: the directions in which it is shown.
        walks: rows of each recording and camera of a merged run; none: all are one walk.
    """

    frames: np.ndarray
    seconds: np.ndarray
    positions: np.ndarray
    truth: np.ndarray | None = None
    error_m: np.ndarray | None = None
    reason: str = ""
    level: LevelAxes = field(default_factory=LevelAxes)
    walks: list[np.ndarray] = field(default_factory=list)

    def in_order(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the path in the order in which they are drawn, with NaN between walks."""
        gap = np.full((1, 3), np.nan)
        return np.concatenate([part for rows in self.walks for part in (points[rows], gap)]) if self.walks else points


@dataclass(frozen=True)
class FrameView:
    """Pictures of one frame, uint8 [H, W, 3], by what they show."""

    frame: int
    pictures: dict[str, np.ndarray]


@dataclass(frozen=True)
class RunData:
    """A run as its folder tells it; what an older run did not write is empty.

    Attributes:
        name: of its folder.
        path: of its folder.
        camera_path: where the camera was.
        tracked: of every frame: `frame`, `status`, `overlap`, `rmse_m` (arrays).
        keyframes: int [K], frames that became keyframes.
        steps: columns of steps.csv.
        scores: columns of frames.csv, scores frame by frame.
        metrics: the scores; None: it was not scored.
        timing: where its time went.
        settings: name -> value, all of them.
        defaults: name -> value that a fresh run would have.
        recording: where its recording is and how it was read.
        verdict: how good it is; None: it was edited, merged or made by an older version.
        mark: what it was made with.
        warnings: what a user should know.
        views: pictures.
        movers: what moved while it was recorded.
        mover_views: pictures of them.
        changes: what changed between the visits that an updated run is of; None: it is no updated run.
    """

    name: str
    path: str
    camera_path: Path3D
    tracked: dict[str, np.ndarray]
    keyframes: np.ndarray
    steps: dict[str, np.ndarray] = field(default_factory=dict)
    scores: dict[str, np.ndarray] = field(default_factory=dict)
    metrics: MetricsRecord | None = None
    timing: TimingRecord | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    defaults: dict[str, Any] = field(default_factory=dict)
    recording: SequenceRecord | None = None
    verdict: RunVerdict | None = None
    mark: RunRecord = field(default_factory=RunRecord)
    warnings: list[str] = field(default_factory=list)
    views: list[FrameView] = field(default_factory=list)
    movers: list[MoverRecord] = field(default_factory=list)
    mover_views: list[FrameView] = field(default_factory=list)
    changes: ChangesShown | None = None

    def recording_name(self) -> str:
        """Where its recording is."""
        return "an unknown recording" if self.recording is None else self.recording.open.path


STAGES = (
    ("tracking", "tracking", "locating each frame"),
    ("insertion", "inserting", "new Gaussians of keyframes, pruning"),
    ("forward", "rendering", "the map from a keyframe's pose"),
    ("loss", "loss", "comparing with the keyframe's images"),
    ("backward", "gradients", "back through the renderer, optimiser"),
    ("identity", "objects", "identity vectors of the Gaussians"),
    ("identity_finish", "objects, last", "final identity steps after the last frame"),
    ("other", "other", "reading frames, loops, waiting"),
)


def stage_seconds(timing: TimingRecord | None) -> list[tuple[str, str, float]]:
    """Where a run's time went: (stage, what it does, seconds), nothing that took no time.

    In a real-time run stages of tracker and mapper go on side by side: they may add up to more than wall time.
    """
    if timing is None:
        return []
    wall = timing.wall_s + timing.refinement_s
    spent = {"tracking": timing.tracking_s}
    spent |= {key: getattr(timing.mapping, key) for key, *_ in STAGES[1:-1]}
    within = sum(seconds for key, seconds in spent.items() if key != "identity_finish")
    spent["other"] = max(0.0, wall - within)
    return [(name, words, spent[key]) for key, name, words in STAGES if spent[key] > 0]
