# SPDX-License-Identifier: Apache-2.0
"""Volumes along a corridor: whether a frame's time and the memory stay the same however long the way is. A part of
bench_volumes.py."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ggslam.sequences import open_sequence
from ggslam.system.process_memory import resident_bytes
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

LENGTHS = (1, 2, 5, 10)
"""Tenths of the way at whose ends is measured."""


@dataclass(frozen=True)
class Stretch:
    """A tenth of the way.

    Attributes:
        ms: of each frame: what is on disk, fusion and field; wall time.
        cpu_ms: the same, CPU time of all threads.
        occupancy_ms: CPU time of the occupancy map.
        cells_ms, tsdf_ms, esdf_ms: the parts, wall time.
        held: most bytes of TSDF and field after a frame.
        occupancy: bytes of the occupancy map at the end.
        rss_mb: of the process at the end.
    """

    ms: np.ndarray
    cpu_ms: np.ndarray
    occupancy_ms: np.ndarray
    cells_ms: np.ndarray
    tsdf_ms: np.ndarray
    esdf_ms: np.ndarray
    held: int
    occupancy: int
    rss_mb: float


def corridor_part(
    recording: Path, voxels: tuple[float, ...] = (0.04, 0.02), limits: tuple[float, ...] = (80.0, 450.0),
    frames: int | None = None,
) -> None:  # fmt: skip
    """Prints, for each voxel size, what the first, second, fifth and last tenth of the way cost, with a distance field
    after every frame: with a limit of memory and without one.

    Args:
        recording: of a corridor (`ggslam synth DIR --scene corridor --frames 2400`).
        voxels: metres.
        limits: MB for TSDF and distance field, one for each voxel size.
        frames: only the first.
    """
    print(f"\n{recording.name}: along a corridor, TSDF and distance field after every frame; ms: mean, 95 %")
    for voxel, most in zip(voxels, limits, strict=True):
        for limit in (most, 0.0):
            maps = VolumeMaps(VolumeSettings(tsdf=TsdfSettings(voxel=voxel), esdf_every=1), esdf=True)
            occupancy = OccupancyMap(2 * voxel, maps.settings.occupancy)
            with tempfile.TemporaryDirectory() as folder:
                if limit:
                    maps.paging = Paging(Path(folder) / "cells", partial(_constant, int(1e6 * limit)))
                stretches = list(_walk(maps, occupancy, recording, frames))
            _print(f"{100 * voxel:g} cm, limit {f'{limit:g} MB' if limit else 'none'}", maps, stretches)


def _constant(bytes_: int, held: int) -> int:
    return bytes_


def _walk(maps: VolumeMaps, occupancy: OccupancyMap, recording: Path, frames: int | None) -> Iterator[Stretch]:
    sequence = open_sequence(recording, stop=frames)
    each, held = len(sequence) // max(LENGTHS), 0
    spent: list[list[float]] = []
    for frame in sequence.stream(masks=False):
        assert frame.T_world_camera is not None and maps.field is not None
        start = time.process_time()
        maps.add(frame, frame.T_world_camera)
        done = time.process_time()
        occupancy.insert_depth(frame.depth, frame.camera, frame.T_world_camera)
        spent.append([1e3 * (done - start), 1e3 * (time.process_time() - done)])
        held = max(held, maps.tsdf.memory_bytes + maps.field.memory_bytes)
        if len(spent) == each:
            parts = ("cells", "tsdf", "esdf")
            ms = 1e3 * np.array([[row.get(part, 0.0) for part in parts] for row in maps.times.rows[-each:]])
            yield Stretch(
                ms.sum(1), *np.array(spent).T, *ms.T, held, occupancy.summary().memory_bytes, resident_bytes() / 1e6
            )
            spent, held = [], 0


def _print(title: str, maps: VolumeMaps, stretches: list[Stretch]) -> None:
    if (pager := maps.pager) is not None:
        title += f": {pager.written} cells of {pager.cells.edge:.2f} m went to disk, {pager.read} back"
        title += "; views need more" if pager.exceeded else ""
    print(f"  {title}")
    for length in LENGTHS:
        s = stretches[length - 1]
        parts = f"cells {s.cells_ms.mean():.1f}, fusion {s.tsdf_ms.mean():.1f}, field {s.esdf_ms.mean():.1f}"
        print(
            f"    {length:2}x: {s.ms.mean():6.1f} {np.percentile(s.ms, 95):6.1f} ({parts}; CPU time "
            f"{s.cpu_ms.mean():.1f} {np.percentile(s.cpu_ms, 95):.1f}), {s.held / 1e6:.0f} MB; occupancy "
            f"{s.occupancy_ms.mean():.1f} (CPU time), {s.occupancy / 1e6:.1f} MB; process {s.rss_mb:.0f} MB"
        )
    for other in (1, 2):  # the first tenth may not fill the memory that is allowed
        _print_ratios(other, stretches[other - 1], stretches[-1])


def _print_ratios(length: int, first: Stretch, last: Stretch) -> None:
    times = [float(f(last.cpu_ms) / f(first.cpu_ms)) for f in (np.mean, partial(np.percentile, q=95))]
    occupied = last.occupancy_ms.mean() / first.occupancy_ms.mean()
    print(
        f"    10x / {length}x: CPU time {times[0]:.2f} (95 %: {times[1]:.2f}), memory {last.held / first.held:.2f}; "
        f"occupancy: CPU time {occupied:.2f}, memory {last.occupancy / max(1, first.occupancy):.2f}",
        flush=True,
    )
