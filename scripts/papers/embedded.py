# SPDX-License-Identifier: Apache-2.0
"""The tables and figures of the paper on SLAM and point cloud coding on embedded systems, with ours beside them.

    python scripts/papers/embedded.py [--data FOLDER] [--quick]

Figure 4: milliseconds of odometry by 100 frames over 1,000 frames, straight on and turning, generated, with the sizes
of both local maps; edges and planes beside G-ICP. Figure 7: quality and size over the quantiser of colours and over
the scale of the geometry, of a recording's voxels. Parallel slices, and the energy of coding where it can be read.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_frontends import WINDOW, Run, track_frames  # isort: skip
from gpcc_clouds import voxelise  # isort: skip
from gpu_mapping import made  # isort: skip
from timing import seconds  # isort: skip
from ggslam.coding import encode_cloud
from ggslam.coding.energy import EnergyMeter
from ggslam.coding.settings import CodecSettings
from ggslam.coding.study import GridCloud, StudyTuning, on_grid, run_sweep, sweep_steps
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp_tracker import GicpTracker

WAYS = {
    "straight on": ("--scene", "corridor"),
    "turning": ("--path", "turns"),
}


def add_odometry(paper: Paper, name: str, frames: list[Frame]) -> None:
    """Rows of one way: both front-ends, a row for every 100 frames, then the whole."""
    context = NativeContext()
    features = FeatureTracker(frames[0].camera, context=context)
    sizes: list[tuple[int, int]] = []

    def watched() -> Iterator[Frame]:
        for n, frame in enumerate(frames):
            if n and n % WINDOW == 0:
                sizes.append(map_sizes(features))
            yield frame
        sizes.append(map_sizes(features))

    runs = {"edges and planes": track_frames(watched(), features, context)}
    runs["G-ICP"] = track_frames(frames, GicpTracker(frames[0].camera, context=context), context)
    for number, (edges, planes) in enumerate(sizes):
        texts = [f"{window_ms(run, number):.1f} ms {front_end}" for front_end, run in runs.items()]
        paper.add(
            "figure 4", f"{name}, frames {WINDOW * number} to {min(len(frames), WINDOW * (number + 1)) - 1}", "",
            ", ".join(texts), f"local maps: {edges} voxels of edges, {planes} of planes",
        )  # fmt: skip
    for front_end, run in runs.items():
        found = score_trajectory(run.poses, run.truth)
        error = "" if found is None else f"{100 * found.ate_rmse_m:.2f} cm ATE"
        paper.add("odometry", f"{name}, {front_end}", "", error, f"{len(frames)} frames, {run.lost} lost")


def map_sizes(tracker: FeatureTracker) -> tuple[int, int]:
    """Voxels of edges and of planes in the local map."""
    features = tracker.local_map.features
    return len(features.surfaces(edges=True)), len(features.surfaces(edges=False))


def window_ms(run: Run, number: int) -> float:
    """Mean milliseconds a frame of one window."""
    return float(np.mean(run.wall_ms[max(1, WINDOW * number) : WINDOW * (number + 1)]))


def add_coding(paper: Paper, name: str, cloud: GridCloud, quick: bool) -> None:
    """Rows of the codec."""
    meter = EnergyMeter()
    if meter.note:
        paper.add("energy", name, "", "", meter.note)
    steps = sweep_steps(("qp", "geometry"), *(((22,), (0.5,)) if quick else (StudyTuning.qps, StudyTuning.scales)))
    for row, _ in run_sweep(cloud, steps, CodecSettings(), meter):
        by_qp = row.step.sweep == "qp"
        energy = "" if row.joules is None else f"; {row.joules:.1f} J"
        paper.add(
            "figure 7", f"{name}, " + (f"QP {row.step.qp}" if by_qp else f"scale {row.step.geometry_scale:g}"), "",
            f"{8 * row.total_bytes / row.input_points:.2f} bits a point, "
            + (f"Y {row.color.values()['y']:.2f} dB" if by_qp else f"D1 {row.d1:.2f} dB, {row.decoded_points} points"),
            f"{row.encode_s:.2f} s to code, {row.decode_s:.2f} s to decode{energy}",
        )  # fmt: skip
    colors = {"color": cloud.colors}
    one, four = (
        min(seconds(partial(encode_cloud, cloud.grid, colors, CodecSettings(qp=22, slices=n)), 1 if quick else 5))
        for n in (1, 4)
    )
    paper.add(
        "slices", f"{name}, four in parallel, QP 22", "43 % less time", f"{100 * (1 - four / one):.0f} % less time",
        f"{os.cpu_count()} processors; {one:.2f} s in one slice",
    )  # fmt: skip


def main() -> None:
    arguments = options(__doc__).parse_args()
    torch.set_num_threads(1)
    quick = arguments.quick
    conditions = f"{os.cpu_count()} processors; generated recordings of 320x240 with a Kinect's noise."
    paper = Paper("embedded", "SLAM and coding on embedded systems (JBE 2025)", conditions)
    with tempfile.TemporaryDirectory() as folder:
        for name, words in WAYS.items():
            path = made(Path(folder, name.replace(" ", "_")), *words, "--frames", 40 if quick else 1000)
            add_odometry(paper, name, list(open_sequence(path).stream(masks=False)))
    recording = arguments.data / "livingroom"
    if recording.exists():
        cloud = voxelise(recording, 40 if quick else 10)
        add_coding(paper, "livingroom, 10 bits", on_grid(cloud.grid, cloud.colors, CodecSettings()), quick)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
