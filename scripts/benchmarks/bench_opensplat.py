# SPDX-License-Identifier: Apache-2.0
"""A training step of a finished run's map against one of OpenSplat's CPU build, by turns on the same images.

    python scripts/benchmarks/bench_opensplat.py RUN --opensplat PATH/TO/opensplat

OpenSplat (github.com/pierotofy/OpenSplat, AGPL: built outside this checkout, GPU_RUNTIME=CPU) starts from as many
points of the run's surface as its map has Gaussians, sees the run's images at the same size, and neither splits nor
reduces images. Its step is the time of many steps less that of few, over their number. Ours is `ggslam refine` counted
in the same way. Both use all processors that they want.
"""

from __future__ import annotations

import argparse
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from ggslam.runs.folder import RunFolder

ROW_END = b"end_header\n"


def thin_points(path: Path, count: int) -> int:
    """Keeps `count` rows of a binary PLY of points, evenly; how many there are then."""
    header, _, body = path.read_bytes().partition(ROW_END)
    found = re.search(rb"element vertex (\d+)", header)
    assert found is not None, path
    rows = np.frombuffer(body, np.uint8).reshape(int(found[1]), -1)
    kept = rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int))]
    path.write_bytes(header.replace(found[0], b"element vertex %d" % len(kept)) + ROW_END + kept.tobytes())
    return len(kept)


def seconds(command: list[object]) -> float:
    """How long a command takes."""
    start = time.perf_counter()
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--opensplat", type=Path, required=True, help="its program")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--steps", type=int, nargs=2, default=(5, 45), help="of OpenSplat, few and many")
    arguments = parser.parse_args()
    gaussians = RunFolder.open(arguments.run).gaussians().count
    ggslam: list[object] = [sys.executable, "-m", "ggslam"]
    with tempfile.TemporaryDirectory() as made:
        images = Path(made, "images")
        export = [*ggslam, "export", arguments.run, "--format", "nerfstudio", "--out", images]
        subprocess.run([str(word) for word in export], check=True, capture_output=True)
        points = thin_points(images / "points.ply", gaussians)
        times: dict[str, list[float]] = {"OpenSplat": [], "ours": []}
        few, many = arguments.steps
        for _ in range(arguments.repeat):
            theirs = [arguments.opensplat, images, "--cpu", "--downscale-factor", 1, "--num-downscales", 0,
                      "--sh-degree", 1, "--warmup-length", 10**6, "-o", Path(made, "out.ply"), "-n"]  # fmt: skip
            times["OpenSplat"].append((seconds([*theirs, many]) - seconds([*theirs, few])) / (many - few))
            ours = [*ggslam, "refine", arguments.run, "--out", Path(made, "refined"), "--overwrite", "--steps"]
            times["ours"].append((seconds([*ours, 20 * many]) - seconds([*ours, 20 * few])) / (20 * (many - few)))
    print(f"{gaussians} Gaussians, {points} points; milliseconds a step, {arguments.repeat} turns")
    for name, each in times.items():
        print(f"  {name}: {1e3 * statistics.median(each):.1f} ({', '.join(f'{1e3 * one:.1f}' for one in each)})")
    ratios = [theirs / ours for theirs, ours in zip(times["OpenSplat"], times["ours"], strict=True)]
    print(f"  OpenSplat takes {statistics.median(ratios):.0f} times as long ({min(ratios):.0f} to {max(ratios):.0f})")


if __name__ == "__main__":
    main()
