# SPDX-License-Identifier: Apache-2.0
"""Memory that slice, bands and mesh of a corridor take after its last frame. A part of bench_volumes.py."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from volume_corridor_runs import LENGTHS

from ggslam.driving.bands import HeightLayers
from ggslam.driving.robot import Robot
from ggslam.sequences import open_sequence
from ggslam.system.process_memory import resident_bytes
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.slices import plane_at_height, slice_field
from ggslam.volumes.volume_settings import VolumeSettings

_SAMPLED_S = 0.02
_UP = np.array([0.0, -1.0, 0.0])


def corridor_files_part(recording: Path, voxels: tuple[float, ...], limits: tuple[float, ...], frames: int | None
                        ) -> None:  # fmt: skip
    """Prints, for 1 to 10 tenths of the way, what the process takes while slice, bands and mesh are made, with a limit
    of memory and without; each in a process of its own. Arguments as of `corridor_part`."""
    print(f"\n{recording.name}: after the last frame: slice, map, a robot's band, mesh; most MB of the process")
    each = len(open_sequence(recording, stop=frames)) // max(LENGTHS)
    for voxel, most in zip(voxels, limits, strict=True):
        for limit in (most, 0.0):
            print(f"  {100 * voxel:g} cm, limit {f'{limit:g} MB' if limit else 'none'}")
            for length in LENGTHS:
                with get_context("spawn").Pool(1) as pool:
                    line = pool.apply(_measure, (recording, voxel, limit, each * length))
                print(f"    {length:2}x: {line}", flush=True)


def _measure(recording: Path, voxel: float, limit: float, frames: int) -> str:
    maps = VolumeMaps(VolumeSettings(tsdf=TsdfSettings(voxel=voxel)), esdf=True)
    with tempfile.TemporaryDirectory() as folder:
        if limit:
            maps.paging = Paging(Path(folder) / "cells", partial(_constant, int(1e6 * limit)))
        fused = _most_mb(lambda: _fuse(maps, recording, frames))
        start = time.process_time()
        finished = _most_mb(lambda: _make(maps))
    return f"{fused:.0f} while frames are fused, {finished:.0f} after; {time.process_time() - start:.1f} s of CPU time"


def _constant(bytes_: int, held: int) -> int:
    return bytes_


def _fuse(maps: VolumeMaps, recording: Path, frames: int) -> None:
    for frame in open_sequence(recording, stop=frames).stream(masks=False):
        assert frame.T_world_camera is not None
        maps.add(frame, frame.T_world_camera)


def _make(maps: VolumeMaps) -> None:
    maps.finish()
    field = maps.finished_field
    assert field is not None
    slice_field(field, plane_at_height(field, _UP, 0.0), field.voxel)
    layers = HeightLayers(field, plane_at_height(field, _UP, -1.4), max(0.05, field.voxel))
    layers.between(0.1, 1.8)
    layers.band(Robot())
    for _ in maps.mesh_parts(20):
        pass


def _most_mb(work: Callable[[], None]) -> float:
    """The most that the process takes meanwhile."""
    most, done = [resident_bytes()], threading.Event()

    def look() -> None:
        while not done.wait(_SAMPLED_S):
            most.append(max(most[-1], resident_bytes()))

    thread = threading.Thread(target=look)
    thread.start()
    work()
    done.set()
    thread.join()
    return max(*most, resident_bytes()) / 1e6
