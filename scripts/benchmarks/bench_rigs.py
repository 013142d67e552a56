#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Runs of rigs of two cameras against runs of each of the cameras alone.

    python scripts/benchmarks/bench_rigs.py --folder /tmp/rigs
    python scripts/benchmarks/bench_rigs.py --folder /tmp/rigs --cases room dark --frames 100

Cases:
    room      two cameras back to back in a generated room
    house     one looking ahead and one to the left on a walk through a house (`--scene loop`), depth distorted
    corridor  one looking ahead and one back along a corridor
    dark      the room; the back camera sees nothing for 50 frames in the middle
    black     the same, but it is the first camera, the one whose grey values the tracker compares
    late      the room; the back camera takes its images 15 ms after the front one
    seldom    the room; the back camera stops after a third

Prints for each run: error of the trajectory, PSNR of the held-out frames (of each camera), frames that were lost,
seconds of processor time. Recordings and runs in the folder that are there already are used again.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ggslam.evaluation.images import psnr, unit_range
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.sequences.rig import RigSequence
from ggslam.synthetic import write_synthetic_rig

sys.path.insert(0, str(Path(__file__).parents[2]))

from commands import usage
from held_out import held_out_poses

DARK = 50
LATE_S = 0.015
SCENES = {"room": ("room", "front,back"), "house": ("loop", "front,left"), "corridor": ("corridor", "front,back")}


@dataclass(frozen=True)
class Row:
    """What came of the frames of one camera: its name, ATE in metres, PSNR in dB of so many held-out frames, and frames
    that were lost."""

    name: str
    ate_m: float
    psnr: float
    held_out: int
    lost: int


@dataclass(frozen=True)
class Bench:
    """Where recordings and runs go, and of how many frames of which size they are."""

    folder: Path
    frames: int
    size: tuple[int, int]
    settings: tuple[str, ...]

    def case(self, name: str) -> None:
        """Prints one case."""
        recording = self.recording(name)
        print(f"{name}: {recording}, {self.frames} frames of {self.size[0]}x{self.size[1]} a camera", flush=True)
        if name in SCENES:
            for camera in SCENES[name][1].split(","):
                self.report(camera, recording / camera, f"{name}-{camera}")
        self.report("rig", recording, f"{name}-rig")

    def recording(self, name: str) -> Path:
        """The rig's recording of a case."""
        path = self.folder / "recordings" / name
        if path.is_dir():
            return path
        if name in SCENES or name == "late":
            scene, cameras = SCENES.get(name, SCENES["room"])
            width, height = self.size
            return write_synthetic_rig(
                path, cameras.split(","), frames=self.frames, width=width, height=height, scene=scene,
                delay=LATE_S if name == "late" else 0.0,
            )  # fmt: skip
        room, first = self.recording("room"), max(0, self.frames // 2 - DARK // 2)
        with_change = path.with_name(f".{name}")
        shutil.copytree(room, with_change)
        if name == "seldom":
            for image in with_change.glob("back/*/*.png"):
                if int(image.stem) >= self.frames // 3:
                    image.unlink()
            poses = (with_change / "back" / "poses.txt").read_text().splitlines(keepends=True)
            (with_change / "back" / "poses.txt").write_text("".join(poses[: 1 + self.frames // 3]))
        else:
            darken(with_change / ("back" if name == "dark" else "front"), range(first, first + DARK))
        return with_change.rename(path)

    def report(self, name: str, recording: Path, run: str) -> None:
        """Runs a recording and prints what came of each of its cameras."""
        folder, seconds = self.folder / "runs" / run, float("nan")
        if not (folder / "run.json").is_file():
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            changes = [word for setting in self.settings for word in ("--set", setting)]
            usage(["run", str(recording), "--out", str(folder), "--no-eval", "--overwrite", *changes])
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        timing = RunFolder.open(folder).timing()
        for row in rows_of(folder):
            print(
                f"    {name:6} {row.name:6} ATE {100 * row.ate_m:6.3f} cm   {row.psnr:5.2f} dB of {row.held_out} "
                f"held out   {row.lost} lost", flush=True,
            )  # fmt: skip
        size = f"{timing.gaussians} Gaussians, {timing.mapping.keyframes} keyframes"
        print(f"           {size}, {seconds:.0f} s of processor", flush=True)


def darken(recording: Path, frames: Iterable[int]) -> None:
    """Makes images of a generated recording black, and their depth unknown."""
    for kind in ("rgb", "depth", "masks"):
        for frame in frames:
            path = recording / kind / f"{frame:06d}.png"
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            cv2.imwrite(str(path), np.zeros_like(image))


def rows_of(path: Path) -> list[Row]:
    """What came of a run, camera by camera."""
    folder = RunFolder.open(path)
    sequence, record = open_recording_of(folder), folder.keyframes()
    poses, views = record.poses(), held_out_poses(folder)
    lost = {frame.frame for frame in record.frames if frame.is_lost}
    cameras = dict(enumerate(sequence.rig.names)) if isinstance(sequence, RigSequence) else {0: sequence.name}
    numbers = sequence.places[:, 1].tolist() if isinstance(sequence, RigSequence) else [0] * len(sequence)
    rasterizer, gaussians, scores = CpuRasterizer(), folder.gaussians(), dict[int, list[float]]()
    for index, T_camera_world in views.items():
        frame = sequence.frame(index, masks=False)
        if not frame.depth.any():
            continue
        image = rasterizer.forward(gaussians, frame.camera, T_camera_world, features=False).image.numpy()
        shown = np.clip(image, 0, 1).transpose(1, 2, 0)
        scores.setdefault(numbers[index], []).append(psnr(shown, unit_range(frame.color), frame.depth > 0))
    rows = []
    for number, name in cameras.items():
        own = [i for i in range(len(sequence)) if numbers[i] == number]
        assert sequence.ground_truth is not None
        found = score_trajectory([poses.get(i) for i in own], sequence.ground_truth[own])
        values = scores.get(number, [])
        ate, mean = np.nan if found is None else found.ate_rmse_m, float(np.mean(values)) if values else np.nan
        rows.append(Row(name, ate, mean, len(values), len(lost & set(own))))
    return rows


def main() -> None:
    """Runs the cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for recordings and runs")
    known = [*SCENES, "dark", "black", "late", "seldom"]
    parser.add_argument("--cases", nargs="+", default=known, choices=known)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the runs")
    options = parser.parse_args()
    bench = Bench(options.folder, options.frames, tuple(options.size), tuple(options.set))
    for case in options.cases:
        bench.case(case)


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    main()
