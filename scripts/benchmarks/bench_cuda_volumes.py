# SPDX-License-Identifier: Apache-2.0
"""Speed of TSDF, distance field and ray casting by the CUDA kernels, against the compiled core on the same frames.

    python scripts/benchmarks/bench_cuda_volumes.py [--frames 60] [--size 640x480] [--voxel 0.02] [--field 2.0] [--host]

A camera turns in a room with a Kinect's noise. Times are medians over the second half of the frames, in milliseconds:
of fusing a frame, of bringing the distance field up to date with it, of casting a ray for each pixel, each waited for;
and of fusing and updating with one wait at the end. `host` is what it takes to start them. The bar: a frame and its
distances in 3 ms at 640x480 and 2 cm. Without a GPU, `--host` leaves the kernels out: what remains is the host's work.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.camera import Camera
from ggslam.volumes.cuda.field import CudaField
from ggslam.volumes.cuda.raycast import CudaRaycast
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.raycast import render_depth
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

Frame = tuple[np.ndarray, np.ndarray, np.ndarray]
LOW, HIGH = np.array([-2.13, -1.21, -2.07]), np.array([2.31, 1.33, 2.42])


def make_frames(count: int, camera: Camera) -> list[Frame]:
    """Depth, pose and colour of a camera that turns once in a room, with noise of a Kinect's size."""
    rng, rays = np.random.default_rng(0), camera.rays().reshape(-1, 3).astype(np.float64)
    frames = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        T = np.eye(4)
        T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        T[:3, 3] = [0.6 * np.cos(angle), 0.1 * np.sin(3 * angle), 0.6 * np.sin(angle)]
        directions = rays @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            lengths = (np.where(directions > 0, HIGH, LOW) - T[:3, 3]) / directions
        depth = np.where(np.isfinite(lengths), lengths, np.inf).min(1)
        depth += 0.0012 * depth**2 * rng.standard_normal(depth.shape)
        color = (127 + 100 * np.sin(5 * (T[:3, 3] + depth[:, None] * directions))).astype(np.uint8)
        shape = (camera.height, camera.width)
        frames.append((depth.astype(np.float32).reshape(shape), T, color.reshape(*shape, 3)))
    return frames


def median_ms(calls: list[float]) -> float:
    return 1e3 * statistics.median(calls[len(calls) // 2 :])


def run_core(frames: list[Frame], camera: Camera, settings: TsdfSettings, field: FieldSettings) -> None:
    tsdf = TsdfMap(settings)
    distances = DistanceField(tsdf, field)
    fuse: list[float] = []
    update: list[float] = []
    cast: list[float] = []
    for depth, T, color in frames:
        start = time.perf_counter()
        tsdf.integrate(depth, camera, T, color)
        fuse.append(time.perf_counter() - start)
        start = time.perf_counter()
        distances.update()
        update.append(time.perf_counter() - start)
    for _ in range(6):
        start = time.perf_counter()
        render_depth(tsdf, camera, frames[0][1])
        cast.append(time.perf_counter() - start)
    print(f"core: fuse {median_ms(fuse):.2f} ms, field {median_ms(update):.2f} ms, cast {median_ms(cast):.2f} ms")


class DeviceRun:
    """The maps on the device, and how long parts took, seconds by name.

    Args:
        settings, field: of the maps.
        library: the kernels; None: those of the GPU.
    """

    def __init__(self, settings: TsdfSettings, field: FieldSettings, library: CudaLibrary | None) -> None:
        self.on_gpu = library is None
        self.tsdf = CudaTsdf(settings, library=library)
        self.field, self.cast = CudaField(self.tsdf, field), CudaRaycast(self.tsdf)
        self.parts: dict[str, list[float]] = {}

    def wait(self) -> None:
        """Until the device is done."""
        if self.on_gpu:
            torch.cuda.synchronize()

    def note(self, name: str, since: float) -> None:
        """A part took so long."""
        self.parts.setdefault(name, []).append(time.perf_counter() - since)

    def add(self, frame: Frame, camera: Camera, apart: bool) -> None:
        """Fuses a frame, with a wait after each part, or one at the end."""
        depth, T, color = frame
        start = time.perf_counter()
        self.tsdf.integrate(depth, camera, T, color)
        if apart:
            self.wait()
            self.note("fuse", start)
            start = time.perf_counter()
        self.field.update()
        if not apart:
            self.note("host", start)
        self.wait()
        self.note("field" if apart else "fuse and field", start)
        if apart:
            start = time.perf_counter()
            self.cast.render(camera, T)
            self.wait()
            self.note("cast", start)


def run_device(
    frames: list[Frame], camera: Camera, settings: TsdfSettings, field: FieldSettings, library: CudaLibrary | None
) -> None:
    for apart in (True, False):
        run = DeviceRun(settings, field, library)
        for frame in frames:
            run.add(frame, camera, apart)
        print("device:", ", ".join(f"{name} {median_ms(found):.2f} ms" for name, found in run.parts.items()))
    if library is None:
        stats, used = run.field.stats(), run.tsdf.memory_bytes + run.field.memory_bytes
        print(f"{len(run.tsdf)} blocks, {run.tsdf.dense_blocks} with voxels; {stats.recomputed_blocks} blocks of the "
              f"field by the last frame; {used / 1e6:.0f} MB")  # fmt: skip


def without_kernels() -> CudaLibrary:
    """A library that starts nothing."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    from cuda_emulation import emulated_library

    library = emulated_library()
    library.call = lambda name, *arguments: None  # type: ignore[method-assign]
    return library


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--voxel", type=float, default=0.02, help="metres")
    parser.add_argument("--field", type=float, default=2.0, help="largest distance, metres")
    parser.add_argument("--host", action="store_true", help="without kernels")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    camera = Camera(width, height, 0.82 * width, 0.82 * width, (width - 1) / 2, (height - 1) / 2)
    settings, field = TsdfSettings(voxel=options.voxel), FieldSettings(max_distance=options.field)
    frames = make_frames(options.frames, camera)
    if not options.host:
        run_core(frames, camera, settings, field)
    run_device(frames, camera, settings, field, without_kernels() if options.host else None)


if __name__ == "__main__":
    main()
