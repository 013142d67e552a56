# SPDX-License-Identifier: Apache-2.0
"""Table 1, figure 7, slices, a run that codes itself, of the paper on embedded systems. A part of embedded.py."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper

from gpcc_clouds import Cloud  # isort: skip
from timing import seconds  # isort: skip
from ggslam.coding import encode_cloud
from ggslam.coding.quantization import Quantization
from ggslam.coding.settings import CodecSettings
from ggslam.coding.study import SWEEPS, GridCloud, StudyRow, StudyTuning, run_sweep, sweep_steps
from ggslam.jobs.encode.coding import encode_file
from ggslam.jobs.run.encoding import EncodeRequest
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import SequenceRequest
from ggslam.system.energy import EnergyMeter

PEOPLE_QPS = (22, 34)
COARSE_SCALES, COARSE_QPS = (1 / 256, 1 / 128, 1 / 64, 1 / 32), (64, 56, 48, 40)
"""The coarse end of figure 7: steps of 256, 128, 64 and 32 voxels."""
WORDS = {"geometry": "the geometry's scale", "geometry_qp": "the geometry's QP"}
CHEAP = ["identity.enabled=false", "refine_iterations=60"]
FEW = 1000
TURNS = {
    True: "errors are taken both ways and the worse counts: of so few decoded points that is chance",
    False: "steps that are no whole voxels are rounded: some planes of voxels move by one, others stay, and it depends "
    "on the room whether its walls are among them",
}
"""Why a coarser geometry measures better, of few decoded points and of many."""


def add_person(paper: Paper, cloud: Cloud, qps: Sequence[int]) -> None:
    """A row of table 1 for each quantiser of colours, at lossless geometry."""
    on = GridCloud(cloud.grid, cloud.colors, Quantization(1.0))
    for row, _ in run_sweep(on, sweep_steps(("qp",), qps), CodecSettings(), EnergyMeter()):
        bits = {"geometry": row.geometry_bytes, "colours": row.color_bytes}
        parts = " + ".join(f"{8 * size / row.input_points:.2f} of {part}" for part, size in bits.items())
        paper.add(
            "table 1", f"{cloud.name} (drawn, for MPEG's people), 10 bits, {row.step.words()}", "",
            f"{8 * row.total_bytes / row.input_points:.2f} bits a point, {parts}; Y {row.color.y:.2f} dB",
            f"{row.input_points} points; {row.encode_s:.2f} s to code, {row.decode_s:.2f} s to decode",
        )  # fmt: skip


def add_coding(paper: Paper, name: str, cloud: GridCloud, quick: bool) -> None:
    """Rows of the codec."""
    meter = EnergyMeter()
    if meter.note:
        paper.add("energy", name, "", "", meter.note)
    whole = (StudyTuning.qps, (*COARSE_SCALES, *StudyTuning.scales), (*COARSE_QPS, *StudyTuning.geometry_qps))
    steps = sweep_steps(SWEEPS, *(((22,), (0.5, *COARSE_SCALES[:2]), (8, *COARSE_QPS[:2])) if quick else whole))
    rows = []
    for row, _ in run_sweep(cloud, steps, CodecSettings(), meter):
        rows.append(row)
        energy = f"; {row.encode_cpu_s:.2f} s of processors" if row.joules is None else f"; {row.joules:.1f} J"
        paper.add(
            "figure 7", f"{name}, {row.step.words()}", "",
            f"{8 * row.total_bytes / row.input_points:.4g} bits a point, " + quality(row),
            f"{row.encode_s:.2f} s to code, {row.decode_s:.2f} s to decode{energy}",
        )  # fmt: skip
    for sweep in SWEEPS[1:]:
        add_turns(paper, name, [row for row in rows if row.step.sweep == sweep])
    colors = {"color": cloud.colors}
    one, four = (
        min(seconds(partial(encode_cloud, cloud.grid, colors, CodecSettings(qp=22, slices=n)), 1 if quick else 5))
        for n in (1, 4)
    )
    paper.add(
        "slices", f"{name}, four in parallel, QP 22", "43 % less time", f"{100 * (1 - four / one):.0f} % less time",
        f"{os.cpu_count()} processors; {one:.2f} s in one slice",
    )  # fmt: skip


def add_run(paper: Paper, folder: Path, name: str, recording: Path, frames: int) -> None:
    """A row of a run that codes itself, held against coding it afterwards."""
    asked = EncodeRequest(folder / "beside.bin", CodecSettings(slices=4))
    reading = SequenceRequest(recording, stop=frames, scale=0.5)
    outcome = execute(RunRequest(reading, folder / "run", encode=asked, checkpoint_every=0, overrides=CHEAP))
    encode_file(outcome.folder.path, folder / "after.bin", asked.settings)
    same = asked.out.read_bytes() == (folder / "after.bin").read_bytes()
    words = outcome.encoded.replace(str(asked.out), "").replace(": ,", ":")
    paper.add("run --encode", f"{name}, {frames} frames, 4 slices", "", words,
              f"{'the same bytes as' if same else 'OTHER BYTES THAN'} `encode` afterwards")  # fmt: skip


def quality(row: StudyRow) -> str:
    """What is left of a cloud."""
    color = row.color
    if row.step.sweep == "qp":
        return f"Y {color.y:.2f} dB"
    return (
        f"D1 {row.d1:.2f}, D2 {row.d2:.2f}, Y {color.y:.2f}, U {color.u:.2f}, V {color.v:.2f} dB, "
        f"{row.decoded_points} points, {8 * row.total_bytes / row.decoded_points:.3g} bits a decoded point"
    )


def add_turns(paper: Paper, name: str, rows: list[StudyRow]) -> None:
    """A row for each measure that gets better where the geometry gets coarser."""
    by_size = sorted(rows, key=lambda row: row.total_bytes)
    for measure in ("d1", "d2", "psnr_y", "psnr_u", "psnr_v"):
        pairs = [
            (coarse, fine)
            for coarse, fine in itertools.pairwise(by_size)
            if coarse.values()[measure] > fine.values()[measure]
        ]
        turns = [
            f"{coarse.values()[measure]:.2f} dB at {coarse.step.words()} ({coarse.decoded_points} points) over "
            f"{fine.values()[measure]:.2f} at {fine.step.words()} ({fine.decoded_points})"
            for coarse, fine in pairs
        ]
        why = "; ".join(TURNS[few] for few in sorted({coarse.decoded_points < FEW for coarse, _ in pairs}))
        what = f"{name}, {measure.removeprefix('psnr_').upper()} over {WORDS[rows[0].step.sweep]}"
        paper.add("figure 7, where it is not monotone", what, "", "; ".join(turns) or "monotone", why)
