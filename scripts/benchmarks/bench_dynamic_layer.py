# SPDX-License-Identifier: Apache-2.0
"""Velocities of `ggslam.driving.dynamic_layer` against the truth, at the recording's own poses:

python scripts/benchmarks/bench_dynamic_layer.py DATA/livingroom_movers

Of each mover: frames in which it is in the layer and seen, error of the velocity of its middle (median, 90 %), its true
speed (median), all in cm/s; and the CPU time of the layer, without the search for movers.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from ggslam.driving.dynamic_layer import DynamicLayer, MovingObstacle  # noqa: E402
from ggslam.movers.detector import MoverDetector  # noqa: E402
from ggslam.movers.recent import RecentFrame  # noqa: E402
from ggslam.movers.settings import MoverSettings  # noqa: E402
from ggslam.movers.tracks import MoverTracks  # noqa: E402
from ggslam.native.loader import NativeContext  # noqa: E402
from ggslam.scene.poses import inverse, transform_points  # noqa: E402
from ggslam.sequences import open_sequence  # noqa: E402
from ggslam.sight.margin import Margin  # noqa: E402
from ggslam.tracking.settings import DepthNoise  # noqa: E402


def true_velocity(truth: dict[str, Any], obstacle: MovingObstacle, frame: int, rate: float) -> np.ndarray | None:
    """Of the obstacle's middle, m/s, from the frame before; None: it is not among the true movers."""
    poses = [
        np.array(mover["T_world"])
        for number in (frame, frame - 1)
        for mover in truth["frames"][number]["movers"]
        if mover["instance_id"] == obstacle.number
    ]
    if len(poses) != 2:
        return None
    middle = obstacle.middle
    return rate * (middle - transform_points(middle[None], poses[1] @ inverse(poses[0]))[0])


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--scale", type=float, default=0.5)
    given = parser.parse_args()
    sequence, truth = (
        open_sequence(given.recording, scale=given.scale),
        json.loads((given.recording / "movers.json").read_text()),
    )
    settings, noise, context = MoverSettings(), DepthNoise(), NativeContext()
    margin = Margin(settings.margin_m, 0.0, settings.margin_sigmas, noise.constant, noise.square)
    detector, tracks, layer, spent = MoverDetector(settings), MoverTracks(), DynamicLayer(), 0.0
    found: dict[int, list[tuple[float, float]]] = {}
    for frame in sequence.stream(masks="lazy"):
        T = frame.T_world_camera
        detector.look(frame, T, margin, context)
        tracks.look(RecentFrame.of(frame, T, margin), detector.things)
        start = time.process_time()
        layer.observe(tracks, frame.index, frame.timestamp)
        obstacles = layer.obstacles_at(frame.timestamp)
        spent += time.process_time() - start
        for obstacle in obstacles:
            velocity = true_velocity(truth, obstacle, frame.index, truth["nominal_fps"]) if frame.index else None
            if velocity is not None and obstacle.unseen_s == 0:
                error = np.linalg.norm(obstacle.velocity - velocity)
                found.setdefault(obstacle.number, []).append(
                    (100 * float(error), 100 * float(np.linalg.norm(velocity)))
                )
    names = {mover["instance_id"]: mover["name"] for mover in truth["movers"]}
    print(f"{'':28}{'frames':>8}{'median':>8}{'90 %':>8}{'speed':>8}")
    for number, rows in found.items():
        errors, speeds = np.array(rows).T
        print(f"{names[number]:28}{len(rows):8}{np.median(errors):8.1f}{np.percentile(errors, 90):8.1f}"
              f"{np.median(speeds):8.1f}")  # fmt: skip
    print(f"layer: {1e3 * spent / len(sequence):.2f} ms a frame")


if __name__ == "__main__":
    main()
