#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Volumetric maps of recordings: how fast, how large, how true.

    python scripts/benchmarks/bench_volumes.py ../shared/data/livingroom ../shared/data/redkitchen
    python scripts/benchmarks/bench_volumes.py ../shared/data/livingroom --parts mesh --voxels 0.02 0.01

All parts use the recordings' true poses. Parts:
    tsdf      fusion with colour and carving against Open3D's VoxelBlockGrid (CPU, with colour, which does not carve),
              frame by frame by turns, in the same run
    mesh      mesh and depth rendering of both maps: time, distance to the back-projected depth of all frames (true
              where the recording's depth and poses are exact), rendered depth against measured depth
    esdf      the distance field, updated every 5 frames, against computing it anew, against `edt` and scipy
    pace      TSDF and distance field after every frame, without and with a limit
    corridor  a long walk (`ggslam synth DIR --scene corridor --frames 2400`) at 4 and 2 cm with a distance field after
              every frame, with a limit of memory (--limits) and without: time and memory of the first, second, fifth
              and last tenth of the way
    files     what is made of such a walk after its last frame (slice, maps, mesh): memory of the process for 1, 2, 5
              and 10 tenths of the way
    accuracy  the distance field of scenes whose distances are known, against `edt` and scipy; needs no recording
Open3D and edt come with `pip install 'ggslam[bench]'`; without them ours is printed alone. Occupancy has a benchmark of
its own, bench_occupancy.py.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))

if "--peers" in sys.argv[:-1]:  # behind our own packages, before anything looks for Open3D
    sys.path.append(sys.argv[sys.argv.index("--peers") + 1])

from volume_corridor_files import corridor_files_part
from volume_corridor_runs import corridor_part
from volume_esdf_runs import accuracy_part, esdf_part, pace_part
from volume_mesh_runs import compare_meshes
from volume_runs import compare_fusion

PARTS: dict[str, Callable[[Path, argparse.Namespace], None]] = {
    "tsdf": compare_fusion, "mesh": compare_meshes,
    "esdf": lambda path, arguments: esdf_part(path, tuple(arguments.esdf_voxels), frames=arguments.frames),
    "pace": lambda path, arguments: pace_part(path, frames=arguments.frames),
    "corridor": lambda path, arguments: corridor_part(
        path, tuple(arguments.corridor_voxels), tuple(arguments.limits), arguments.frames
    ),
    "files": lambda path, arguments: corridor_files_part(
        path, tuple(arguments.corridor_voxels), tuple(arguments.limits), arguments.frames
    ),
}  # fmt: skip

USUAL = ("tsdf", "mesh", "esdf", "pace", "accuracy")
"""Parts for any recording."""


def main() -> None:
    """Runs the chosen parts on each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--parts", nargs="+", choices=[*PARTS, "accuracy"], default=USUAL)
    parser.add_argument("--voxels", nargs="+", type=float, default=[0.1, 0.05, 0.02, 0.01], help="of the TSDF, metres")
    parser.add_argument("--esdf-voxels", nargs="+", type=float, default=[0.08, 0.04, 0.02], help="metres")
    parser.add_argument("--corridor-voxels", nargs="+", type=float, default=[0.04, 0.02], help="metres")
    parser.add_argument("--limits", nargs="+", type=float, default=[80, 450], help="corridor: MB, for each voxel size")
    parser.add_argument("--frames", type=int, help="only the first of a recording")
    parser.add_argument("--views", type=int, help="only so many, spread over the recording")
    parser.add_argument("--peers", type=Path, help="site-packages of another environment that has Open3D")
    parser.add_argument("--repeats", type=int, default=2, help="whole runs; the fastest time of each frame counts")
    arguments = parser.parse_args()
    for path in arguments.recordings:
        for part in arguments.parts:
            if part in PARTS:
                PARTS[part](path, arguments)
    if "accuracy" in arguments.parts:
        accuracy_part()


if __name__ == "__main__":
    main()
