# SPDX-License-Identifier: Apache-2.0
"""Figure 4 of the paper on embedded systems, and odometry over whole ways. A part of embedded.py."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper

from bench_frontends import WINDOW, Run, track_frames  # isort: skip
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.native.loader import NativeContext
from ggslam.reporting.plots import Plot, Series
from ggslam.scene.frame import Frame
from ggslam.tracking.edges_planes.settings import ExtractionSettings, FeatureTrackerSettings
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.tracker import Tracker

SEGMENT_ANGLE = 10.0
"""Of scan segments, degrees."""
SEGMENTED = f"with segments of {SEGMENT_ANGLE:g} degrees"


@dataclass
class Odometry:
    """One front-end on one way.

    Attributes:
        name: of the front-end.
        run: what `track_frames` measured.
        sizes: of its local map after every 100 frames, by kind of voxel.
        features: planes and edges of each frame; none of G-ICP.
    """

    name: str
    run: Run = field(default_factory=Run)
    sizes: list[dict[str, int]] = field(default_factory=list)
    features: list[tuple[int, int]] = field(default_factory=list)

    def window_ms(self) -> list[float]:
        """Mean milliseconds a frame, by 100 frames; the first frame, which is not located, is left out."""
        times = self.run.wall_ms
        return [float(np.mean(times[max(1, k) : k + WINDOW])) for k in range(0, len(times), WINDOW)]

    def voxels(self) -> list[int]:
        """Of the local map, by 100 frames."""
        return [sum(sizes.values()) for sizes in self.sizes]


def track(name: str, frames: list[Frame], tracker: Tracker, context: NativeContext) -> Odometry:
    """Tracks all frames and looks at the local map every 100."""
    found = Odometry(name)

    def look(number: int) -> None:
        if number and isinstance(tracker, FeatureTracker):
            found.features.append((tracker.counts.planes, tracker.counts.edges))
        if number and (number % WINDOW == 0 or number == len(frames)):
            found.sizes.append(map_sizes(tracker))

    def watched() -> Iterator[Frame]:
        for number, frame in enumerate(frames):
            look(number)
            yield frame
        look(len(frames))

    found.run = track_frames(watched(), tracker, context)
    return found


def map_sizes(tracker: Tracker) -> dict[str, int]:
    """Voxels of the local map: of edges and of planes, or of G-ICP's target."""
    if isinstance(tracker, FeatureTracker):
        features = tracker.local_map.features
        return {"edges": len(features.surfaces(edges=True)), "planes": len(features.surfaces(edges=False))}
    return {"surface": 0 if tracker.target is None else len(tracker.target)}


def add_odometry(paper: Paper, way: str, frames: list[Frame]) -> list[Plot]:
    """Rows of one way: all front-ends, a row for every 100 frames, then the whole; and their plots."""
    context, camera = NativeContext(), frames[0].camera
    segmented = FeatureTrackerSettings(extraction=ExtractionSettings(segment_angle_deg=SEGMENT_ANGLE))
    runs = [
        track("edges and planes", frames, FeatureTracker(camera, context=context), context),
        track(SEGMENTED, frames, FeatureTracker(camera, features=segmented, context=context), context),
        track("G-ICP", frames, GicpTracker(camera, context=context), context),
    ]
    times = [one.window_ms() for one in runs]
    for number in range(len(times[0])):
        last = min(len(frames), WINDOW * (number + 1)) - 1
        texts = [f"{ms[number]:.1f} ms {one.name}" for one, ms in zip(runs, times, strict=True)]
        sizes = [f"{one.name}: " + ", ".join(f"{count} {kind}" for kind, count in one.sizes[number].items())
                 for one in runs]  # fmt: skip
        row = f"{way}, frames {WINDOW * number} to {last}"
        paper.add("figure 4", row, "", ", ".join(texts), f"voxels of the local maps: {'; '.join(sizes)}")
    for one in runs:
        scores = score_trajectory(one.run.poses, one.run.truth)
        error = "" if scores is None else f"{100 * scores.ate_rmse_m:.2f} cm ATE, "
        ours = f"{error}{np.mean(one.run.wall_ms[1:]):.1f} ms a frame, {np.mean(one.run.cpu_ms[1:]):.1f} of processors"
        remark = f"{len(frames)} frames, {one.run.lost} lost"
        if one.features:
            planes, edges = np.mean(one.features, 0)
            remark += f"; {planes:.0f} planes, {edges:.0f} edges a frame"
        paper.add("odometry", f"{way}, {one.name}", "", ours, remark)
    ends = [min(len(frames), WINDOW * (k + 1)) for k in range(len(times[0]))]
    return [
        Plot(
            f"{key}_{way}", f"{way}: {title}", "frame", label,
            [Series(one.name, ends, y, "marked", color) for color, (one, y) in enumerate(zip(runs, ys, strict=True))],
            from_zero=True,
        )
        for key, title, label, ys in (
            ("ms", "odometry", "ms a frame, mean of 100", times),
            ("maps", "local map", "voxels", [one.voxels() for one in runs]),
        )
    ]  # fmt: skip
