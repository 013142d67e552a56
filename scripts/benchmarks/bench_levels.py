#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How levels of detail look from where they are seen: Gaussians merged in pairs, as streamed SOG has them, merged in
voxels, and the most important ones alone.

    python scripts/benchmarks/bench_levels.py runs/kitchen [--every 4] [--splat-transform "npx splat-transform"]

Viewers of streamed SOG show level 1 from 5 metres on, and each further one from three times as far. Level k is scored
at the middle of where it is seen, 5 * 3^(k - 1/2) metres, on a screen whose focal length is 935 pixels (1080 lines, 60
degrees). Poses are those that the run held out, with the focal length that makes the map there as large as it would be
at that distance: walls do not get in the way. PSNR is against the whole map, drawn by 3DGS's rules (0.3 px^2 are added
to every Gaussian) with four times the pixels a side and averaged, which is what is there to be seen; "as it is" is the
whole map drawn at the size itself. With --splat-transform its `--decimate` to the same numbers is scored, too.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from held_out import held_out_poses
from timing import seconds

from ggslam.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_levels import coarser, merge
from ggslam.formats.streamed_sog import StreamedSogTuning
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

FIRST_DISTANCE, STEP, SCREEN_FOCAL = 5.0, 3.0, 935.0
LOW_PASS, FINER = 0.3, 4
MODEL_LEVELS = (1, 2, 3)


@dataclass(frozen=True)
class View:
    """A pose, and the median depth of what is seen there in metres."""

    T_camera_world: np.ndarray
    depth: float


def map_of(columns: SplatColumns) -> GaussianMap:
    out = GaussianMap(int(columns.sh.shape[1] ** 0.5) - 1, with_moments=False)
    arrays = [torch.from_numpy(a) for a in (columns.means, columns.quaternions, columns.log_scales, columns.logits)]
    rows = out.insert(*arrays, torch.zeros(len(columns), 3))
    out.sh[rows] = torch.from_numpy(columns.sh)
    return out


def draw(gaussians: GaussianMap, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """[H, W, 3], by 3DGS's rules."""
    return CpuRasterizer(low_pass=LOW_PASS).forward(gaussians, camera, pose).image.numpy().transpose(1, 2, 0)


def seen_from(distance: float, camera: Camera, view: View, finer: int = 1) -> Camera:
    factor = SCREEN_FOCAL * view.depth / distance / camera.fx
    small = camera.resize(max(8, round(camera.width * factor)), max(8, round(camera.height * factor)))
    return small.resize(small.width * finer, small.height * finer)


def wanted(whole: GaussianMap, camera: Camera, view: View, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """What is there to be seen from a distance, and what the whole map looks like from there."""
    small = seen_from(distance, camera, view)
    fine = draw(whole, seen_from(distance, camera, view, FINER), view.T_camera_world).clip(0, 1)
    there = cv2.resize(fine, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return there, draw(whole, small, view.T_camera_world).clip(0, 1)


def psnr(
    columns: SplatColumns, camera: Camera, views: list[View], distance: float,
    images: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, float]:  # fmt: skip
    """Against what is there to be seen and against the whole map, means over views, in dB."""
    gaussians, scores = map_of(columns), []
    for view, both in zip(views, images, strict=True):
        found = draw(gaussians, seen_from(distance, camera, view), view.T_camera_world).clip(0, 1)
        scores.append([-10 * np.log10(np.square(found - image).mean() + 1e-12) for image in both])
    there, same = np.mean(scores, 0)
    return float(there), float(same)


def merge_in_voxels(columns: SplatColumns, count: int) -> SplatColumns:
    """Those in a voxel become one; the voxels are as small as gives at most so many."""
    offsets = (columns.means - columns.means.min(0)).astype(np.float64)
    small, large = 0.0, 2 * float(offsets.max())
    groups = np.zeros(len(columns), np.int64)
    for _ in range(24):
        edge = (small + large) / 2
        tried = np.unique(np.floor(offsets / edge), axis=0, return_inverse=True)[1].reshape(-1)
        if tried.max() < count:
            large, groups = edge, tried
        else:
            small = edge
    return merge(columns, groups)


def most_important(columns: SplatColumns, count: int) -> SplatColumns:
    """Those that hide most, enlarged to hide together what all did."""
    s = np.exp(columns.log_scales)
    hidden = (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0]) / (1 + np.exp(-columns.logits))
    kept = np.sort(np.argsort(-hidden, kind="stable")[:count])
    out = columns.take(kept)
    out.log_scales[:] += 0.5 * np.log(hidden.sum() / hidden[kept].sum())
    return out


def decimate(command: str, gaussians: GaussianMap, count: int) -> SplatColumns:
    """What splat-transform makes of a map."""
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "map.ply", Path(folder) / "few.ply"
        write_gaussian_ply(source, gaussians)
        words = [*shlex.split(command), "-w", "-g", "cpu", str(source), "--decimate", str(count), str(out)]
        subprocess.run(words, check=True, capture_output=True)
        return SplatColumns.of(out, read_gaussian_ply(out))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `ggslam run` wrote")
    parser.add_argument("--every", type=int, default=4, help="score every n-th held-out pose")
    parser.add_argument("--splat-transform", metavar="COMMAND", help="compare with its --decimate")
    options = parser.parse_args()
    folder = RunFolder.open(options.run)
    whole, camera = folder.gaussians(), folder.sequence().camera
    columns = SplatColumns.of(options.run, whole)
    views = []
    for pose in list(held_out_poses(folder).values())[:: options.every]:
        z = columns.means @ pose[2, :3] + pose[2, 3]
        u = (columns.means @ pose[0, :3] + pose[0, 3]) / np.maximum(z, 1e-6) * camera.fx
        seen = (z > 0.1) & (np.abs(u) < camera.width / 2)
        views.append(View(pose, float(np.median(z[seen]))))
    methods: dict[str, Callable[[int], SplatColumns]] = {
        "as it is": lambda count: columns, "merged in pairs": lambda count: coarser(columns, count),
        "merged in voxels": lambda count: merge_in_voxels(columns, count),
        "most important": lambda count: most_important(columns, count),
    }  # fmt: skip
    if options.splat_transform:
        methods["splat-transform"] = lambda count: decimate(options.splat_transform, whole, count)
    print(f"{options.run}: {len(columns)} Gaussians, {len(views)} views, median depth {views[0].depth:.2f} m\n")
    print("| level | distance m | method | Gaussians | PSNR dB | against all Gaussians dB | seconds |")
    print("|" + " --- |" * 7)
    for level in MODEL_LEVELS:
        distance = FIRST_DISTANCE * STEP ** (level - 0.5)
        count = -(-len(columns) // StreamedSogTuning.level_ratio**level)
        images = [wanted(whole, camera, view, distance) for view in views]
        for name, method in methods.items():
            few = method(count)
            time = min(seconds(lambda m=method, n=count: m(n), 1))
            there, same = psnr(few, camera, views, distance, images)
            scores = f"{there:.2f} | {same:.2f}"
            print(f"| {level} | {distance:.1f} | {name} | {len(few)} | {scores} | {time:.2f} |", flush=True)


if __name__ == "__main__":
    main()
