# SPDX-License-Identifier: Apache-2.0
"""Tracking of motions unlike a careful hand's: wide steps, fast turns, a tripod. Generated recordings with exact poses.

    python scripts/benchmarks/bench_motion.py                       # all kinds, about five minutes
    python scripts/benchmarks/bench_motion.py --only turns tripod   # those with one of these words in their names

Prints a Markdown table. The map is trained by one step a frame; times are ratios against the usual pace of the same run
of this script.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config
from ggslam.slam.slam import Slam
from ggslam.synthetic import Shutter, write_synthetic_sequence


@dataclass(frozen=True)
class Kind:
    """A kind of motion, and the arguments of `write_synthetic_sequence` that make it."""

    name: str
    arguments: dict[str, Any] = field(default_factory=dict)


USUAL = Kind("usual pace", {"frames": 60})
KINDS = [
    USUAL,
    Kind("walk at 2 frames/s", {"scene": "loop", "speed": 5, "frames": 96}),
    Kind("bare walls, steps of 35 cm", {"scene": "bare", "speed": 6, "frames": 60}),
    Kind("turns, up to 4.7 degrees", {"trajectory": "turns", "frames": 180, "shutter": Shutter(0.13)}),
    Kind("turns, up to 14 degrees", {"trajectory": "turns", "speed": 3, "frames": 90, "shutter": Shutter(0.4)}),
    *(
        Kind(
            f"turns, up to 14 degrees, rolling shutters, seed {seed}",
            {"trajectory": "turns", "speed": 3, "frames": 70, "seed": seed, "shutter": Shutter(0.4, 0.4, delay)},
        )
        for seed, delay in ((1, 0.15), (2, -0.1))
    ),
    *(
        Kind(
            f"tripod, movers, seed {seed}",
            {"trajectory": "still", "frames": 60, "seed": seed, "movers": ["walker", "mug", "door"]},
        )
        for seed in (1, 2, 3)
    ),
]


def row(kind: Kind, folder: Path, usual_s: float | None) -> tuple[list[str], float]:
    """Cells of the table, and seconds of tracking per frame."""
    recording = write_synthetic_sequence(folder, **kind.arguments)
    sequence, config = open_sequence(recording), Config()
    slam = Slam(sequence.camera, replace(config, mapping=replace(config.mapping, iterations_per_frame=1)))
    for frame in sequence.stream():
        slam.step(frame)
    statuses = [frame.status for frame in slam.frames]
    known = [number for number, status in enumerate(statuses) if status != "lost"]
    found = np.stack([slam.pose_of(slam.frames[number]) for number in known])
    assert sequence.ground_truth is not None
    truth = np.stack([sequence.ground_truth[number] for number in known])
    ate = score_trajectory(found, truth).ate_rmse_m
    way = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    astray = float(np.linalg.norm(found[:, :3, 3] - found[0, :3, 3], axis=1).max())
    seconds = float(np.median(slam.times.tracking_by_frame))
    cells = [
        kind.name, str(len(statuses)), str(statuses.count("lost")), str(statuses.count("recovered")),
        f"{100 * ate:.2f} cm of {way:.1f} m" if way else f"{1e3 * astray:.1f} mm astray", str(len(slam.movers.pixels)),
        f"{seconds / (usual_s or seconds):.1f}",
    ]  # fmt: skip
    return cells, seconds


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], help="words of the kinds' names")
    only = parser.parse_args().only
    console = Console(width=200, highlight=False)
    console.print("| motion | frames | lost | recovered | ATE | frames with movers | time |", markup=False)
    console.print("|---|---|---|---|---|---|---|", markup=False)
    usual_s: float | None = None
    with tempfile.TemporaryDirectory() as folder:
        for number, kind in enumerate(KINDS):
            if only and kind is not USUAL and not any(word in kind.name for word in only):
                continue
            cells, seconds = row(kind, Path(folder) / str(number), usual_s)
            usual_s = usual_s or seconds
            console.print("| " + " | ".join(cells) + " |", markup=False)


if __name__ == "__main__":
    main()
