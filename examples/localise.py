# SPDX-License-Identifier: Apache-2.0
"""Finds a second recording in the map of an earlier run, without a starting pose; the map stays as it is.

python examples/localise.py demo/run demo/second_visit demo/visit
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import SequenceRequest


def main(run: str, recording: str, out: str, start: str = "0", stop: str = "30") -> None:
    """Locates frames `start` to `stop` of the recording and writes their poses to `out`/trajectory.txt."""
    request = RunRequest(
        SequenceRequest(Path(recording), start=int(start), stop=int(stop)),
        out=Path(out),
        map=Path(run),
        localize_only=True,
        evaluate=False,
        overwrite=True,
    )
    outcome = execute(request)
    print(outcome.headline())
    for frame, T_world_camera in zip(outcome.result.frames, outcome.result.trajectory(), strict=True):
        place = "lost" if not np.isfinite(T_world_camera).all() else np.array2string(T_world_camera[:3, 3], precision=3)
        print(f"frame {frame.source_index}: {place}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (4, 5, 6) else sys.exit(__doc__)
