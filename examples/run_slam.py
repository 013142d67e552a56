# SPDX-License-Identifier: Apache-2.0
"""SLAM frame by frame, then trajectory and map as files.

ggslam synth demo/room
python examples/run_slam.py demo/room demo/out
"""

from __future__ import annotations

import sys
from pathlib import Path

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.trajectory import write_tum
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam


def main(recording: str, out: str) -> None:
    """Tracks and maps a recording."""
    sequence = open_sequence(recording)
    slam = Slam(sequence.camera, load_config("fast-cpu"))
    for frame in sequence.stream(masks=False):
        report = slam.step(frame)
        if report.is_keyframe:
            print(f"frame {frame.index}: keyframe, {report.gaussians} Gaussians, overlap {report.frame.overlap:.0%}")
    result = slam.finish()
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / "trajectory.txt", result.timestamps(), result.trajectory())
    write_gaussian_ply(folder / "map.ply", result.gaussians)
    print(f"{len(result.frames)} frames, {len(result.gaussians)} Gaussians in {folder / 'map.ply'}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
