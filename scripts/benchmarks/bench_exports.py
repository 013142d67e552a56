#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What `ggslam export` makes of runs, format by format: bytes, time, what viewers of others show, object ids.

    ggslam run livingroom --scale 0.5 --stop 100 --out runs/livingroom
    python scripts/benchmarks/bench_exports.py runs/livingroom [--every 1] [--check]

Every format is written as `ggslam export --format` does it; its time is that of all processors together, without
starting Python. Splat formats are read back as tests/conformance reads them, by the descriptions of the formats, and
the frames that the run held out are rendered by the rules of 3D Gaussian Splatting: 0.3 px^2 of low-pass, nothing
nearer than 0.2 m, no colours below 0. "vs map" is against the map of the run rendered so, over all pixels, at half,
once and twice the size of the run's images; "by ggslam" is the same at once the size of what ggslam's own readers find
in the file; "vs recording" is against the frames, over pixels with measured depth, as `ggslam eval` scores. The first
line is the map by ggslam's own rules. "ids": whether every Gaussian has the object id that it has in the run.

Pictures come from ggslam's rasterizer with that low-pass, which differs from 3DGS in two rules (it draws the Gaussian
that makes a pixel opaque, and lets one cover 0.999 of it, not 0.99); --check prints how far it is from the tests' own
renderer, which keeps all of them, on the first view, which takes seconds to minutes.

At the end, the runs' maps at half, once and twice their size, as `scripts/benchmarks/bench_low_pass.py` prints them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(1, str(Path(__file__).parents[2] / "tests" / "conformance"))

import numpy as np
from bench_low_pass import OURS, THREE_DGS, print_rows, print_titles, psnr_at_sizes
from foreign_readers import by_usd_core
from held_out import held_out_poses
from scipy.spatial import cKDTree
from splat_formats import SPLAT_FORMATS, SplatFormat
from splat_maps import Splats
from splat_rendering import Pinhole, decibels, render
from standard_pictures import standard_picture

from ggslam.errors import GgslamError
from ggslam.evaluation.images import psnr, unit_range
from ggslam.formats.splat_formats import read_splats
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.export.formats import ExportFormat
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.frame import Frame

SIZES = (0.5, 1.0, 2.0)
"""Of the pictures, times that of the run's images."""
COLUMNS = (
    "format", "bytes", "bytes/Gaussian", "write, CPU s", *(f"dB vs map, {size:g}x" for size in SIZES), "by ggslam",
    "dB vs recording", "ids",
)  # fmt: skip
FORMATS = SPLAT_FORMATS | {
    "usd": replace(SPLAT_FORMATS["usd"], suffix=".usdc", read=lambda path: by_usd_core(path, path.parent))
}
"""Of the files that splats are written to; OpenUSD's binary one is smaller than text."""
SUFFIXES = {"pcd": ".pcd", "mesh": ".ply", "trajectory": ".txt"}
"""Of the files that are no splats; other formats are folders."""


@dataclass(frozen=True)
class View:
    """A held-out frame with its pose as the run estimated it, and what the map shows there by the rules of 3DGS."""

    frame: Frame
    T_camera_world: np.ndarray
    of_map: np.ndarray


def held_out_views(folder: RunFolder, recording: Path | None, every: int, splats: Splats) -> list[View]:
    """The frames that the run never trained on; of a run that held out none, those that are no keyframes."""
    poses, sequence = held_out_poses(folder), open_recording_of(folder, recording)
    views = []
    for index in list(poses)[::every]:
        frame = sequence.frame(index, masks=False)
        views.append(View(frame, poses[index], standard_picture(splats, frame.camera, poses[index])))
    return views


def against_recording(views: list[View], images: list[np.ndarray]) -> float:
    """Mean dB over pixels with measured depth."""
    found = [psnr(unit_range(image), unit_range(view.frame.color), view.frame.depth > 0)
             for view, image in zip(views, images, strict=True)]  # fmt: skip
    return float(np.nanmean(found))


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    return sum(p.stat().st_size for p in ([path] if path.is_file() else path.rglob("*")) if p.is_file())


def line(
    folder: RunFolder, kind: str, plain: bool, views: list[View], original: Splats, out: Path
) -> list[str]:  # fmt: skip
    """The cells of a format."""
    known = FORMATS.get(kind)
    path = out / f"map{known.suffix if known else SUFFIXES.get(kind, '')}"
    start = time.process_time()
    try:
        export_run(folder, path, kind, plain=plain)
    except GgslamError as error:
        return [kind, f"not written: {error}", *[""] * (len(COLUMNS) - 2)]
    seconds = time.process_time() - start
    size = size_of(path)
    cells = [f"{kind} --plain" if plain else kind, f"{size}", f"{size / len(original.means):.2f}", f"{seconds:.2f}"]
    if known is None:
        return [*cells, *[""] * (len(COLUMNS) - len(cells))]
    seen = known.read(path)
    ids = kept(seen, original, known.turn)
    if known.recolored:
        return [*cells, *[""] * (len(COLUMNS) - len(cells) - 1), ids]
    ours = Splats.of(read_splats(path / "lod-meta.json" if path.is_dir() else path))
    read_by_us = decibels(pictures(ours, views), pictures(original, views))
    same = [decibels(pictures(seen, views, size, known), pictures(original, views, size)) for size in SIZES]
    images = pictures(seen, views, known=known)
    scores = [f"{value:.1f}" for value in (*same, read_by_us)]
    return [*cells, *scores, f"{against_recording(views, images):.2f}", ids]


def pictures(
    splats: Splats, views: list[View], size: float = 1.0, known: SplatFormat | None = None
) -> list[np.ndarray]:
    """What Gaussians look like in the views at a size; in the axes of a format where one is given."""
    found = []
    for view in views:
        whole = view.frame.camera
        camera = whole.resize(round(size * whole.width), round(size * whole.height))
        pose = view.T_camera_world if known is None else known.pose(view.T_camera_world)
        found.append(standard_picture(splats, camera, pose))
    return found


def kept(seen: Splats, original: Splats, turn: np.ndarray) -> str:
    """How many of the object ids are there, for people."""
    if seen.object_ids is None:
        return "no"
    rows = cKDTree(seen.means @ turn).query(original.means)[1]
    right = float((seen.object_ids[rows] == original.object_ids).mean())
    return "yes" if right == 1 and len(seen.means) == len(original.means) else f"{100 * right:.2f} %"


def check(splats: Splats, view: View) -> None:
    """Prints how far the rasterizer is from the tests' renderer on a view."""
    camera = Pinhole(**{name: getattr(view.frame.camera, name) for name in Pinhole.__dataclass_fields__})
    expected = render(splats, camera, view.T_camera_world)
    error = np.abs(view.of_map - expected.clip(0, 1))
    found = psnr(view.of_map.astype(float), expected.clip(0, 1))
    print(f"rasterizer against the tests' renderer, one view: {found:.1f} dB, at most {error.max():.3f}\n")


def bench(run: Path, arguments: argparse.Namespace) -> None:
    """Prints the table of a run."""
    folder = RunFolder.open(run)
    gaussians = folder.gaussians()
    original = Splats.of(gaussians)
    views = held_out_views(folder, arguments.recording, arguments.every, original)
    print(f"{run}: {len(gaussians)} Gaussians of SH degree {gaussians.sh_degree}, {len(views)} held-out views of "
          f"{views[0].frame.camera.width}x{views[0].frame.camera.height}\n")  # fmt: skip
    if arguments.check:
        check(original, views[0])
    print("| " + " | ".join(COLUMNS) + " |\n|" + " --- |" * len(COLUMNS))
    own = CpuRasterizer()
    images = [own.forward(gaussians, v.frame.camera, v.T_camera_world).image.numpy().transpose(1, 2, 0).copy()
              for v in views]  # fmt: skip
    blank = " |" * (len(COLUMNS) - 3)
    print(f"| the map by ggslam's rules |{blank} {against_recording(views, images):.2f} | |")
    wanted = arguments.formats or [kind.value for kind in ExportFormat]
    for kind, plain in [(name, plain) for name in wanted for plain in ([True, False] if name == "ply" else [False])]:
        with tempfile.TemporaryDirectory() as out:
            print("| " + " | ".join(line(folder, kind, plain, views, original, Path(out))) + " |", flush=True)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="folders that `ggslam run` wrote")
    parser.add_argument("--recording", type=Path, help="the recording, if it is not where it was")
    parser.add_argument("--every", type=int, default=1, help="render every n-th held-out frame")
    parser.add_argument("--formats", nargs="+", metavar="FORMAT", help="only these")
    parser.add_argument("--check", action="store_true", help="hold the rasterizer against the tests' renderer")
    arguments = parser.parse_args()
    for run in arguments.runs:
        bench(run, arguments)
    print("\nPSNR against the recording at other sizes than the run's, dB:\n")
    print_titles((OURS, THREE_DGS))
    for folder in (RunFolder.open(run) for run in arguments.runs):
        sizes = (0.5, 1.0, 2.0) if folder.sequence().open.scale <= 0.5 else (0.5, 1.0)
        found = psnr_at_sizes(
            folder, folder.gaussians(), every=arguments.every, recording=arguments.recording, sizes=sizes
        )
        print_rows(folder.path.name, found, (OURS, THREE_DGS))


if __name__ == "__main__":
    main()
