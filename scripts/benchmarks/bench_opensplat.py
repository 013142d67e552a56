# SPDX-License-Identifier: Apache-2.0
"""A training step of a finished run's map against one of OpenSplat's CPU build: the same Gaussians, images and poses.

    python scripts/benchmarks/bench_opensplat.py RUN --opensplat PATH/TO/opensplat

OpenSplat (github.com/pierotofy/OpenSplat, AGPL: built outside this checkout, GPU_RUNTIME=CPU) resumes from the run's
Gaussians, with harmonics of degree 1, the least it has, and neither splits Gaussians nor reduces images. A step is the
time of many steps less that of few, over their number; ours is that of `ggslam refine`. Both use all processors that
they want, by turns.
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

END = b"end_header\n"


def read_rows(path: Path) -> tuple[list[bytes], np.ndarray]:
    """Header lines and rows of a binary PLY with one element."""
    header, _, body = path.read_bytes().partition(END)
    kinds = {b"float": "<f4", b"int": "<i4", b"uchar": "u1"}
    fields = [(name.decode(), kinds[kind]) for kind, name in re.findall(rb"property (\w+) (\w+)", header)]
    return header.splitlines(), np.frombuffer(body, np.dtype(fields))


def write_start(theirs: Path, ours: Path, out: Path, step: int) -> int:
    """Writes our Gaussians as OpenSplat's output is written, after so many steps; returns their number."""
    header, template = read_rows(theirs)
    _, rows = read_rows(ours)
    filled = np.zeros(len(rows), template.dtype)
    for name in filled.dtype.names or ():
        if name in (rows.dtype.names or ()):
            filled[name] = rows[name]
    lines = [re.sub(rb"iteration \d+", b"iteration %d" % step, line) for line in header]
    lines = [re.sub(rb"element vertex \d+", b"element vertex %d" % len(rows), line) for line in lines]
    out.write_bytes(b"\n".join(lines) + b"\n" + END + filled.tobytes())
    return len(rows)


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
    ggslam: list[object] = [sys.executable, "-m", "ggslam"]
    with tempfile.TemporaryDirectory() as made:
        images, splats, start = Path(made, "images"), Path(made, "ours.ply"), Path(made, "start.ply")
        seconds([*ggslam, "export", arguments.run, "--format", "nerfstudio", "--out", images])
        seconds([*ggslam, "export", arguments.run, "--format", "ply", "--out", splats])
        theirs = [arguments.opensplat, images, "--cpu", "--downscale-factor", 1, "--num-downscales", 0,
                  "--sh-degree", 1, "--warmup-length", 10**6, "-o", Path(made, "out.ply")]  # fmt: skip
        seconds([*theirs, "-n", 1])
        gaussians = write_start(Path(made, "out.ply"), splats, start, step=10)
        times: dict[str, list[float]] = {"OpenSplat": [], "ours": []}
        few, many = arguments.steps
        for _ in range(arguments.repeat):
            resume = [*theirs, "--resume", start, "-n"]
            times["OpenSplat"].append((seconds([*resume, 10 + many]) - seconds([*resume, 10 + few])) / (many - few))
            refine = [*ggslam, "refine", arguments.run, "--out", Path(made, "refined"), "--overwrite", "--steps"]
            times["ours"].append((seconds([*refine, 20 * many]) - seconds([*refine, 20 * few])) / (20 * (many - few)))
    print(f"{gaussians} Gaussians; milliseconds a step, {arguments.repeat} turns")
    for name, each in times.items():
        print(f"  {name}: {1e3 * statistics.median(each):.1f} ({', '.join(f'{1e3 * one:.1f}' for one in each)})")
    ratios = [theirs / ours for theirs, ours in zip(times["OpenSplat"], times["ours"], strict=True)]
    print(f"  OpenSplat takes {statistics.median(ratios):.0f} times as long ({min(ratios):.0f} to {max(ratios):.0f})")


if __name__ == "__main__":
    main()
