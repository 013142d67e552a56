# SPDX-License-Identifier: Apache-2.0
"""What a recording without poses says of its depth scale: how far things lie, how high the camera is carried above the
floor, how fast it moves between colour images. Nothing here is exact; together they tell a room from a doll's house."""

from __future__ import annotations

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.scene.poses import fit_similarity
from ggslam.sequences.focal_doubts import match_points
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.verdicts import ScaleSigns
from ggslam.system.tuning import Tuning


class ScaleTuning(Tuning):
    """How floors and the camera's speed are found."""

    grid = 40
    """Columns and rows of the points that a floor is looked for in."""
    max_lean_deg = 50.0
    """Largest angle between a floor's normal and the image's upright, in degrees."""
    min_floor = 0.12
    """Smallest share of the points on a floor."""
    inlier = 0.015
    """Distance of points from their plane or their motion, as a share of their depth."""
    tries = 150
    """Planes and motions that are tried."""
    apart_s = 0.12
    """Time between two images whose motion is measured, in seconds."""
    min_points = 20
    """Fewest points that follow a motion; planes need ten times as many."""


def measure_scale_signs(sequence: Sequence, frames: list[Frame]) -> ScaleSigns | None:
    """Looks at some frames and, of recordings that tell true times, at the motion after them; None without depth."""
    depths = np.concatenate([frame.depth[frame.depth > 0] for frame in frames]) if frames else np.zeros(0)
    if not len(depths):
        return None
    near, median, far = np.percentile(depths, [1, 50, 99])
    floors = [height for frame in frames if (height := floor_height(frame)) is not None]
    speeds = [] if sequence.time_source.startswith("nominal") else _speeds(sequence, frames)
    return ScaleSigns(
        float(near), float(median), float(far), float(np.median(floors)) if len(floors) >= 2 else None,
        float(np.median(speeds)) if len(speeds) >= 3 else None,
    )  # fmt: skip


def floor_height(frame: Frame) -> float | None:
    """Metres from the camera down to the largest plane below it; None if there is none."""
    step = max(1, min(frame.depth.shape) // ScaleTuning.grid)
    points = frame.camera.back_project(frame.depth)[::step, ::step].reshape(-1, 3).astype(np.float64)
    points = points[points[:, 2] > 0]
    if len(points) < 10 * ScaleTuning.min_points:
        return None
    rng, best, height = np.random.default_rng(0), ScaleTuning.min_floor * len(points), None
    for a, b, c in points[rng.integers(0, len(points), (ScaleTuning.tries, 3))]:
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            continue
        normal *= np.sign(normal[1] or 1.0) / length  # down
        below = float(normal @ a)
        if below <= 0 or normal[1] < np.cos(np.radians(ScaleTuning.max_lean_deg)):
            continue
        held = int((np.abs(points @ normal - below) < ScaleTuning.inlier * points[:, 2]).sum())
        if held > best:
            best, height = held, below
    return height


def _speeds(sequence: Sequence, frames: list[Frame]) -> list[float]:
    """Metres a second of the camera after each frame, where points can be matched."""
    interval = float(np.median(np.diff(sequence.timestamps))) if len(sequence) > 1 else 0.0
    if not interval > 0:
        return []
    speeds, apart = [], max(1, round(ScaleTuning.apart_s / interval))
    for frame in frames:
        if frame.index + apart >= len(sequence):
            continue
        try:
            later = sequence.frame(frame.index + apart, masks=False)
        except SequenceError:
            continue
        moved = _distance(frame, later)
        if moved is not None and later.timestamp > frame.timestamp:
            speeds.append(moved / (later.timestamp - frame.timestamp))
    return speeds


def _distance(first: Frame, second: Frame) -> float | None:
    """Metres between the places of the camera, by points that are matched; None if too few agree."""
    matched = match_points(first, second)
    if matched is None:
        return None
    c = first.camera
    source, target = (
        np.column_stack([(seen[:, :2] - (c.cx, c.cy)) / (c.fx, c.fy) * seen[:, 2:], seen[:, 2]]) for seen in matched
    )
    chosen = np.random.default_rng(0).integers(0, len(source), (ScaleTuning.tries, 3))
    T, _ = fit_similarity(source[chosen], target[chosen])
    moved = np.einsum("kij,nj->kni", T[:, :3, :3], source) + T[:, None, :3, 3]
    agree = np.linalg.norm(moved - target, axis=2) < ScaleTuning.inlier * target[:, 2]
    best = agree[int(agree.sum(1).argmax())]
    if best.sum() < ScaleTuning.min_points:
        return None
    T, _ = fit_similarity(source[best], target[best])
    return float(np.linalg.norm(T[:3, :3].T @ T[:3, 3]))
