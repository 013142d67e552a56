#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What the G-PCC codec costs, in one slice and in four: time, speed per core, size; and how it compares with the
reference software.

    python scripts/benchmarks/bench_gpcc.py [--qp 10 22] [--repeats 3] [--sparse CLOUD ...] [--golden FOLDER]
                                 [--only PART ...] [--before CHECKOUT]

Clouds of about a million points: each recording is back-projected with its true poses and voxelised at 10 bits, one
point per voxel with the mean colour. Voxels with the fewest measurements, which are noise, are dropped until one slice
can hold the cloud (1.1 million points). Parts:

    layouts  one slice and four, one to four threads: the best of the repeats, which take turns; ratios and overheads
             are to one slice coded by one thread in the same run
    golden   streams of the reference encoder, decoded and compared, and its payloads beside ours (--golden)
    sparse   LiDAR and aerial clouds, with and without planes
    rdoq     what dropping coefficients is worth
    check    with the reference software (GGSLAM_TMC3 names a tmc3 binary of release-v12.9, or one is on PATH): streams
             go there and come from there; payloads of both encoders
    speed    both codecs, and that of an earlier checkout with its core built (--before), by turns, on one core, in
             processor time
    rates    both codecs at the same settings: bits, dB, Bjontegaard rates

Nothing else should run on the machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from gpcc_clouds import Cloud, voxelise
from gpcc_comparison import cross_check, print_rates, take_turns
from gpcc_reference import DENSE, bd_rate, payloads, reference_binary, reference_encode, unit_sizes
from timing import seconds

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.metrics import color_quality, matching_rows
from ggslam.coding.settings import Split
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.native.loader import available_processors

PARTS = ("layouts", "golden", "sparse", "rdoq", "check", "speed", "rates")
SPLITS: tuple[Split, ...] = ("count", "interval")
LAYOUTS = [(1, SPLITS[0], 1), *((4, split, threads) for split in SPLITS for threads in (1, 2, 4))]
"""Slices, how they are cut, threads; the first is what the others are compared with."""
COLUMNS = ("cloud, QP", "slices", "threads", "bytes", "overhead", "bits/point", "encode s", "M points/s/core", "ratio",
           "decode s", "ratio", "Y dB")  # fmt: skip


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
    names = json.loads((folder / "golden_more" / "manifest.json").read_text())
    exact, large = 0, []
    for name, about in names.items():
        same = digest_of((folder / "golden_more" / f"{name}.bin").read_bytes()) == about["sha256"]
        exact += same
        if about["points"] > 100_000:
            large.append(f"{name} ({about['points']} points) {'exactly' if same else 'WRONGLY'}")
    small = sorted((folder / "golden").glob("*_*.bin"))
    for path in small:
        cloud, wanted = decode_cloud(path.read_bytes()), np.load(path.with_suffix(".npz"))
        rows = [np.column_stack([np.rint(cloud.points).astype(np.int32), cloud.attributes["color"]]),
                np.column_stack([wanted["points"], wanted["colors"]])]  # fmt: skip
        exact += matching_rows(rows[0], rows[1].astype(np.int32)) is not None
    print(f"\nstreams of the reference encoder that decode exactly: {exact} of {len(names) + len(small)}")
    print(f"the large ones among them: {', '.join(large)}")
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


def sparse_cloud(path: Path, binary: str | None) -> None:
    """Prints bits a point of the geometry of a cloud in metres, with and without planes, and of the reference's."""
    points = read_point_cloud(path).points
    for voxel_size in (0.001, 0.01, 0.05):
        bits = []
        for settings in (CodecSettings(planes=False), CodecSettings(planes=False, neighbour_boundary=8),
                         CodecSettings(planes=True), CodecSettings()):  # fmt: skip
            report = encode_cloud(points, {}, replace(settings, voxel_size=voxel_size)).report
            bits.append(8 * report.geometry_bytes / report.points)
        plain, gain, theirs = min(bits[:2]), 100 * (bits[2] / bits[0] - 1), ""
        if binary is not None:
            found = [reference_bits(points, voxel_size, binary, planes) for planes in (False, True)]
            theirs = f"; tmc3 {found[0]:.2f}, with planes {found[1]:.2f}"
        print(
            f"{path.name}, voxels of {voxel_size} m: {bits[0]:.2f} bits a point, neighbours as contexts {bits[1]:.2f}, "
            f"with planes {bits[2]:.2f} ({gain:+.1f} %, against the smaller {100 * (bits[2] / plain - 1):+.1f} %), "
            f"chosen {bits[3]:.2f}{theirs}", flush=True,
        )  # fmt: skip


def reference_bits(points: np.ndarray, voxel_size: float, binary: str, planes: bool) -> float:
    """Bits a point of the reference's geometry on our grid, planes and levels that split some axes only on or off; of
    neighbours as contexts or none, what is smaller."""
    grid = decode_cloud(encode_cloud(points, {}, CodecSettings(voxel_size=voxel_size)).data).grid_points
    more = {"planarEnabled": int(planes), "qtbtEnabled": int(planes), "maxNumQtBtBeforeOt": 4, "minQtbtSizeLog2": 0}
    sizes = []
    with tempfile.TemporaryDirectory() as temporary:
        source, stream = Path(temporary) / "in.ply", Path(temporary) / "theirs.bin"
        write_point_cloud(source, (grid - grid.min(0)).astype(np.float32), {})
        for neighbours in ({}, {"neighbourAvailBoundaryLog2": 0, "adjacentChildContextualization": 0}):
            reference_encode(binary, source, stream, None, tools={**DENSE, **more, **neighbours})
            sizes.append(unit_sizes(stream.read_bytes())[0])
    return 8 * min(sizes) / len(grid)


def dropped_coefficients(cloud: Cloud) -> None:
    """Prints the rate at equal luma PSNR with coefficients dropped (the default) against none dropped: Bjontegaard."""
    curves = []
    for rdoq in (1.0, 0.0):
        curve = []
        for qp in (16, 22, 28, 34, 40):
            data = encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp, rdoq=rdoq)).data
            curve.append((unit_sizes(data)[1], decoded_quality(cloud, data)))
        curves.append(np.array(curve))
    rate = bd_rate(*curves[0].T, *curves[1].T)
    print(f"{cloud.name}: coefficients dropped as the reference encoder does: BD-rate of the colours {rate:+.2f} %")


def main() -> None:
    """Prints the parts."""
    data = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data"))
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
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument("--before", type=Path, help="checkout of an earlier version")
    arguments = parser.parse_args()
    binary = reference_binary()
    if "golden" in arguments.only and arguments.golden is not None:
        golden_streams(arguments.golden)
    if "sparse" in arguments.only:
        for path in arguments.sparse:
            sparse_cloud(path, binary)
    if set(arguments.only) - {"golden", "sparse"}:
        with_clouds(arguments, binary)


def with_clouds(arguments: argparse.Namespace, binary: str | None) -> None:
    """The parts that need the clouds of the recordings."""
    clouds = [voxelise(path, arguments.every) for path in arguments.recordings]
    points = ", ".join(f"{cloud.name} {len(cloud.grid)} points" for cloud in clouds)
    print(f"\n{points}; {available_processors()} processors; load {os.getloadavg()[0]:.1f}")
    cases = [(cloud, qp) for cloud in clouds for qp in arguments.qp]
    if "layouts" in arguments.only:
        print(f"best of {arguments.repeats}\n\n| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
        for cloud, qp in cases:
            bench(cloud, qp, arguments.repeats)
    if "rdoq" in arguments.only:
        for cloud in clouds:
            dropped_coefficients(cloud)
    if binary is None:
        print("\nnot compared with the reference software: set GGSLAM_TMC3 to a tmc3 binary of release-v12.9")
    with tempfile.TemporaryDirectory() as temporary:
        for cloud, qp in cases:
            if "check" in arguments.only and binary is not None:
                cross_check(cloud, qp, binary, Path(temporary))
            if "speed" in arguments.only:
                take_turns(cloud, qp, arguments.repeats, binary, arguments.before, Path(temporary))
        for cloud in clouds:
            if "rates" in arguments.only and binary is not None:
                print_rates(cloud, binary, Path(temporary))


if __name__ == "__main__":
    main()
