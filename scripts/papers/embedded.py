# SPDX-License-Identifier: Apache-2.0
"""The tables and figures of the paper on SLAM and point cloud coding on embedded systems, with ours beside them.

    python scripts/papers/embedded.py [--data FOLDER] [--quick]

Figure 4: milliseconds of odometry by 100 frames over 1,000 frames, straight on and turning, generated, with the sizes
of both local maps; edges and planes, with and without scan segments, beside G-ICP; and its plot. Figure 7: quality and
size over the quantiser of colours and over the scale of the geometry, of a recording's voxels. Parallel slices, and the
energy of coding where it can be read. Two clients that send the cells of their maps to one server.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_frontends import WINDOW, Run, track_frames  # isort: skip
from gpcc_clouds import voxelise  # isort: skip
from gpu_mapping import made, run_command  # isort: skip
from timing import seconds  # isort: skip
from ggslam.coding import encode_cloud
from ggslam.coding.settings import CodecSettings
from ggslam.coding.study import GridCloud, StudyTuning, on_grid, run_sweep, sweep_steps
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.jobs.submaps.cell_server import CellServer, send_store
from ggslam.native.loader import NativeContext
from ggslam.reporting.plot_files import write_sheet
from ggslam.reporting.plots import Plot, Series
from ggslam.scene.frame import Frame
from ggslam.sequences.factory import open_sequence
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import make_folder
from ggslam.system.energy import EnergyMeter
from ggslam.tracking.edges_planes.settings import ExtractionSettings, FeatureTrackerSettings
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.tracker import Tracker

SEGMENT_ANGLE = 10.0
"""Of scan segments, degrees."""
SEGMENTED = f"with segments of {SEGMENT_ANGLE:g} degrees"
WAYS = {
    "straight on": ("--scene", "corridor"),
    "turning": ("--path", "turns"),
}


@dataclass
class Odometry:
    """One front-end on one way.

    Attributes:
        name: of the front-end.
        run: what `track_frames` measured.
        sizes: of its local map after every 100 frames, by kind of voxel.
        features: planes and edges of each frame; none of G-ICP.
    """

    name: str
    run: Run = field(default_factory=Run)
    sizes: list[dict[str, int]] = field(default_factory=list)
    features: list[tuple[int, int]] = field(default_factory=list)

    def window_ms(self) -> list[float]:
        """Mean milliseconds a frame, by 100 frames; the first frame, which is not located, is left out."""
        times = self.run.wall_ms
        return [float(np.mean(times[max(1, k) : k + WINDOW])) for k in range(0, len(times), WINDOW)]

    def voxels(self) -> list[int]:
        """Of the local map, by 100 frames."""
        return [sum(sizes.values()) for sizes in self.sizes]


def track(name: str, frames: list[Frame], tracker: Tracker, context: NativeContext) -> Odometry:
    """Tracks all frames and looks at the local map every 100."""
    found = Odometry(name)

    def look(number: int) -> None:
        if number and isinstance(tracker, FeatureTracker):
            found.features.append((tracker.counts.planes, tracker.counts.edges))
        if number and (number % WINDOW == 0 or number == len(frames)):
            found.sizes.append(map_sizes(tracker))

    def watched() -> Iterator[Frame]:
        for number, frame in enumerate(frames):
            look(number)
            yield frame
        look(len(frames))

    found.run = track_frames(watched(), tracker, context)
    return found


def map_sizes(tracker: Tracker) -> dict[str, int]:
    """Voxels of the local map: of edges and of planes, or of G-ICP's target."""
    if isinstance(tracker, FeatureTracker):
        features = tracker.local_map.features
        return {"edges": len(features.surfaces(edges=True)), "planes": len(features.surfaces(edges=False))}
    return {"surface": 0 if tracker.target is None else len(tracker.target)}


def add_odometry(paper: Paper, way: str, frames: list[Frame]) -> list[Plot]:
    """Rows of one way: all front-ends, a row for every 100 frames, then the whole; and their plots."""
    context, camera = NativeContext(), frames[0].camera
    segmented = FeatureTrackerSettings(extraction=ExtractionSettings(segment_angle_deg=SEGMENT_ANGLE))
    runs = [
        track("edges and planes", frames, FeatureTracker(camera, context=context), context),
        track(SEGMENTED, frames, FeatureTracker(camera, features=segmented, context=context), context),
        track("G-ICP", frames, GicpTracker(camera, context=context), context),
    ]
    times = [one.window_ms() for one in runs]
    for number in range(len(times[0])):
        last = min(len(frames), WINDOW * (number + 1)) - 1
        texts = [f"{ms[number]:.1f} ms {one.name}" for one, ms in zip(runs, times, strict=True)]
        sizes = [f"{one.name}: " + ", ".join(f"{count} {kind}" for kind, count in one.sizes[number].items())
                 for one in runs]  # fmt: skip
        row = f"{way}, frames {WINDOW * number} to {last}"
        paper.add("figure 4", row, "", ", ".join(texts), f"voxels of the local maps: {'; '.join(sizes)}")
    for one in runs:
        scores = score_trajectory(one.run.poses, one.run.truth)
        error = "" if scores is None else f"{100 * scores.ate_rmse_m:.2f} cm ATE, "
        ours = f"{error}{np.mean(one.run.wall_ms[1:]):.1f} ms a frame, {np.mean(one.run.cpu_ms[1:]):.1f} of processors"
        remark = f"{len(frames)} frames, {one.run.lost} lost"
        if one.features:
            planes, edges = np.mean(one.features, 0)
            remark += f"; {planes:.0f} planes, {edges:.0f} edges a frame"
        paper.add("odometry", f"{way}, {one.name}", "", ours, remark)
    ends = [min(len(frames), WINDOW * (k + 1)) for k in range(len(times[0]))]
    return [
        Plot(
            f"{key}_{way}", f"{way}: {title}", "frame", label,
            [Series(one.name, ends, y, "marked", color) for color, (one, y) in enumerate(zip(runs, ys, strict=True))],
            from_zero=True,
        )
        for key, title, label, ys in (
            ("ms", "odometry", "ms a frame, mean of 100", times),
            ("maps", "local map", "voxels", [one.voxels() for one in runs]),
        )
    ]  # fmt: skip


def add_coding(paper: Paper, name: str, cloud: GridCloud, quick: bool) -> None:
    """Rows of the codec."""
    meter = EnergyMeter()
    if meter.note:
        paper.add("energy", name, "", "", meter.note)
    steps = sweep_steps(("qp", "geometry"), *(((22,), (0.5,)) if quick else (StudyTuning.qps, StudyTuning.scales)))
    for row, _ in run_sweep(cloud, steps, CodecSettings(), meter):
        by_qp = row.step.sweep == "qp"
        energy = f"; {row.encode_cpu_s:.2f} s of processors" if row.joules is None else f"; {row.joules:.1f} J"
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


def add_clients(paper: Paper, recording: Path, frames: int) -> None:
    """Row of two clients that record a half of a recording each, and send their cells to one server at once."""
    halves = {"a": (0, frames // 2, 0), "b": (frames // 2, frames, 1000)}  # b's over T later: the order does not matter
    folder = recording.parent

    def record(visit: str, store: str) -> None:
        start, stop, at = halves[visit]
        words = ["--visit", visit, "--start", start, "--stop", stop, "--at", at]
        run_command("submaps", recording, "--out", folder / store, *words)

    for visit in halves:
        record(visit, f"{visit}.grid")
        record(visit, "both.grid")
    with GridStore.open(folder / "a.grid") as one:
        settings = one.settings
    start = time.perf_counter()
    with (
        GridStore.create(folder / "server.grid", settings) as store,
        CellServer(store, "127.0.0.1", 0, "paper") as server,
        ThreadPoolExecutor(len(halves)) as pool,
    ):
        sent = list(pool.map(lambda name: send_store(folder / f"{name}.grid", *server.address, "paper"), halves))
    took = time.perf_counter() - start
    kept, local = content(folder / "server.grid"), content(folder / "both.grid")
    both = content(folder / "a.grid").keys() & content(folder / "b.grid").keys()
    same = kept.keys() == local.keys() and all(kept[key] == local[key] for key in kept.keys() - both)
    paper.add(
        "clients", "two clients at once, a half of the corridor each", "",
        f"{sum(one.bytes for one in sent) / 1e6:.2f} MB in {took:.2f} s, {len(kept)} cells of "
        f"{'+'.join(str(one.written + one.kept) for one in sent)}",
        f"{frames} frames; cells of one client {'equal' if same else 'DIFFER FROM'} those of both visits added here; "
        f"{len(both)} of both clients: the newer one's",
    )  # fmt: skip


def content(path: Path) -> dict[CellKey, object]:
    """All that a store has of its cells: visit, time, parts."""
    with GridStore.open(path) as store:
        cells = {key: store.cell(key) for key in store.cells()}
        return {
            key: (cell.visit, cell.recorded_at, {name: store.get(key, name) for name in cell.parts})
            for key, cell in cells.items()
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
            for file in write_sheet(arguments.out / f"embedded_figure_4_{path.name}", plots):
                print(file)
    recording = arguments.data / "livingroom"
    if recording.exists():
        cloud = voxelise(recording, 40 if quick else 10)
        add_coding(paper, "livingroom, 10 bits", on_grid(cloud.grid, cloud.colors, CodecSettings()), quick)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
