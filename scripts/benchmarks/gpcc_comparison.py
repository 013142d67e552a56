# SPDX-License-Identifier: Apache-2.0
"""Our G-PCC codec against the reference software and against an earlier version of itself, for `bench_gpcc.py`."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gpcc_clouds import Cloud
from gpcc_reference import bd_rate, payloads, reference_decode, reference_encode, unit_sizes

from ggslam.coding import CodecSettings, PointCloud, decode_cloud, encode_cloud
from ggslam.coding.metrics import CloudPair, color_quality, matching_rows
from ggslam.formats.point_cloud import ColoredCloud, write_point_cloud
from ggslam.geometry.normals import estimate_normals

QPS = (16, 22, 28, 34, 40)
SCALES = ((0.125, 51), (0.25, 46), (0.5, 40), (0.75, 34), (0.875, 28), (0.9375, 22))
"""Scale of the positions and QP of the colours: six rates, in the manner of the common test conditions."""


# --- exactness -------------------------------------------------------------------------------------------------------


def cross_check(cloud: Cloud, qp: int, binary: str, folder: Path) -> None:
    """Prints whether our stream decodes exactly in the reference decoder and the reference encoder's in ours, and
    whether the two encoders' payloads are the same bytes."""
    encoded = encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp, slices=4), reconstruct=True)
    assert encoded.reconstruction is not None
    (folder / "ours.bin").write_bytes(encoded.data)
    theirs, _ = reference_decode(binary, folder / "ours.bin", folder / "ours.ply")
    there = "exactly" if same_rows(encoded.reconstruction, theirs) else "WRONGLY"
    reference_encode(binary, _written(cloud, folder), folder / "theirs.bin", qp)
    data = (folder / "theirs.bin").read_bytes()
    theirs, _ = reference_decode(binary, folder / "theirs.bin", folder / "theirs.ply")
    here = "exactly" if same_rows(decode_cloud(data), theirs) else "WRONGLY"
    ours = payloads(encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp)).data)
    equal = ["equal" if a == b else "DIFFERENT" for a, b in zip(ours, payloads(data), strict=True)]
    print(
        f"{cloud.name}, QP {qp}: tmc3 decodes our stream of 4 slices {there}, we its stream {here}; payloads of both "
        f"encoders: geometry {equal[0]}, colours {equal[1]} ({len(ours[0])} and {len(ours[1])} bytes)", flush=True,
    )  # fmt: skip


def same_rows(ours: PointCloud, theirs: ColoredCloud) -> bool:
    """Whether two clouds are the same set of points and colours."""
    if theirs.colors is None:
        return False
    pairs = ((ours.points, ours.attributes["color"]), (theirs.points, theirs.colors))
    rows = [np.column_stack([np.rint(points).astype(np.int32), colors]) for points, colors in pairs]
    return matching_rows(rows[0], rows[1]) is not None


def _written(cloud: Cloud, folder: Path) -> Path:
    path = folder / "in.ply"
    write_point_cloud(path, cloud.grid.astype(np.float32), {"color": cloud.colors})
    return path


# --- speed -----------------------------------------------------------------------------------------------------------


class Worker:
    """A version of ggslam in a process of its own; see `gpcc_worker.py`."""

    def __init__(self, checkout: Path, cloud: Path, qp: int) -> None:
        script = Path(__file__).with_name("gpcc_worker.py")
        self._process = subprocess.Popen(
            [sys.executable, script, cloud, str(qp)], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(checkout)},
        )  # fmt: skip
        self._answer()

    def turn(self) -> np.ndarray:
        """Seconds of encoding in user mode, altogether, of decoding likewise; bytes."""
        assert self._process.stdin is not None
        print(file=self._process.stdin, flush=True)
        return np.array([float(word) for word in self._answer().split()])

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("gpcc_worker.py stopped")
        return line


def take_turns(cloud: Cloud, qp: int, repeats: int, binary: str | None, before: Path | None, folder: Path) -> None:
    """Prints what one core codes in a second: ours, the reference's and an earlier version's, in the same run."""
    np.savez(folder / "cloud.npz", grid=cloud.grid, colors=cloud.colors)
    checkouts = [Path(__file__).parents[2]] + ([] if before is None else [before])
    workers = [Worker(checkout, folder / "cloud.npz", qp) for checkout in checkouts]
    ours: list[list[np.ndarray]] = [[] for _ in workers]
    theirs = []
    source = _written(cloud, folder)
    for _ in range(repeats):
        for worker, times in zip(workers, ours, strict=True):
            times.append(worker.turn())
        if binary is not None:
            encoding = reference_encode(binary, source, folder / "theirs.bin", qp)
            _, decoding = reference_decode(binary, folder / "theirs.bin", folder / "theirs.ply")
            theirs.append([encoding.coding, encoding.whole, decoding.coding, decoding.whole])
    for worker in workers:
        worker.close()
    best = np.min(ours[0], 0)
    print(f"{cloud.name}, QP {qp}, best of {repeats} by turns, one core, million points/s: encode, decode")
    _print_rates(cloud, "ours", best[[0, 2]], None)
    if binary is not None:
        times = np.min(theirs, 0)
        _print_rates(cloud, "tmc3, coding alone", times[[0, 2]], best[[0, 2]])
        _print_rates(cloud, "tmc3, as a whole", times[[1, 3]], best[[0, 2]])
    if before is not None:
        _print_rates(cloud, f"{before.name}, system calls included", np.min(ours[1], 0)[[1, 3]], best[[1, 3]])


def _print_rates(cloud: Cloud, name: str, times: np.ndarray, ours: np.ndarray | None) -> None:
    rates = len(cloud.grid) / times / 1e6
    ratios = "" if ours is None else f"; we are {times[0] / ours[0]:.2f} and {times[1] / ours[1]:.2f} times as fast"
    print(f"    {name}: {rates[0]:.2f}, {rates[1]:.2f}{ratios}", flush=True)


# --- rates -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rated:
    """One point of a curve: bytes of geometry and colours, and dB: D1, D2 (infinite: lossless), Y, U, V."""

    sizes: tuple[int, int]
    quality: tuple[float, ...]


def print_rates(cloud: Cloud, binary: str, folder: Path) -> None:
    """Prints rate and quality of both encoders at the same settings, and the Bjontegaard rates."""
    source = _written(cloud, folder)
    normals = estimate_normals(cloud.grid)
    print(f"\n{cloud.name}: bits a point of geometry and colours, dB (D1, D2, Y, U, V): ours | tmc3")
    lossless, lossy = [], []
    for qp in QPS:
        lossless.append(_both(cloud, 1.0, qp, binary, source, normals))
    for scale, qp in SCALES:
        lossy.append(_both(cloud, scale, qp, binary, source, normals))
    _print_bd("lossless geometry", lossless, ("Y", "U", "V"), 1, 2)
    _print_bd("lossy geometry", lossy, ("D1", "D2"), 0, 0)
    _print_bd("lossy geometry", lossy, ("Y", "U", "V"), 1, 2)


def _both(cloud: Cloud, scale: float, qp: int, binary: str, source: Path, normals: np.ndarray) -> tuple[Rated, Rated]:
    ours = encode_cloud(cloud.grid, {"color": cloud.colors}, CodecSettings(qp=qp, geometry_scale=scale)).data
    stream = source.with_name("theirs.bin")
    reference_encode(binary, source, stream, qp, scale)
    pair = (_rated(cloud, ours, scale, normals), _rated(cloud, stream.read_bytes(), scale, normals))
    texts = [
        " ".join(f"{8 * size / len(cloud.grid):.3f}" for size in rated.sizes)
        + "  " + " ".join(f"{value:.2f}" for value in rated.quality) for rated in pair
    ]  # fmt: skip
    print(f"    scale {scale:g}, QP {qp}: {texts[0]} | {texts[1]}", flush=True)
    return pair


def _rated(cloud: Cloud, data: bytes, scale: float, normals: np.ndarray) -> Rated:
    decoded = decode_cloud(data)
    points, colors = decoded.points, decoded.attributes["color"]
    if scale == 1:
        rows = matching_rows(cloud.grid, np.rint(points).astype(np.int32))
        if rows is None:
            raise SystemExit(f"{cloud.name}: the decoded points are not those that were coded")
        quality = color_quality(cloud.colors, colors[rows])
        return Rated(unit_sizes(data), (np.inf, np.inf, quality.y, quality.u, quality.v))
    pair = CloudPair(cloud.grid, points)
    geometry, quality = pair.geometry((1 << 10) - 1, normals), pair.colors(cloud.colors, colors)
    return Rated(unit_sizes(data), (geometry.d1, geometry.d2, quality.y, quality.u, quality.v))


def _print_bd(name: str, pairs: list[tuple[Rated, Rated]], labels: tuple[str, ...], part: int, first: int) -> None:
    rates = []
    for i, label in enumerate(labels, first):
        curves = [np.array([(p[k].sizes[part], p[k].quality[i]) for p in pairs]) for k in (0, 1)]
        rates.append(f"{label} {bd_rate(*curves[0].T, *curves[1].T):+.2f} %")
    print(f"    BD-rate of our {('geometry', 'colours')[part]} against tmc3's, {name}: {', '.join(rates)}", flush=True)
