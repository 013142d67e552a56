# SPDX-License-Identifier: Apache-2.0
"""Finds a second recording in the map of an earlier run, without a starting pose; the map stays as it is.

python examples/localise.py demo/run demo/second_visit demo/visit
"""

from __future__ import annotations

import sys

import numpy as np

import ggslam


def main(run: str, recording: str, out: str, start: str = "0", stop: str = "30") -> None:
    """Locates frames `start` to `stop` of the recording and writes their poses to `out`/trajectory.txt."""
    sequence = ggslam.open_sequence(recording, start=int(start), stop=int(stop))
    outcome = ggslam.run_recording(sequence, out, map=run, localize_only=True, evaluate=False, overwrite=True)
    print(outcome.headline())
    for frame, T_world_camera in zip(outcome.result.frames, outcome.result.trajectory(), strict=True):
        place = "lost" if not np.isfinite(T_world_camera).all() else np.array2string(T_world_camera[:3, 3], precision=3)
        print(f"frame {frame.source_index}: {place}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (4, 5, 6) else sys.exit(__doc__)
