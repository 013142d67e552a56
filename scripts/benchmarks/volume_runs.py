# SPDX-License-Identifier: Apache-2.0
"""Parts of bench_volumes.py."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences.factory import open_sequence
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import VOXELS, TsdfMap

GROWTH_FRAMES = 50


class Fusion(Protocol):
    """Something that frames are fused into."""

    def prepared(self, frame: Frame) -> Any:
        """The frame as `integrate` takes it; not timed."""

    def integrate(self, frame: Any) -> None:
        """Fuses one frame with colour."""

    def size(self) -> tuple[int, int, float]:
        """Blocks, voxels held in memory, and bytes."""


class Ours:
    """The compiled fusion, carving and clearing."""

    def __init__(self, settings: TsdfSettings, points: bool = False) -> None:
        self.tsdf = TsdfMap(settings, points=points)

    def prepared(self, frame: Frame) -> Frame:
        return frame

    def integrate(self, frame: Frame) -> None:
        assert frame.T_world_camera is not None
        self.tsdf.integrate(frame.depth, frame.camera, frame.T_world_camera, frame.color)

    def size(self) -> tuple[int, int, float]:
        return len(self.tsdf), VOXELS * self.tsdf.dense_blocks, self.tsdf.memory_bytes


class VoxelBlockGrid:
    """Open3D's fusion on the CPU: 16^3 voxels a block, float32 distance, uint16 weight and colour, as in its guide."""

    RESOLUTION = 16

    def __init__(self, settings: TsdfSettings) -> None:
        open3d: Any = importlib.import_module("open3d")
        core = open3d.core
        self.o3d, self.settings, self.device = open3d, settings, core.Device("CPU:0")
        self.grid = open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (core.float32, core.uint16, core.uint16), ((1,), (1,), (3,)),
            settings.voxel, self.RESOLUTION, 20000, self.device,
        )  # fmt: skip

    def prepared(self, frame: Frame) -> Any:
        """Depth in millimetres and colour in bytes, the types that Open3D takes together."""
        assert frame.T_world_camera is not None
        core, images = self.o3d.core, self.o3d.t.geometry
        depth = images.Image(core.Tensor(np.rint(1000 * frame.depth).astype(np.uint16)))
        color = images.Image(core.Tensor(np.ascontiguousarray(frame.color)))
        return depth, color, core.Tensor(frame.camera.matrix()), core.Tensor(inverse(frame.T_world_camera))

    def integrate(self, frame: Any) -> None:
        depth, color, intrinsics, extrinsics = frame
        numbers = 1000.0, self.settings.max_depth, self.settings.truncation_voxels
        near = self.grid.compute_unique_block_coordinates(depth, intrinsics, extrinsics, *numbers)
        self.grid.integrate(near, depth, color, intrinsics, extrinsics, *numbers)

    def size(self) -> tuple[int, int, float]:
        blocks = self.grid.hashmap().size()
        # Reserved memory is larger; what the blocks hold: distance, weight, colour, and their keys.
        voxels = blocks * self.RESOLUTION**3
        return blocks, voxels, float(voxels * (4 + 2 + 6) + blocks * 12)


def frames_of(path: Path, arguments: argparse.Namespace) -> list[Frame]:
    """Frames with true poses, without masks."""
    stream = open_sequence(path, stop=arguments.frames).stream(masks=False)
    frames = [frame for frame in stream if frame.T_world_camera is not None]
    return frames if arguments.views is None else frames[:: max(1, len(frames) // arguments.views)][: arguments.views]


def compare_fusion(path: Path, arguments: argparse.Namespace) -> None:
    """Milliseconds per frame of both, by turns frame by frame; sizes; cost along the recording."""
    frames = frames_of(path, arguments)
    contenders: dict[str, Callable[[TsdfSettings], Fusion]] = {"ours": Ours}
    if importlib.util.find_spec("open3d"):
        contenders["Open3D"] = VoxelBlockGrid
    else:
        print("Open3D is not installed (pip install 'ggslam[bench]'): ours alone")
    camera = frames[0].camera
    print(f"\n{path.name}: {len(frames)} frames of {camera.width}x{camera.height}, fusion with colour")
    print("  voxel           mean ms  median  frames/s  ratio   blocks     MB  MB/Mvoxel   mean ms by 50 frames")
    for voxel in arguments.voxels:
        settings = TsdfSettings(voxel=voxel)
        times: dict[str, np.ndarray] = {}
        for _ in range(arguments.repeats):
            maps = {kind: make(settings) for kind, make in contenders.items()}
            taken = fuse_by_turns(frames, maps)
            times = {kind: np.minimum(ms, times.get(kind, ms)) for kind, ms in taken.items()}
        for kind, ms in times.items():
            blocks, voxels, size = maps[kind].size()
            growth = " ".join(f"{part.mean():.1f}" for part in in_parts(ms, GROWTH_FRAMES))
            ratio = times["Open3D"].mean() / ms.mean() if "Open3D" in times else float("nan")
            print(
                f"  {100 * voxel:3.0f} cm {kind:8}"
                f"{ms.mean():9.2f}{np.median(ms):8.2f}{1e3 / ms.mean():10.1f}{ratio:7.2f}"
                f"{blocks:9}{size / 1e6:6.1f}{size / max(voxels, 1):11.2f}   {growth}"
            )


def fuse_by_turns(frames: list[Frame], maps: dict[str, Fusion]) -> dict[str, np.ndarray]:
    """Milliseconds of every frame for each map; who goes first alternates."""
    times: dict[str, list[float]] = {kind: [] for kind in maps}
    for n, frame in enumerate(frames):
        for kind in list(maps) if n % 2 else list(maps)[::-1]:
            prepared = maps[kind].prepared(frame)
            start = time.perf_counter()
            maps[kind].integrate(prepared)
            times[kind].append(1e3 * (time.perf_counter() - start))
    return {kind: np.array(ms) for kind, ms in times.items()}


def in_parts(values: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Runs of `size` values."""
    for begin in range(0, len(values), size):
        yield values[begin : begin + size]
