#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Which path is the better one where nobody knows the truth: a run's, or the poses that came with the recording?

    python scripts/benchmarks/bench_paths.py RUN RECORDING
    python scripts/benchmarks/bench_paths.py /tmp/run ../shared/data/redkitchen --scale 0.5 --gaps 1 10 100

Pixels of one frame are brought into another, GAP frames later, by their measured depth and either path. Printed are the
correlation of grey values there (1 where the images agree; brightness and contrast do not count) and the median
difference of depth. No map and no tracker takes part, so neither path is judged by what made it: frames far apart were
never laid onto each other.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))

import cv2
import numpy as np

from ggslam.formats.trajectory import read_tum
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points
from ggslam.sequences import open_sequence

LEAST_PIXELS, NEAR_M, DEPTH_RANGE_M, STEP = 1500, 0.1, (0.3, 3.5), 2


def grey_of(frame: Frame) -> np.ndarray:
    """Slightly blurred grey values [height, width] of 0 to 255."""
    color = frame.color if frame.color.dtype == np.uint8 else (255 * frame.color).astype(np.uint8)
    return cv2.GaussianBlur(cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)


def agreement(
    one: Frame, other: Frame, greys: tuple[np.ndarray, np.ndarray], T_other_one: np.ndarray
) -> tuple[float, float] | None:
    """(Correlation of grey values, median difference of depth in metres) of one frame's pixels in another, or None."""
    camera, (height, width) = one.camera, one.depth.shape
    v, u = (a.ravel() for a in np.mgrid[0:height:STEP, 0:width:STEP])
    z = one.depth[v, u].astype(float)
    used = (z > DEPTH_RANGE_M[0]) & (z < DEPTH_RANGE_M[1])
    v, u, z = v[used], u[used], z[used]
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    points = transform_points(points, T_other_one)
    ahead = points[:, 2] > DEPTH_RANGE_M[0]
    v, u, points = v[ahead], u[ahead], points[ahead]
    x = (points[:, 0] / points[:, 2] * camera.fx + camera.cx).astype(np.float32)
    y = (points[:, 1] / points[:, 2] * camera.fy + camera.cy).astype(np.float32)
    depth = cv2.remap(other.depth.astype(np.float32), x[None], y[None], cv2.INTER_NEAREST)[0]
    seen = (depth > 0) & (np.abs(depth - points[:, 2]) < NEAR_M)
    if seen.sum() < LEAST_PIXELS:
        return None
    there = cv2.remap(greys[1], x[None], y[None], cv2.INTER_LINEAR)[0][seen]
    return float(np.corrcoef(greys[0][v, u][seen], there)[0, 1]), float(np.median(np.abs(depth - points[:, 2])[seen]))


def key(timestamp: float) -> float:
    """Times as the files tell them."""
    return round(timestamp, 4)


def poses_by_time(path: Path) -> dict[float, np.ndarray]:
    """T_world_camera of each time."""
    trajectory = read_tum(path)
    return {key(t): T for t, T in zip(trajectory.timestamps.tolist(), trajectory.T_world_camera, strict=True)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--scale", type=float, default=0.5, help="of the images")
    parser.add_argument("--gaps", type=int, nargs="+", default=[1, 5, 10, 25, 50, 100, 150], help="frames between")
    parser.add_argument("--every", type=int, default=5, help="frames from one pair to the next")
    given = parser.parse_args()
    paths = [poses_by_time(given.run / name) for name in ("ground_truth.txt", "trajectory.txt")]
    frames = [f for f in open_sequence(given.recording, scale=given.scale) if all(key(f.timestamp) in p for p in paths)]
    greys = [grey_of(f) for f in frames]
    print(
        "| frames apart | pairs | recorded: correlation, depth | tracked | tracked is higher |\n|---|---|---|---|---|"
    )
    for gap in given.gaps:
        rows = []
        for i in range(0, len(frames) - gap, given.every):
            j, both = i + gap, []
            for path in paths:
                T_other_one = inverse(path[key(frames[j].timestamp)]) @ path[key(frames[i].timestamp)]
                both.append(agreement(frames[i], frames[j], (greys[i], greys[j]), T_other_one))
            if None not in both:
                rows.append(both)
        if rows:
            a = np.array(rows)
            mean, wins = a.mean(0), (a[:, 1, 0] > a[:, 0, 0]).mean()
            cells = [f"{m[0]:.3f}, {100 * m[1]:.2f} cm" for m in mean]
            print(f"| {gap} | {len(rows)} | {cells[0]} | {cells[1]} | {100 * wins:.0f} % |", flush=True)


if __name__ == "__main__":
    main()
