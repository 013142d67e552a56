# SPDX-License-Identifier: Apache-2.0
"""The tables and figures of the paper on SLAM and point cloud coding on embedded systems, with ours beside them.

    python scripts/papers/embedded.py [--data FOLDER] [--quick]

Figure 4: milliseconds of odometry by 100 frames over 1,000 frames, straight on and turning, generated, with the sizes
of both local maps; edges and planes, with and without scan segments, beside G-ICP; and its plot. Table 1: people,
drawn as MPEG's are not to be had. Figure 7: quality and size over the quantiser of colours, the scale of the geometry
and its quantiser within the octree, of a recording's voxels, down to where next to nothing is left. Parallel slices,
the energy of coding where it can be read, a run that codes itself, and two clients that send the cells of their maps
to one server.
"""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import torch

import find_benchmarks  # noqa: F401  # isort: skip
from embedded_clients import add_clients
from embedded_coding import PEOPLE_QPS, add_coding, add_person, add_run
from embedded_odometry import add_odometry
from gpu_mapping import made
from rows import Paper, options

from gpcc_clouds import person, voxelise  # isort: skip
from ggslam.coding.settings import CodecSettings
from ggslam.coding.study import on_grid
from ggslam.reporting.plot_files import write_sheet
from ggslam.sequences.factory import open_sequence
from ggslam.system.atomic import make_folder

WAYS = {
    "straight on": ("--scene", "corridor"),
    "turning": ("--path", "turns"),
}


def main() -> None:
    arguments = options(__doc__).parse_args()
    torch.set_num_threads(1)
    quick = arguments.quick
    conditions = f"{os.cpu_count()} processors; generated recordings of 320x240 with a Kinect's noise."
    paper = Paper("embedded", "SLAM and coding on embedded systems (JBE 2025)", conditions)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(len(WAYS)) as pool:
        count = ("--frames", 40 if quick else 1000)
        made_ways = {
            name: pool.submit(made, Path(folder, name.replace(" ", "_")), *words, *count)
            for name, words in WAYS.items()
        }
        wait(made_ways.values())  # before anything is timed
        for name, path in ((name, future.result()) for name, future in made_ways.items()):
            plots = add_odometry(paper, name, list(open_sequence(path).stream(masks=False)))
            make_folder(arguments.out)
            if "corridor" in WAYS[name]:
                add_clients(paper, path, 40 if quick else 400)
                add_run(paper, Path(folder), name, path, 10 if quick else 60)
            for file in write_sheet(arguments.out / f"embedded_figure_4_{path.name}", plots)[:1]:
                paper.show(file, f"Figure 4, {name}: odometry by 100 frames, and voxels of the local maps")
    for seed in range(1 if quick else 4):
        add_person(paper, person(seed), PEOPLE_QPS[: 1 if quick else None])
    recording = arguments.data / "livingroom"
    if recording.exists():
        cloud = voxelise(recording, 40 if quick else 10)
        add_coding(paper, "livingroom, 10 bits", on_grid(cloud.grid, cloud.colors, CodecSettings()), quick)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
