#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What coding a run's map costs, in bytes and in pictures: the splat preset at every rate, and SPZ.

    python scripts/benchmarks/bench_splats.py runs/kitchen [--every 1] [--recording FOLDER]

The frames that the run held out are rendered from the map as it is and as it comes back from the stream. "vs original"
compares the two renderings over all pixels; "vs recording" compares a rendering with the recorded frame over pixels
with measured depth, as `ggslam eval` does. Times are without files, except those of SPZ, which gsply can only write to
a file. Object ids must come back exactly, or the script stops; SPZ has no place for them. Identity vectors are in the
run's map.ply, but in no stream.

SPZ (Niantic; version 3, gzip) is written and read by gsply: pip install 'ggslam[formats]'. Without it its line is
left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from held_out import held_out_poses
from timing import seconds

from ggslam.coding import CodecSettings, CodingReport, EncodedCloud, decode_cloud, encode_cloud
from ggslam.coding.splats import (
    RATES,
    gaussians_of,
    means_of,
    rest_range,
    splat_attributes,
    splat_reach,
    splat_settings,
)
from ggslam.evaluation.image_sets import ImageScoreMean
from ggslam.evaluation.images import score_image
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

PARTS = ("positions", "sh_0", "sh rest", "opacity", "scale", "rotation", "object ids", "side")
COLUMNS = ("format", "bytes", "of PLY", "bytes/Gaussian", *PARTS, "PSNR vs original", "SSIM vs original",
           "PSNR vs recording", "SSIM vs recording", "encode s", "decode s")  # fmt: skip


@dataclass(frozen=True)
class Coded:
    """A map that was coded and decoded again."""

    name: str
    total_bytes: int
    parts: dict[str, int]
    gaussians: GaussianMap
    encode_s: float
    decode_s: float


@dataclass(frozen=True)
class View:
    """A held-out frame with its pose as the run estimated it, and what the original map shows there."""

    frame: Frame
    T_camera_world: np.ndarray
    original: np.ndarray


def held_out_views(folder: RunFolder, recording: Path | None, every: int, gaussians: GaussianMap) -> list[View]:
    """The frames that the run never trained on; of a run that held out none, those that are no keyframes."""
    poses, sequence = held_out_poses(folder), open_recording_of(folder, recording)
    views = []
    for index in list(poses)[::every]:
        frame = sequence.frame(index, masks=False)
        views.append(View(frame, poses[index], rendering(gaussians, frame, poses[index])))
    return views


def rendering(gaussians: GaussianMap, frame: Frame, T_camera_world: np.ndarray) -> np.ndarray:
    """What the map shows of a frame, [H, W, 3]."""
    image = CpuRasterizer().forward(gaussians, frame.camera, T_camera_world).image
    return image.numpy().clip(0, 1).transpose(1, 2, 0)


def quality(views: list[View], gaussians: GaussianMap) -> list[str]:
    """Cells: PSNR and SSIM against the original's renderings, and against the recording."""
    original, recorded = ImageScoreMean(), ImageScoreMean()
    for view in views:
        image = rendering(gaussians, view.frame, view.T_camera_world)
        original.add(score_image(image, None, view.original, view.frame.depth))
        recorded.add(score_image(image, None, view.frame.color, view.frame.depth))
    same, real = original.mean(), recorded.mean()
    return [f"{same.psnr_unmasked:.2f}", f"{same.ssim_unmasked:.4f}", f"{real.psnr:.3f}", f"{real.ssim:.4f}"]


def through_gpcc(gaussians: GaussianMap, rate: str, repeats: int) -> Coded:
    """Codes a map at a rate; stops the script if an object id changed."""
    points = means_of(gaussians)

    def encode() -> EncodedCloud:
        rest = rest_range([gaussians])
        attributes = splat_attributes(gaussians, rest=rest)
        settings = splat_settings(CodecSettings(), rate, attributes, rest)
        return encode_cloud(
            points, attributes, splat_reach(lambda: [gaussians], len(gaussians), settings, rate).settings
        )

    encoded = encode()
    cloud = decode_cloud(encoded.data)
    if not np.array_equal(
        sorted_rows(cloud.quantization.apply(points), gaussians), sorted_rows(cloud.grid_points, gaussians_of(cloud))
    ):
        raise SystemExit(f"{rate}: the decoded Gaussians do not have the positions and object ids that were coded")
    encode_s = min(seconds(encode, repeats))
    decode_s = min(seconds(lambda: gaussians_of(decode_cloud(encoded.data)), repeats))
    return Coded(rate, len(encoded.data), parts_of(encoded.report), gaussians_of(cloud), encode_s, decode_s)


def sorted_rows(grid: np.ndarray, gaussians: GaussianMap) -> np.ndarray:
    """Voxels and object ids [N, 4] in an order that depends on nothing else, as Gaussians may share a voxel."""
    rows = np.column_stack([grid, gaussians.object_id.numpy()])
    return rows[np.lexsort(rows.T)]


def parts_of(report: CodingReport) -> dict[str, int]:
    """Bytes by kind of parameter; what is left are parameter sets, names and corrections of ids."""
    kinds = {"sh_0": "sh_0", "opacity": "opacity", "scale": "scale", "rotation": "rotation", "rotation_w": "rotation",
             "object_id": "object ids"}  # fmt: skip
    parts = dict.fromkeys(PARTS, 0)
    parts["positions"] = report.geometry_bytes
    for name, size in report.attribute_bytes.items():
        parts[kinds.get(name, "sh rest")] += size
    parts["side"] = report.total_bytes - sum(parts.values())
    return parts


def through_spz(gaussians: GaussianMap, folder: Path, repeats: int) -> Coded:
    """Writes a map as SPZ and reads it again."""
    import gsply

    path = str(folder / "map.spz")
    quaternions = torch.nn.functional.normalize(gaussians.quaternions, dim=1)
    means, scales, quats, opacities, sh0, higher = (
        np.ascontiguousarray(values.numpy())
        for values in (gaussians.means, gaussians.log_scales, quaternions, gaussians.opacity_logits,
                       gaussians.sh[:, 0], gaussians.sh[:, 1:])
    )  # fmt: skip
    data = gsply.GSData(means, scales, quats, opacities, sh0, higher)
    gsply.write_spz(path, data)
    read = gsply.read_spz(path)
    out = GaussianMap(gaussians.sh_degree, with_moments=False)
    rows = out.insert(
        torch.tensor(read.means), torch.tensor(read.quats), torch.tensor(read.scales), torch.tensor(read.opacities),
        torch.zeros(len(read.means), 3),
    )  # fmt: skip
    out.sh[rows, 0] = torch.tensor(read.sh0)
    if gaussians.sh_degree:
        out.sh[rows, 1:] = torch.tensor(read.shN).reshape(len(out), -1, 3)
    encode_s = min(seconds(lambda: gsply.write_spz(path, data), repeats))
    decode_s = min(seconds(lambda: gsply.read_spz(path), repeats))
    return Coded("SPZ", Path(path).stat().st_size, {}, out, encode_s, decode_s)


def plain_bytes(gaussians: GaussianMap, folder: Path) -> int:
    """Of the map as 3DGS PLY with object ids, without identity vectors."""
    path = folder / "plain.ply"
    write_gaussian_ply(path, gaussians, ("object_id",) if gaussians.object_id.any() else ())
    return path.stat().st_size


def show(coded: Coded, views: list[View], plain: int) -> None:
    """Prints a line of the table."""
    count = len(coded.gaussians)
    sizes = [f"{coded.total_bytes}", f"{coded.total_bytes / plain:.4f}", f"{coded.total_bytes / count:.2f}"]
    parts = [f"{coded.parts[part]}" if coded.parts else "" for part in PARTS]
    times = [f"{coded.encode_s:.3f}" if coded.encode_s else "", f"{coded.decode_s:.3f}" if coded.decode_s else ""]
    print("| " + " | ".join([coded.name, *sizes, *parts, *quality(views, coded.gaussians), *times]) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `ggslam run` wrote")
    parser.add_argument("--recording", type=Path, help="the recording, if it is not where it was")
    parser.add_argument("--every", type=int, default=1, help="render every n-th held-out frame")
    parser.add_argument("--repeats", type=int, default=3, help="the best of so many times is shown")
    options = parser.parse_args()
    folder = RunFolder.open(options.run)
    gaussians = folder.gaussians()
    views = held_out_views(folder, options.recording, options.every, gaussians)
    with tempfile.TemporaryDirectory() as temporary:
        plain = plain_bytes(gaussians, Path(temporary))
        print(f"{options.run}: {len(gaussians)} Gaussians of SH degree {gaussians.sh_degree}, "
              f"{len(np.unique(gaussians.object_id))} object ids, {len(views)} views; "
              f"map.ply {(folder.path / 'map.ply').stat().st_size} bytes\n")  # fmt: skip
        print("| " + " | ".join(COLUMNS) + " |\n|" + " --- |" * len(COLUMNS))
        show(Coded("PLY", plain, {}, gaussians, 0, 0), views, plain)
        for rate in RATES:
            show(through_gpcc(gaussians, rate, options.repeats), views, plain)
        if importlib.util.find_spec("gsply") is None:
            print("\nSPZ is not compared: gsply is not installed (pip install 'ggslam[formats]')")
        else:
            show(through_spz(gaussians, Path(temporary), options.repeats), views, plain)


if __name__ == "__main__":
    main()
