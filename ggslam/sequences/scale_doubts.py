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

GRID = 40
"""Columns and rows of the points that floors are looked for in."""
STEEPEST = 50.0
"""Degrees by which the normal of a floor may lean from the upright of the image."""
LEAST_FLOOR = 0.12
"""Share of the points that a floor has to hold."""
FLAT = 0.015
"""Points of a plane lie so near to it, as a share of their depth."""
TRIES = 150
APART_S = 0.12
"""Seconds between two colour images whose motion is measured."""
FEWEST = 20


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
    step = max(1, min(frame.depth.shape) // GRID)
    points = frame.camera.back_project(frame.depth)[::step, ::step].reshape(-1, 3).astype(np.float64)
    points = points[points[:, 2] > 0]
    if len(points) < 10 * FEWEST:
        return None
    rng, best, height = np.random.default_rng(0), LEAST_FLOOR * len(points), None
    for a, b, c in points[rng.integers(0, len(points), (TRIES, 3))]:
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            continue
        normal *= np.sign(normal[1] or 1.0) / length  # down
        below = float(normal @ a)
        if below <= 0 or normal[1] < np.cos(np.radians(STEEPEST)):
            continue
        held = int((np.abs(points @ normal - below) < FLAT * points[:, 2]).sum())
        if held > best:
            best, height = held, below
    return height


def _speeds(sequence: Sequence, frames: list[Frame]) -> list[float]:
    """Metres a second of the camera after each frame, where points can be matched."""
    interval = float(np.median(np.diff(sequence.timestamps))) if len(sequence) > 1 else 0.0
    if not interval > 0:
        return []
    speeds, apart = [], max(1, round(APART_S / interval))
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
    chosen = np.random.default_rng(0).integers(0, len(source), (TRIES, 3))
    T, _ = fit_similarity(source[chosen], target[chosen])
    moved = np.einsum("kij,nj->kni", T[:, :3, :3], source) + T[:, None, :3, 3]
    agree = np.linalg.norm(moved - target, axis=2) < FLAT * target[:, 2]
    best = agree[int(agree.sum(1).argmax())]
    if best.sum() < FEWEST:
        return None
    T, _ = fit_similarity(source[best], target[best])
    return float(np.linalg.norm(T[:3, :3].T @ T[:3, 3]))
