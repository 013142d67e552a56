#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""An hour of a user of the reference encoder: the voxel clouds of runs go through ours and through it, crosswise.

    python scripts/benchmarks/bench_gpcc_exchange.py RUN [RUN ...] [--qp 22]

`points_grid.ply` of each run is coded by `ggslam encode` and by tmc3 of release-v12.9 (GGSLAM_TMC3 names the binary, or
it is on PATH) with the options of docs/formats.md, and each stream is decoded by both. The table has the bytes of
geometry, colours and ids (units' headers included), and for each decoder: whether it gave back the same set of
voxels, colour PSNR of Y, U and V, and whether the object ids came back; in metres where the stream tells the scale. Our
streams tell ids as a reflectance: small ones (up to 255) as they are, others as their ranks.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from gpcc_reference import reference_binary, reference_decode, reference_encode

from ggslam.coding import CodecSettings
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.metrics import color_quality, matching_rows
from ggslam.formats.point_cloud import ColoredCloud, read_point_cloud
from ggslam.formats.point_ply import GRID_FILE, VoxelCloud, read_points
from ggslam.jobs.encode.coding import decode_file, encode_file

COLUMNS = ("run", "points", "encoder", "geometry", "colours", "ids", "decoder", "voxels", "metres", "Y dB", "U dB",
           "V dB", "ids")  # fmt: skip
DOCUMENTED = {"mergeDuplicatedPoints": 1, "trisoupNodeSizeLog2": 0, "neighbourAvailBoundaryLog2": 8}
"""Tools of the reference encoder that docs/formats.md names; the others are as it has them."""


def exchange(run: Path, qp: int, binary: str, folder: Path) -> None:
    """Prints the four rows of a run."""
    source, cloud = run / GRID_FILE, read_points(run / GRID_FILE)
    ours, theirs = folder / "ours.bin", folder / "theirs.bin"
    encode_file(source, ours, CodecSettings(qp=qp))
    reference_encode(binary, source, theirs, qp, tools=DOCUMENTED)
    for encoder, stream in (("ggslam", ours), ("tmc3", theirs)):
        decode_file(stream, folder / "ggslam.ply")
        decoded = {"ggslam": read_point_cloud(folder / "ggslam.ply")}
        decoded["tmc3"], _ = reference_decode(binary, stream, folder / "tmc3.ply")
        for decoder, found in decoded.items():
            cells = [run.name, str(len(cloud.grid)), encoder, *parts(stream), decoder, *compare(cloud, found)]
            print("| " + " | ".join(cells) + " |", flush=True)


def parts(stream: Path) -> list[str]:
    """Bytes of the geometry, of the first attribute of each slice and of the others."""
    sizes, number = [0, 0, 0], 0
    for unit in read_units(stream.read_bytes()):
        if unit.kind is UnitType.GEOMETRY:
            sizes[0] += unit.size
            number = 0
        elif unit.kind is UnitType.ATTRIBUTE:
            number = min(number + 1, 2)
            sizes[number] += unit.size
    return [str(size) if size else "-" for size in sizes]


def compare(cloud: VoxelCloud, decoded: ColoredCloud) -> list[str]:
    """Voxels, metres, PSNR and ids of what was decoded: the last columns."""
    metric = np.abs(decoded.points - np.rint(decoded.points)).max() > 0.01
    points = (decoded.points - cloud.origin) / cloud.voxel_size if metric else decoded.points
    grid = np.rint(points).astype(np.int32)
    rows = matching_rows(cloud.grid, grid)
    if rows is None or decoded.colors is None:
        return [f"{len(grid)} OTHERS", "yes" if metric else "no", "-", "-", "-", "-"]
    quality = color_quality(cloud.colors, decoded.colors[rows])
    exact = "exact" if np.abs(points - grid).max() < 0.01 else "MOVED"
    levels = [f"{value:.2f}" for value in (quality.y, quality.u, quality.v)]
    return [exact, "yes" if metric else "no", *levels, compare_ids(cloud, decoded, rows)]


def compare_ids(cloud: VoxelCloud, decoded: ColoredCloud, rows: np.ndarray) -> str:
    """How the ids came back."""
    if cloud.object_id is not None and "object_id" in decoded.labels:
        return "exact" if np.array_equal(decoded.labels["object_id"][rows], cloud.object_id) else "WRONG"
    if cloud.object_id is None or decoded.reflectance is None:
        return "none"
    number = cloud.object_id if cloud.object_id.max() < 256 else np.unique(cloud.object_id, return_inverse=True)[1]
    return "exact, as reflectance" if np.array_equal(decoded.reflectance[rows], number) else "WRONG"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--qp", type=int, default=22)
    arguments = parser.parse_args()
    binary = reference_binary()
    if binary is None:
        raise SystemExit("set GGSLAM_TMC3 to a tmc3 binary of release-v12.9")
    print(f"QP {arguments.qp}\n\n| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    with tempfile.TemporaryDirectory() as temporary:
        for run in arguments.runs:
            exchange(run, arguments.qp, binary, Path(temporary))


if __name__ == "__main__":
    main()
