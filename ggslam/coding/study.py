# SPDX-License-Identifier: Apache-2.0
"""Sweeps over quantisers: the size and quality of a cloud at each setting.

Three sweeps, as codec papers report them: the quantiser parameter of the colours at lossless geometry, and the scale of
the geometry and its quantiser within the octree at the finest colours that the transform has (quantiser parameter 4
without conversion to Y, Cb, Cr: about 58 dB). All start from the cloud on its grid: one point per voxel with the mean
colour.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any, Final, TypeVar

import numpy as np

from ggslam.coding.cloud import PointCloud
from ggslam.coding.decoder import decode_cloud
from ggslam.coding.encoder import encode_cloud
from ggslam.coding.metrics import CloudPair, ColorQuality, color_quality, matching_rows
from ggslam.coding.quantization import Quantization, choose_quantization
from ggslam.coding.settings import CodecSettings
from ggslam.errors import ConfigError
from ggslam.geometry.normals import estimate_normals
from ggslam.system.energy import EnergyMeter
from ggslam.system.tuning import Tuning

Result = TypeVar("Result")

SWEEPS: Final = ("qp", "geometry", "geometry_qp")
"""What a sweep varies: quantiser of colours, scale of the grid, quantiser of positions within the octree."""


class StudyTuning(Tuning):
    """What a study of rates measures."""

    finest_qp = 4
    """Quantiser of attributes while geometry is varied."""
    repeats = 3
    """Times each step is coded: the shortest time counts, and the mean energy."""
    qps = (4, 10, 16, 22, 28, 34, 40, 46)
    """Quantisers of attributes."""
    scales = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0)
    """Scales of the grid."""
    geometry_qps = (24, 20, 16, 12, 8, 4, 2, 0)
    """Quantisers of positions within the octree: steps of 8, 6, 4, 3, 2, 1.5, 1.25 and 1 voxel."""


@dataclass(frozen=True)
class GridCloud:
    """A cloud on its grid: grid int32 [N, 3], no two rows equal; colors uint8 [N, 3] RGB; where the grid lies."""

    grid: np.ndarray
    colors: np.ndarray
    quantization: Quantization

    @property
    def peak(self) -> int:
        """The largest coordinate of the smallest grid of 2^k voxels a side that holds the cloud: 1023 for 10 bits."""
        longest = int((self.grid.max(0) - self.grid.min(0)).max())
        return (1 << max(1, longest.bit_length())) - 1


@dataclass(frozen=True)
class SweepStep:
    """One point of a sweep; `sweep` is one of `SWEEPS`."""

    sweep: str
    qp: int
    geometry_scale: float
    geometry_qp: int = 0

    @property
    def lossless(self) -> bool:
        """Whether positions stay as they are."""
        return self.geometry_scale == 1 and self.geometry_qp == 0

    def words(self) -> str:
        """What is varied, and its value."""
        return {
            "qp": f"QP {self.qp}", "geometry": f"scale {self.geometry_scale:g}",
            "geometry_qp": f"geometry QP {self.geometry_qp}",
        }[self.sweep]  # fmt: skip


@dataclass(frozen=True)
class StudyRow:
    """What came out at one step. Bytes of geometry and colour include the headers of their units; rates are bits per
    point of the cloud on its grid; PSNR in dB, infinite where nothing was lost; seconds of this process's threads on a
    processor and joules of an encoding: what the whole machine used meanwhile, None if they cannot be read."""

    step: SweepStep
    slices: int
    split: str
    input_points: int
    decoded_points: int
    geometry_bytes: int
    color_bytes: int
    total_bytes: int
    color: ColorQuality
    d1: float
    d2: float
    encode_s: float
    decode_s: float
    encode_cpu_s: float
    joules: float | None

    def values(self) -> dict[str, Any]:
        """One flat row of a table."""
        out = asdict(self.step)
        out |= {name: getattr(self, name) for name in ("slices", "split", "input_points", "decoded_points")}
        for part in ("geometry", "color", "total"):
            size = getattr(self, f"{part}_bytes")
            out |= {f"{part}_bytes": size, f"{part}_bpp": 8 * size / self.input_points}
        out |= {f"psnr_{name}": value for name, value in self.color.values().items()}
        rest = ("d1", "d2", "encode_s", "decode_s", "encode_cpu_s", "joules")
        return out | {name: getattr(self, name) for name in rest}


def on_grid(points: np.ndarray, colors: np.ndarray, settings: CodecSettings) -> GridCloud:
    """The cloud on the grid that the encoder would choose at geometry scale 1: a point per voxel, its colour the mean.

    Args:
        points: [N, 3], float (metres) or integer (voxels).
        colors: uint8 [N, 3].
        settings: `voxel_size`, `geometry_bits` and `box` choose the grid.
    """
    quantization = choose_quantization(points, settings.voxel_size, settings.geometry_bits, 1.0, settings.box)
    grid = quantization.apply(points)
    order = np.lexsort(grid.T[::-1])
    grid, colors = grid[order], colors[order]
    first = np.concatenate([[True], (grid[1:] != grid[:-1]).any(1)])
    starts = np.flatnonzero(first)
    sums = np.add.reduceat(colors.astype(np.int64), starts)
    counts = np.diff(np.append(starts, len(grid)))[:, None]
    return GridCloud(grid[starts], np.rint(sums / counts).astype(np.uint8), quantization)


def sweep_steps(
    kinds: Sequence[str], qps: Sequence[int] = StudyTuning.qps, scales: Sequence[float] = StudyTuning.scales,
    geometry_qps: Sequence[int] = StudyTuning.geometry_qps,
) -> list[SweepStep]:  # fmt: skip
    """The steps of the sweeps `kinds`, of `SWEEPS`."""
    finest = StudyTuning.finest_qp
    steps = {
        "qp": [SweepStep("qp", qp, 1.0) for qp in qps],
        "geometry": [SweepStep("geometry", finest, scale) for scale in scales],
        "geometry_qp": [SweepStep("geometry_qp", finest, 1.0, qp) for qp in geometry_qps],
    }
    return [step for sweep in SWEEPS if sweep in kinds for step in steps[sweep]]


def run_sweep(
    cloud: GridCloud, steps: Sequence[SweepStep], settings: CodecSettings, meter: EnergyMeter
) -> Iterator[tuple[StudyRow, PointCloud]]:
    """Codes the cloud at each step; yields the numbers and the decoded cloud (in voxels), step by step.

    Args:
        cloud: what is coded and compared with.
        steps: in any order.
        settings: slices, threads and tools; quantisers and scale come from the steps.
        meter: reads the energy of encoding.

    Raises:
        ConfigError: a step has an impossible setting.
    """
    if any(step.geometry_scale > 1 for step in steps):
        raise ConfigError("a sweep of the geometry goes up to scale 1, the cloud's own grid")
    quality = _Quality(cloud)
    encode_cloud(cloud.grid[:1], {"color": cloud.colors[:1]}, settings)  # what happens once only is not timed
    for step in steps:
        with meter.measure() as energy:
            cpu_s = -time.process_time()
            encode = partial(encode_cloud, cloud.grid, {"color": cloud.colors}, _settings(settings, step))
            encoded, encode_s = _measure(encode)
            cpu_s += time.process_time()
        decoded, decode_s = _measure(partial(decode_cloud, encoded.data, settings.threads))
        joules = None if energy.joules is None else energy.joules / StudyTuning.repeats
        color, d1, d2 = quality.of(decoded, step)
        report = encoded.report
        yield StudyRow(
            step, len(report.slices), settings.split, len(cloud.grid), len(decoded), report.geometry_bytes,
            report.attribute_bytes["color"], report.total_bytes, color, d1, d2, encode_s, decode_s,
            cpu_s / StudyTuning.repeats, joules,
        ), decoded  # fmt: skip


def _measure(call: Callable[[], Result]) -> tuple[Result, float]:
    """What the call returns, and its shortest time of `StudyTuning.repeats`, seconds."""
    times = []
    for _ in range(StudyTuning.repeats):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return result, min(times)


def _settings(settings: CodecSettings, step: SweepStep) -> CodecSettings:
    color = settings.attribute("color")
    if step.sweep != "qp":  # Y, Cb, Cr of 8 bits are no finer than 50 dB
        color = replace(color, color_space="identity", chroma_offset=0)
    attributes = {"color": replace(color, qp=step.qp)}
    return replace(
        settings, voxel_size=None, box=None, geometry_scale=step.geometry_scale, geometry_qp=step.geometry_qp,
        attributes=attributes,
    )  # fmt: skip


class _Quality:
    """Compares decoded clouds with the one that was coded."""

    def __init__(self, cloud: GridCloud) -> None:
        self._cloud = cloud

    @cached_property
    def _normals(self) -> np.ndarray:
        return estimate_normals(self._cloud.grid)

    def of(self, decoded: PointCloud, step: SweepStep) -> tuple[ColorQuality, float, float]:
        """Colours, D1 and D2; with the geometry whole, point by point."""
        cloud, points, colors = self._cloud, decoded.points, decoded.attributes["color"]
        rows = matching_rows(cloud.grid, np.rint(points).astype(np.int32)) if step.lossless else None
        if rows is not None:
            return color_quality(cloud.colors, colors[rows]), np.inf, np.inf
        pair = CloudPair(cloud.grid, points)
        geometry = pair.geometry(cloud.peak, self._normals)
        return pair.colors(cloud.colors, colors), geometry.d1, geometry.d2
