# SPDX-License-Identifier: Apache-2.0
"""The tables of the paper on volumetric mapping with a GPU, with ours, on processors, beside them.

    python scripts/papers/gpu_mapping.py [--quick]

Generated rooms with a Kinect's noise at true poses: fusion with colour and carving at voxels of 10, 5, 2 and 1 cm of
images of 640x480 and 1280x720, the distance field after every frame where the camera's period has room for it; depth
looked up by projection, gathered along rays, and both (hybrid): how far the map drawn at the frames' poses is from
exact depth, and time; a rig of four cameras through `ggslam volumes`, points a second.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rows import Paper, options

from ggslam.scene.frame import Frame
from ggslam.sequences.factory import open_sequence
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.raycast import render_depth
from ggslam.volumes.settings import INTEGRATORS, TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

SIZES = ((640, 480), (1280, 720))
VOXELS = (0.10, 0.05, 0.02, 0.01)
FIELD_FROM = 0.02
"""Metres; the distance field of smaller voxels is far from a camera's period."""
PERIOD_MS = 1e3 / 30


def made(folder: Path, *words: object) -> Path:
    """A recording that `ggslam synth` writes."""
    run_command("synth", folder, *words)
    return folder


def run_command(*words: object) -> None:
    """Runs a command of `ggslam`."""
    subprocess.run([sys.executable, "-m", "ggslam", *map(str, words)], check=True, capture_output=True)


def fuse(frames: list[Frame], voxel: float, with_field: bool) -> tuple[np.ndarray, np.ndarray, TsdfMap]:
    """Milliseconds a frame of fusion and of the field's update, and the map."""
    tsdf = TsdfMap(TsdfSettings(voxel=voxel), points=with_field)
    field, times = DistanceField(tsdf) if with_field else None, []
    for frame in frames:
        assert frame.T_world_camera is not None
        began = time.perf_counter()
        tsdf.integrate(frame.depth, frame.camera, frame.T_world_camera, frame.color)
        fused = time.perf_counter()
        if field is not None:
            field.update()
        times.append((fused - began, time.perf_counter() - fused))
    fusion, update = 1e3 * np.array(times).T
    return fusion, update, tsdf


def add_sizes(paper: Paper, folder: Path, size: tuple[int, int], count: int, voxels: tuple[float, ...]) -> None:
    """Rows of one image size."""
    path = made(folder / f"{size[0]}", "--frames", count, "--width", size[0], "--height", size[1])
    frames = list(open_sequence(path).stream(masks=False))
    points = float(np.mean([np.count_nonzero(frame.depth) for frame in frames]))
    for voxel in voxels:
        fusion, update, tsdf = fuse(frames, voxel, voxel >= FIELD_FROM)
        both = fusion + update
        late = 100 * float(np.mean(both > PERIOD_MS))
        most = np.percentile(both, 95)
        field = f", with the distance field {both.mean():.1f}, 95 % {most:.1f}" if voxel >= FIELD_FROM else ""
        paper.add(
            "fusion", f"{size[0]}x{size[1]}, {100 * voxel:g} cm", "",
            f"{fusion.mean():.1f} ms, 95 % {np.percentile(fusion, 95):.1f}{field}",
            f"{points / fusion.mean() / 1e3:.1f} million points/s fused; {late:.0f} % of frames over 33 ms; "
            f"{tsdf.memory_bytes / 1e6:.0f} MB",
        )  # fmt: skip


def add_integrators(paper: Paper, folder: Path, count: int, voxels: tuple[float, ...]) -> None:
    """Rows of the three integrators, by turns on one recording, whose exact depth is known."""
    words = ("--frames", count, "--size", "640x480")
    noisy = list(open_sequence(made(folder / "noisy", *words)).stream(masks=False))
    exact = list(open_sequence(made(folder / "exact", *words, "--no-noise")).stream(masks=False))
    for voxel in voxels:
        spent = {}
        for kind in INTEGRATORS:
            tsdf, began = TsdfMap(TsdfSettings(voxel=voxel, integrator=kind), points=False), time.process_time()
            for frame in noisy:
                assert frame.T_world_camera is not None
                tsdf.integrate(frame.depth, frame.camera, frame.T_world_camera, frame.color)
            spent[kind] = time.process_time() - began
            errors, missing = drawn_errors(tsdf, exact[::5])
            paper.add(
                "integrators", f"{kind}, {100 * voxel:g} cm", "",
                f"median {np.median(errors):.2f} mm, 90 % {np.percentile(errors, 90):.1f} mm from exact depth",
                f"{1e3 * spent[kind] / count:.0f} ms of processor time a frame, "
                f"{spent[kind] / spent['projection']:.1f} times projection's; {100 * missing:.1f} % of pixels empty",
            )  # fmt: skip


def drawn_errors(tsdf: TsdfMap, frames: list[Frame]) -> tuple[np.ndarray, float]:
    """Distances, mm, of depth drawn from a map at the poses of frames to their own, and the share that is missing."""
    errors, missing, all_pixels = [], 0, 0
    for frame in frames:
        assert frame.T_world_camera is not None
        drawn = render_depth(tsdf, frame.camera, frame.T_world_camera).depth
        there = (frame.depth > tsdf.settings.min_depth) & (frame.depth < tsdf.settings.max_depth)
        errors.append(1e3 * np.abs(drawn - frame.depth)[there & (drawn > 0)])
        missing, all_pixels = missing + np.count_nonzero(there & (drawn <= 0)), all_pixels + np.count_nonzero(there)
    return np.concatenate(errors), missing / all_pixels


def add_rig(paper: Paper, folder: Path, count: int, voxel: float) -> None:
    """Four cameras at once."""
    rig = made(folder / "rig", "--frames", count, "--width", 640, "--height", 480, "--rig", "front,left,back,right")
    out = folder / "rig_volumes"
    command = [sys.executable, "-m", "ggslam", "volumes", rig, "--voxel", voxel, "--out", out]
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    points = json.loads((out / "volumes.json").read_text())["points"]
    paper.add(
        "rig", f"four cameras of 640x480, {100 * voxel:g} cm", "", f"{points['per_s'] / 1e6:.1f} million points/s",
        f"{points['count']:,} points of {count} instants, `ggslam volumes`",
    )  # fmt: skip


def main() -> None:
    arguments = options(__doc__).parse_args()
    conditions = f"{os.cpu_count()} processors, no GPU; generated rooms."
    paper = Paper("gpu_mapping", "Volumetric mapping on a GPU", conditions)
    with tempfile.TemporaryDirectory() as made_here:
        folder, quick = Path(made_here), arguments.quick
        for size in SIZES[:1] if quick else SIZES:
            add_sizes(paper, folder, size, 6 if quick else 60, (0.05,) if quick else VOXELS)
        add_integrators(paper, folder, 6 if quick else 60, (0.05,) if quick else VOXELS)
        add_rig(paper, folder, 3 if quick else 30, 0.05)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
