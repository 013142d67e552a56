#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What the G-PCC codec costs, in one slice and in four: time, speed per core, size; and what it has in common with the
reference software.

    python scripts/bench_gpcc.py [--qp 10 22] [--repeats 3] [--every 1] [--sparse CLOUD ...] [--golden FOLDER]

Clouds of about a million points: each recording is back-projected with its true poses and voxelised at 10 bits, one
point per voxel with the mean colour. Voxels with the fewest measurements, which are noise, are dropped until one slice
can hold the cloud (1.1 million points). Times are the best of the repeats, which take turns; ratios and overheads are
to one slice coded by one thread in the same run. Nothing else should run on the machine.

With --golden, streams of the reference encoder are decoded and compared, and its payloads with ours. Sparse clouds are
coded with and without planes. If GGSLAM_TMC3 names a tmc3 binary of release-v12.9, or one is on PATH, streams are
checked against it both ways, and both encoders code the same cloud by turns, on one core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from timing import seconds

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.metrics import color_quality, matching_rows
from ggslam.coding.settings import LEVEL_LIMIT, Split
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.native.loader import available_processors
from ggslam.sequences import open_sequence
from ggslam.sequences.sequence import Sequence

BITS = 10
SPLITS: tuple[Split, ...] = ("count", "interval")
LAYOUTS = [(1, SPLITS[0], 1), *((4, split, threads) for split in SPLITS for threads in (1, 2, 4))]
"""Slices, how they are cut, threads; the first is what the others are compared with."""
COLUMNS = ("cloud, QP", "slices", "threads", "bytes", "overhead", "bits/point", "encode s", "M points/s/core", "ratio",
           "decode s", "ratio", "Y dB")  # fmt: skip


@dataclass(frozen=True)
class Cloud:
    """A voxelised recording: grid int32 [N, 3], colours uint8 [N, 3]."""

    name: str
    grid: np.ndarray
    colors: np.ndarray


def world_points(sequence: Sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] in world coordinates and colours [N, 3] of a frame; none if its pose is not known."""
    frame = sequence.frame(index, masks=False)
    if frame.T_world_camera is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    seen = frame.depth > 0
    points = frame.camera.back_project(frame.depth)[seen]
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3], frame.color[seen]


def voxelised(path: Path, every: int) -> Cloud:
    """Back-projects a recording and averages the colours in each voxel."""
    sequence = open_sequence(path, stride=every)
    extents = []
    for index in range(len(sequence)):
        points, _ = world_points(sequence, index)
        if len(points):
            extents.append((points.min(0), points.max(0)))
    low, high = np.min([e[0] for e in extents], 0), np.max([e[1] for e in extents], 0)
    scale = ((1 << BITS) - 1) / (high - low).max()
    keys, sums = np.empty(0, np.int64), np.empty((0, 4), np.int64)
    for index in range(len(sequence)):
        points, colors = world_points(sequence, index)
        grid = np.floor((points - low) * scale).astype(np.int64)
        key = grid[:, 0] << 2 * BITS | grid[:, 1] << BITS | grid[:, 2]
        keys, sums = merged(np.append(keys, key), np.concatenate([sums, np.insert(colors.astype(np.int64), 3, 1, 1)]))
    counts = np.sort(sums[:, 3])
    if len(counts) > LEVEL_LIMIT:
        enough = sums[:, 3] > counts[-LEVEL_LIMIT - 1]
        keys, sums = keys[enough], sums[enough]
    limit = (1 << BITS) - 1
    grid = np.stack([keys >> 2 * BITS, keys >> BITS & limit, keys & limit], 1).astype(np.int32)
    return Cloud(path.name, grid, np.rint(sums[:, :3] / sums[:, 3:]).astype(np.uint8))


def merged(keys: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of equal key added up."""
    order = np.argsort(keys, kind="stable")
    keys, sums = keys[order], sums[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    return keys[starts], np.add.reduceat(sums, starts)


def bench(cloud: Cloud, qp: int, repeats: int) -> None:
    """Prints the lines of one cloud at one quantiser parameter."""
    layouts = [CodecSettings(qp=qp, slices=n, split=split, threads=threads) for n, split, threads in LAYOUTS]
    colors = {"color": cloud.colors}
    coded = [encode_cloud(cloud.grid, colors, settings) for settings in layouts]
    encode_s, decode_s = np.full((2, len(layouts)), np.inf)
    for _ in range(repeats):  # by turns, so that a slow moment of the machine hits no layout alone
        for i, settings in enumerate(layouts):
            encode_s[i] = min(encode_s[i], *seconds(partial(encode_cloud, cloud.grid, colors, settings), 1))
            decode_s[i] = min(decode_s[i], *seconds(partial(decode_cloud, coded[i].data, settings.threads), 1))
    for settings, encoded, encode, decode in zip(layouts, coded, encode_s, decode_s, strict=True):
        quality, size = decoded_quality(cloud, encoded.data), len(encoded.data)
        slices, threads = len(encoded.report.slices), settings.threads or available_processors()
        cores = min(threads, available_processors(), slices)
        cells = [
            f"{cloud.name}, {qp}", f"{slices} {settings.split if slices > 1 else ''}", f"{threads}", f"{size}",
            f"{100 * (size / len(coded[0].data) - 1):+.2f} %", f"{8 * size / len(cloud.grid):.3f}",
            f"{encode:.3f}", f"{len(cloud.grid) / encode / cores / 1e6:.2f}", f"{encode / encode_s[0]:.2f}",
            f"{decode:.3f}", f"{decode / decode_s[0]:.2f}", f"{quality:.2f}",
        ]  # fmt: skip
        print("| " + " | ".join(cells) + " |", flush=True)


def decoded_quality(cloud: Cloud, data: bytes) -> float:
    """PSNR of luma, dB, after checking that the points are those that were coded."""
    decoded = decode_cloud(data)
    rows = matching_rows(cloud.grid, np.rint(decoded.points).astype(np.int32))
    if rows is None:
        raise SystemExit(f"{cloud.name}: the decoded points are not those that were coded")
    return color_quality(cloud.colors, decoded.attributes["color"][rows]).y


def golden_streams(folder: Path) -> None:
    """Prints how many streams of the reference encoder decode exactly, and whether its payloads are ours."""
    exact, names = 0, json.loads((folder / "golden_more" / "manifest.json").read_text())
    for name, about in names.items():
        exact += digest_of((folder / "golden_more" / f"{name}.bin").read_bytes()) == about["sha256"]
    small = sorted((folder / "golden").glob("*_*.bin"))
    for path in small:
        cloud, wanted = decode_cloud(path.read_bytes()), np.load(path.with_suffix(".npz"))
        exact += same_rows(cloud.points, cloud.attributes["color"], wanted["points"], wanted["colors"])
    print(f"\nstreams of the reference encoder that decode exactly: {exact} of {len(names) + len(small)}")
    source = np.load(folder / "golden" / "source.npz")
    for name, qp, offset in (("full_qp10", 10, 0), ("full_qp28", 28, -1)):
        settings = CodecSettings(qp=qp, chroma_offset=offset)
        ours = payloads(encode_cloud(source["points"], {"color": source["colors"]}, settings).data)
        theirs = payloads((folder / "golden" / f"{name}.bin").read_bytes())
        same = [a == b for a, b in zip(ours, theirs, strict=True)]
        print(f"{name}: payloads equal the reference's: geometry {same[0]}, colours {same[1]}")


def digest_of(data: bytes) -> str:
    """SHA-256 of the decoded rows, sorted by all columns."""
    cloud = decode_cloud(data)
    columns = [np.rint(cloud.points), *(values.reshape(len(cloud), -1) for values in cloud.attributes.values())]
    rows = np.concatenate([np.asarray(column, "<i4") for column in columns], 1)
    return hashlib.sha256(rows[np.lexsort(rows.T[::-1])].tobytes()).hexdigest()


def payloads(data: bytes) -> tuple[bytes, bytes]:
    """Geometry and attribute units of a stream of one slice; of the former what follows the header's counters."""
    units = {unit.kind: bytes(unit.payload) for unit in read_units(data)}
    return units[UnitType.GEOMETRY][3:], units[UnitType.ATTRIBUTE]


def sparse_cloud(path: Path) -> None:
    """Prints bits a point of the geometry of a cloud in metres, with and without planes."""
    points = read_point_cloud(path).points
    for voxel_size in (0.001, 0.01, 0.05):
        bits = []
        for planes in (False, True, None):
            report = encode_cloud(points, {}, CodecSettings(voxel_size=voxel_size, planes=planes)).report
            bits.append(8 * report.geometry_bytes / report.points)
        gain = 100 * (bits[1] / bits[0] - 1)
        print(
            f"{path.name}, voxels of {voxel_size} m: {bits[0]:.2f} bits a point, "
            f"with planes {bits[1]:.2f} ({gain:+.1f} %), chosen {bits[2]:.2f}"
        )


def dropped_coefficients(cloud: Cloud) -> None:
    """Prints the rate at equal luma PSNR with coefficients dropped (the default) against none dropped: Bjontegaard."""
    curves = []
    for rdoq in (0.0, 1.0):
        curve = []
        for qp in (16, 22, 28, 34, 40):
            data = encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp, rdoq=rdoq)).data
            sizes = {unit.kind: unit.size for unit in read_units(data)}
            curve.append((decoded_quality(cloud, data), np.log(sizes[UnitType.ATTRIBUTE])))
        curves.append(np.array(curve))
    low, high = max(c[:, 0].min() for c in curves), min(c[:, 0].max() for c in curves)
    areas = []
    for curve in curves:
        primitive = np.polyint(np.polyfit(curve[:, 0], curve[:, 1], 3))
        areas.append(np.polyval(primitive, high) - np.polyval(primitive, low))
    rate = 100 * (np.exp((areas[1] - areas[0]) / (high - low)) - 1)
    print(f"{cloud.name}: coefficients dropped as the reference encoder does: BD-rate of the colours {rate:+.2f} %")


def tmc3_binary() -> str | None:
    """The reference software, if the machine has it."""
    return os.environ.get("GGSLAM_TMC3") or shutil.which("tmc3")


def cross_check(cloud: Cloud, qp: int, binary: str) -> None:
    """Our stream through the reference decoder, the reference encoder's through ours; prints both outcomes."""
    encoded = encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp, slices=4), reconstruct=True)
    assert encoded.reconstruction is not None
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "ours.bin").write_bytes(encoded.data)
        start = time.perf_counter()
        run_tmc3(binary, mode=1, compressedStreamPath=folder / "ours.bin", reconstructedDataPath=folder / "ours.ply",
                 outputBinaryPly=1, convertPlyColourspace=1)  # fmt: skip
        theirs = read_point_cloud(folder / "ours.ply")
        decoder_s = time.perf_counter() - start
        mine = encoded.reconstruction
        same = same_rows(mine.points, mine.attributes["color"], theirs.points, theirs.colors)
        print(f"{cloud.name}, QP {qp}: tmc3 decodes our stream {'exactly' if same else 'WRONGLY'} ({decoder_s:.2f} s)")
        write_point_cloud(folder / "in.ply", cloud.grid.astype(np.float32), {"color": cloud.colors})
        start = time.perf_counter()
        run_tmc3(binary, **_options(folder, qp))
        encoder_s = time.perf_counter() - start
        data, wanted = (folder / "theirs.bin").read_bytes(), read_point_cloud(folder / "theirs.ply")
        mine = decode_cloud(data)
        same = same_rows(mine.points, mine.attributes["color"], wanted.points, wanted.colors)
        print(
            f"{cloud.name}, QP {qp}: we decode tmc3's stream {'exactly' if same else 'WRONGLY'} "
            f"({len(data)} bytes, encoded in {encoder_s:.2f} s)"
        )


def by_turns(cloud: Cloud, qp: int, binary: str, repeats: int) -> None:
    """Both encoders on one core, one slice: the reference's own user time against ours."""
    ours, theirs = [], []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_point_cloud(folder / "in.ply", cloud.grid.astype(np.float32), {"color": cloud.colors})
        for _ in range(repeats):
            settings = CodecSettings(qp=qp, threads=1)
            ours += seconds(partial(encode_cloud, cloud.grid, {"color": cloud.colors}, settings), 1)
            said = run_tmc3(binary, **_options(folder, qp))
            theirs.append(float(re.findall(r"Processing time \(user\): ([0-9.]+)", said)[-1]))
    rates = [len(cloud.grid) / min(times) / 1e6 for times in (ours, theirs)]
    print(
        f"{cloud.name}, QP {qp}, by turns on one core: ours {rates[0]:.2f}, tmc3 {rates[1]:.2f} million points/s, "
        f"ratio {rates[0] / rates[1]:.2f}"
    )


def _options(folder: Path, qp: int) -> dict[str, object]:
    """Of the reference encoder, for the tools that ours uses on dense clouds."""
    return {
        "mode": 0, "uncompressedDataPath": folder / "in.ply", "compressedStreamPath": folder / "theirs.bin",
        "reconstructedDataPath": folder / "theirs.ply", "outputBinaryPly": 1, "positionQuantizationScale": 1,
        "trisoupNodeSizeLog2": 0, "mergeDuplicatedPoints": 1, "neighbourAvailBoundaryLog2": 8,
        "adjacentChildContextualization": 1, "intra_pred_max_node_size_log2": 6, "inferredDirectCodingMode": 0,
        "qtbtEnabled": 0, "planarEnabled": 0, "convertPlyColourspace": 1, "colourMatrix": 1, "transformType": 0,
        "qp": qp, "qpChromaOffset": 0, "bitdepth": 8, "attribute": "color",
    }  # fmt: skip


def same_rows(points: np.ndarray, colors: np.ndarray, others: np.ndarray, other_colors: np.ndarray | None) -> bool:
    """Whether two clouds are the same set of points and colours."""
    if other_colors is None:
        return False
    rows = [np.column_stack([np.rint(p).astype(np.int32), c]) for p, c in ((points, colors), (others, other_colors))]
    return matching_rows(rows[0], rows[1]) is not None


def run_tmc3(binary: str, **options: object) -> str:
    """Runs the reference software and returns what it says; `attribute` has to be its last option."""
    done = subprocess.run(
        [binary, *(f"--{name}={value}" for name, value in options.items())], capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"{binary} failed:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def main() -> None:
    """Prints the table."""
    data = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", nargs="*", type=Path, default=[data / "livingroom", data / "redkitchen"])
    parser.add_argument("--qp", nargs="*", type=int, default=[10, 22])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--every", type=int, default=1, help="every n-th frame only")
    gpcc = data.parent / "gpcc"
    parser.add_argument("--golden", type=Path, default=gpcc if gpcc.is_dir() else None, help="streams of the reference")
    clouds_folder = data / "clouds"
    sparse = [clouds_folder / "scan_pair" / "source.ply", clouds_folder / "b9_training.ply"]
    parser.add_argument("--sparse", nargs="*", type=Path, default=[path for path in sparse if path.is_file()])
    arguments = parser.parse_args()
    clouds = [voxelised(path, arguments.every) for path in arguments.recordings]
    points = ", ".join(f"{cloud.name} {len(cloud.grid)} points" for cloud in clouds)
    print(f"{points}; {available_processors()} processors; best of {arguments.repeats}\n")
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for cloud in clouds:
        for qp in arguments.qp:
            bench(cloud, qp, arguments.repeats)
    if arguments.golden is not None:
        golden_streams(arguments.golden)
    for path in arguments.sparse:
        sparse_cloud(path)
    for cloud in clouds:
        dropped_coefficients(cloud)
    binary = tmc3_binary()
    if binary is None:
        print("\nnot checked against the reference software: set GGSLAM_TMC3 to a tmc3 binary of release-v12.9")
        return
    for cloud in clouds:
        for qp in arguments.qp:
            cross_check(cloud, qp, binary)
            by_turns(cloud, qp, binary, arguments.repeats)


if __name__ == "__main__":
    main()
