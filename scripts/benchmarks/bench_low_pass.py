#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How a run's map looks at other sizes than it was trained at, by our rules and by those of 3D Gaussian Splatting.

    python scripts/benchmarks/bench_low_pass.py runs/kitchen runs/room [--every 1] [--recording FOLDER]

Held-out frames and keyframes are rendered at half, once and twice the size that the run was trained at and compared
with the recording read at that size, over pixels with measured depth. Twice the size needs a run at `--scale 0.5` or
less. Which rules: see `low_pass_at` in ggslam/rendering/types.py and `as_3dgs` of `CpuRasterizer.forward`. --low-pass
adds a column with ours but for another filter. --zoom fits the map to a window of another size, as `ggslam export
--zoom`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from held_out import held_out_poses

from ggslam.evaluation.images import psnr, unit_range
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import low_pass_at
from ggslam.rendering.zoom import ZoomFit
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse

SIZES = (0.5, 1.0, 2.0)
"""Of the images, times that of the run."""
SETS = ("held out", "keyframes")


@dataclass(frozen=True)
class Drawing:
    """Rules to draw by; `low_pass` None: that of the size, see `low_pass_at`."""

    name: str
    low_pass: float | None = None
    as_3dgs: bool = False


OURS, THREE_DGS = Drawing("ours"), Drawing("3DGS", as_3dgs=True)


def views_of(folder: RunFolder, every: int) -> dict[str, dict[int, np.ndarray]]:
    """T_camera_world by frame number of each of `SETS`."""
    record = folder.keyframes()
    poses = {i: inverse(pose) for i, pose in record.poses().items() if i in record.keyframe_numbers()}
    sets = dict(zip(SETS, (held_out_poses(folder), poses), strict=True))
    return {name: dict(sorted(found.items())[::every]) for name, found in sets.items()}


def psnr_at_sizes(
    folder: RunFolder, gaussians: GaussianMap, drawings: tuple[Drawing, ...] = (OURS, THREE_DGS), every: int = 1,
    recording: Path | None = None, sizes: tuple[float, ...] = SIZES,
) -> dict[tuple[float, str, str], float]:  # fmt: skip
    """Mean PSNR in dB of a map of a run against the run's recording.

    Args:
        folder: the run.
        gaussians: its map, or the same map from one of its exports.
        drawings: rules to draw by.
        every: n-th frame of each set.
        recording: where it is, if it was moved.
        sizes: of the images, times that of the run.

    Returns:
        By size, set and name of the rules.
    """
    means: dict[tuple[float, str, str], float] = {}
    scale = folder.sequence().open.scale
    for size in sizes:
        rasterizers = {drawing: CpuRasterizer(low_pass=drawing.low_pass or low_pass_at(size)) for drawing in drawings}
        sequence = open_recording_of(folder, recording, scale=size * scale)
        for name, poses in views_of(folder, every).items():
            found: dict[str, list[float]] = {drawing.name: [] for drawing in drawings}
            for index, pose in poses.items():
                frame = sequence.frame(index, masks=False)
                for drawing, rasterizer in rasterizers.items():
                    found[drawing.name].append(_psnr(rasterizer, gaussians, frame, pose, drawing.as_3dgs))
            means |= {(size, name, rules): float(np.mean(values)) for rules, values in found.items()}
    return means


def _psnr(
    rasterizer: CpuRasterizer, gaussians: GaussianMap, frame: Frame, T_camera_world: np.ndarray, as_3dgs: bool
) -> float:
    view = rasterizer.forward(gaussians, frame.camera, T_camera_world, features=False, as_3dgs=as_3dgs)
    return psnr(view.image.numpy().clip(0, 1).transpose(1, 2, 0), unit_range(frame.color), frame.depth > 0)


def print_titles(drawings: tuple[Drawing, ...]) -> None:
    """The first two lines of the table."""
    titles = [f"{group}, {drawing.name}" for group in SETS for drawing in drawings]
    print("| " + " | ".join(["run", "size", *titles]) + " |\n|" + " --- |" * (2 + len(titles)))


def print_rows(name: str, found: dict[tuple[float, str, str], float], drawings: tuple[Drawing, ...]) -> None:
    """Lines of the table."""
    for size in dict.fromkeys(key[0] for key in found):
        cells = [f"{found[size, group, drawing.name]:.2f}" for group in SETS for drawing in drawings]
        print("| " + " | ".join([name, f"{size:g}x", *cells]) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="folders that `ggslam run` wrote")
    parser.add_argument("--recording", type=Path, help="the recording, if it is not where it was")
    parser.add_argument("--every", type=int, default=1, help="render every n-th frame of each set")
    parser.add_argument("--low-pass", type=float, help="another filter, px^2")
    parser.add_argument("--zoom", type=float, default=1.0, help="fit the map first, as `ggslam export --zoom`")
    options = parser.parse_args()
    other = options.low_pass
    drawings = (OURS, THREE_DGS, *([] if other is None else [Drawing(f"{other:g} px^2", low_pass=other)]))
    print_titles(drawings)
    for run in options.runs:
        folder = RunFolder.open(run)
        gaussians, record = folder.gaussians(), folder.keyframes()
        poses, numbers = record.poses(), record.keyframe_numbers()
        ZoomFit(folder.sequence().camera, [poses[i] for i in poses if i in numbers], options.zoom)(gaussians)
        found = psnr_at_sizes(folder, gaussians, drawings, options.every, options.recording)
        print_rows(run.name, found, drawings)


if __name__ == "__main__":
    main()
