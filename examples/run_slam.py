# SPDX-License-Identifier: Apache-2.0
"""SLAM frame by frame, then everything as a run folder that `ggslam view`, `eval` and `export` take.

ggslam synth demo/room
python examples/run_slam.py demo/room demo/out
"""

from __future__ import annotations

import sys

import ggslam


def main(recording: str, out: str) -> None:
    """Tracks and maps a recording."""
    sequence = ggslam.open_sequence(recording)
    slam = ggslam.Slam(sequence.camera, ggslam.load_config("fast-cpu"), sequence.has_masks)
    for frame in sequence:
        report = slam.step(frame)
        if report.is_keyframe:
            place = report.T_world_camera[:3, 3].round(2)
            print(f"frame {frame.index}: keyframe at {place}, {report.gaussians} Gaussians")
    result = slam.finish()
    for record in result.object_table(sequence.instance_names).objects:
        print(f"{record.label()}: {record.gaussians} Gaussians")
    folder = ggslam.save_run(result, out, sequence, overwrite=True)
    print(f"{len(result.frames)} frames, {result.gaussian_count} Gaussians in {folder.path}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
