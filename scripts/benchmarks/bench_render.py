# SPDX-License-Identifier: Apache-2.0
"""Speed of the CPU rasterizer against the prototype's library and against the torch reference, in one run.

    python scripts/benchmarks/bench_render.py --prototype ../shared/prototypes/cpu_rasterizer

Prints the best time of several interleaved repetitions, in milliseconds, and the ratio prototype / ggslam (above 1:
ggslam is faster). ggslam's times include the activations exp and sigmoid, which the prototype leaves to its caller.
"step" is backward and Adam: fused in ggslam, one after the other in the prototype.

Workloads: a camera in a box-shaped room of 6 x 3 x 5 m with ten spheres; Gaussians of about 1.5 pixels standing on the
visible surfaces, in random order or, with --coherent, in the order of the pixels they came from (as a map is
inserted in SLAM). W1: 100 000 at 320x240; W2: 300 000 at 640x480. Channels: 4 = colour and depth,
20 = colour, 16 features and depth.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch

from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

DEFAULT_PROTOTYPE = Path(__file__).parents[3] / "shared" / "prototypes" / "cpu_rasterizer"
LOW_PASS = 0.3  # that of the prototype, for ggslam as well
FLAGS = "-O3 -std=c++17 -fPIC -shared -fno-math-errno -fno-trapping-math -fno-signed-zeros -freciprocal-math"
FLAGS += " -ffp-contract=fast -pthread -Wno-psabi"
TARGETS = {"avx512": "-march=native -mprefer-vector-width=512 -DLANES=16", "avx2": "-march=x86-64-v3 -DLANES=8"}


# --- workloads -----------------------------------------------------------------------------------------------------


def surface_points(camera: Camera, R_world_camera: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point [P, 3] and depth [P] of the room's first surface along each pixel's ray."""
    rays = camera.rays().reshape(-1, 3).astype(np.float64) @ R_world_camera.T
    low, high = np.array([-3.0, -1.5, -2.5]), np.array([3.0, 1.5, 2.5])
    with np.errstate(divide="ignore"):
        depth = (np.where(rays > 0, high, low) - centre) / rays
    depth = np.where(depth > 0, depth, np.inf).min(1)
    random = np.random.default_rng(3)
    balls = random.uniform([-2.2, -1.0, 0.2], [2.2, 1.2, 2.0], (10, 3))
    for ball, radius in zip(balls, random.uniform(0.2, 0.5, 10), strict=True):
        a, b, c = (rays**2).sum(1), rays @ (centre - ball), ((centre - ball) ** 2).sum() - radius**2
        root = b * b - a * c
        hit = (-b - np.sqrt(np.maximum(root, 0))) / a
        depth = np.where((root > 0) & (hit > 0.1) & (hit < depth), hit, depth)
    return centre + rays * depth[:, None], depth


def make_workload(name: str, features: int, coherent: bool = False) -> tuple[GaussianMap, Camera, np.ndarray]:
    """Map, camera and T_camera_world of W1, W2 or `small` (for the torch reference)."""
    width, height, count = {"W1": (320, 240, 100_000), "W2": (640, 480, 300_000), "small": (96, 72, 3000)}[name]
    focal = 260.0 * width / 320
    camera = Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    random = np.random.default_rng(0)
    cy, sy, cp, sp = np.cos(0.15), np.sin(0.15), np.cos(0.05), np.sin(0.05)
    turned = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    views = [(np.eye(3), np.array([0, 0, -1.8])), (turned, np.array([0.3, 0.1, -1.5]))]
    points, sizes, left = [], [], count
    for R, centre in views:
        surface, depth = surface_points(camera, R, centre)
        chosen = random.permutation(len(surface))[:left]
        chosen = np.sort(chosen) if coherent else chosen
        points.append(surface[chosen])
        sizes.append(1.5 * depth[chosen] / focal)
        left -= len(chosen)
    position, size = np.concatenate(points), np.concatenate(sizes)
    position += random.normal(size=position.shape) * size[:, None] * 0.2
    order = np.arange(count) if coherent else random.permutation(count)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)

    gaussians = GaussianMap(0, features)
    gaussians.insert(
        tensor(position[order]),
        tensor(random.normal(size=(count, 4))),
        tensor(np.log(size[order])[:, None] + 0.2 * random.normal(size=(count, 3))),
        tensor(random.normal(size=count) + 1.0),
        tensor(random.uniform(size=(count, 3))),
        tensor(random.normal(size=(count, features))),
    )
    T_camera_world = np.eye(4)
    T_camera_world[2, 3] = 1.8
    return gaussians, camera, T_camera_world


# --- the prototype ----------------------------------------------------------------------------------------------------


def build_prototype(folder: Path, instruction_set: str, into: Path) -> Path:
    """Compiles the prototype's single source file for one instruction set."""
    library = into / f"{instruction_set}.so"
    command = f"g++ {FLAGS} {TARGETS[instruction_set]} {folder / 'ggraster.cpp'} -o {library}"
    subprocess.run(command.split(), check=True)
    return library


class Prototype:
    """The prototype's library on one workload."""

    def __init__(self, library: Path, threads: int, workload: tuple[GaussianMap, Camera, np.ndarray]) -> None:
        gaussians, camera, T_camera_world = workload
        self.library = ctypes.CDLL(str(library))
        self.library.gg_create.restype = ctypes.c_void_p
        self.context = ctypes.c_void_p(self.library.gg_create(threads))
        self.count, self.channels = len(gaussians), 4 + gaussians.features.shape[1]
        features = torch.cat([gaussians.rgb, gaussians.features], 1).contiguous()
        self.inputs = [gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, features]
        self.inputs = [array.clone() for array in self.inputs]
        numbers = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, 0.05]
        self.camera, self.size = torch.tensor(numbers, dtype=torch.float32), (camera.height, camera.width)
        self.view = torch.as_tensor(T_camera_world[:3], dtype=torch.float32).contiguous()
        self.out = torch.empty(self.channels, *self.size)
        self.alpha = torch.empty(self.size)
        self.image_gradients = [torch.randn_like(self.out), torch.randn_like(self.alpha)]
        self.gradients = [torch.empty_like(array) for array in self.inputs]
        self.pose, self.touched = torch.empty(12), torch.empty(self.count, dtype=torch.uint8)
        self.moments = [(torch.zeros_like(array), torch.zeros_like(array)) for array in self.inputs]

    def forward(self) -> None:
        height, width = self.size
        numbers = (self.count, width, height, self.channels)
        arrays = (self.camera, self.view, *self.inputs, self.out, self.alpha)
        assert self.library.gg_forward(self.context, *numbers, *map(_pointer, arrays)) == 0

    def backward(self) -> None:
        means, quaternions, scales, _, features = self.inputs
        arrays = (means, quaternions, scales, features, *self.image_gradients, *self.gradients, self.pose, self.touched)
        assert self.library.gg_backward(self.context, *map(_pointer, arrays)) == 0

    def step(self) -> None:
        self.backward()
        numbers = [ctypes.c_float(x) for x in (0.0, 0.9, 0.999, 1e-15)]
        for value, gradient, (first, second) in zip(self.inputs, self.gradients, self.moments, strict=True):
            width = value.numel() // self.count
            arrays = map(_pointer, (value, gradient, first, second, self.touched))
            self.library.gg_adam(self.context, self.count, width, *arrays, *numbers, 10)


def _pointer(tensor: torch.Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(tensor.data_ptr())


class Ours:
    """ggslam's rasterizer on one workload."""

    def __init__(
        self, instruction_set: str, threads: int, workload: tuple[GaussianMap, Camera, np.ndarray],
        detach: bool = False, close_below: float = 0.0,
    ) -> None:  # fmt: skip
        self.map, self.camera, self.T_camera_world = workload
        self.close_below = close_below
        self.rasterizer = CpuRasterizer(threads, instruction_set, low_pass=LOW_PASS)
        self.forward()
        self.gradients = [torch.randn_like(self.buffers.image), torch.randn_like(self.buffers.depth)]
        self.gradients.append(torch.randn_like(self.buffers.alpha))
        if self.buffers.features is not None:
            self.gradients.append(torch.randn_like(self.buffers.features))
        self.detach = detach
        self.optimizer = AdamSettings({})  # all rates zero: the scene stays as it is

    def forward(self) -> None:
        view = (self.map, self.camera, self.T_camera_world)
        self.buffers = self.rasterizer.forward(*view, close_below=self.close_below)

    def backward(self) -> None:
        self.rasterizer.backward(*self.gradients, detach_features=self.detach)

    def step(self) -> None:
        options = {"optimizer": self.optimizer, "detach_features": self.detach}
        self.rasterizer.backward_step(self.map, *self.gradients, **options)


# --- measuring --------------------------------------------------------------------------------------------------------


@dataclass
class Best:
    """Shortest times in milliseconds."""

    forward: float = float("inf")
    backward: float = float("inf")
    step: float = float("inf")

    def measure(self, candidate: Prototype | Ours) -> None:
        for name in ("forward", "backward", "step"):
            elapsed = _milliseconds(getattr(candidate, name))
            setattr(self, name, min(getattr(self, name), elapsed))


def _milliseconds(function: Callable[[], None]) -> float:
    start = time.perf_counter()
    function()
    return (time.perf_counter() - start) * 1e3


def compare(
    name: str, features: int, instruction_set: str, threads: int, library: Path | None, options: argparse.Namespace
) -> None:
    """Prints one line of the table."""
    workload = make_workload(name, features, options.coherent)
    ours = Ours(instruction_set, threads, workload, options.detach, options.close_below)
    candidates: dict[str, Prototype | Ours] = {"ours": ours}
    if library is not None:
        candidates["prototype"] = Prototype(library, threads, workload)
    best = {key: Best() for key in candidates}
    for _ in range(options.repeat):
        for key, candidate in candidates.items():
            best[key].measure(candidate)
    line = f"{name:5} {4 + features:3} {instruction_set:8} {threads:2} "
    for part in ("forward", "backward", "step"):
        mine, text = getattr(best["ours"], part), "       -      -"
        if "prototype" in best:
            theirs = getattr(best["prototype"], part)
            text = f"{theirs:8.2f} {theirs / mine:6.2f}"
        line += f" | {mine:8.2f} {text}"
    print(line, flush=True)


def compare_with_reference() -> None:
    """Prints times on a scene small enough for the dense torch reference."""
    gaussians, camera, T_camera_world = make_workload("small", 0)
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in PARAMETERS}
    pose = torch.as_tensor(T_camera_world, dtype=torch.float32)
    ours, best = Ours(available_instruction_sets()[-1], 2, (gaussians, camera, T_camera_world)), Best()
    for _ in range(3):
        best.measure(ours)
    start = time.perf_counter()
    rendered = render_reference(GaussianTensors(**leaves), camera, pose)
    middle = time.perf_counter()
    (rendered.image.sum() + rendered.depth.sum()).backward()
    forward, backward = (middle - start) * 1e3, (time.perf_counter() - middle) * 1e3
    print(f"\n{len(gaussians)} Gaussians at {camera.width}x{camera.height}, 2 threads, forward / backward in ms:")
    print(f"  ggslam {best.forward:.2f} / {best.backward:.2f}, torch reference {forward:.0f} / {backward:.0f}")
    print(f"  ratio {forward / best.forward:.0f} / {backward / best.backward:.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("GGSLAM_PROTOTYPE", DEFAULT_PROTOTYPE))
    parser.add_argument("--prototype", type=Path, default=default, help="folder with ggraster.cpp")
    parser.add_argument("--workloads", nargs="+", default=["W1", "W2"], choices=["W1", "W2"])
    parser.add_argument("--instruction-sets", nargs="+", default=available_instruction_sets()[::-1])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--features", nargs="+", type=int, default=[0, 16], choices=[0, 8, 16])
    parser.add_argument("--repeat", type=int, default=10)
    parser.add_argument("--coherent", action="store_true", help="Gaussians in the order of their pixels")
    parser.add_argument("--detach", action="store_true", help="features' gradients do not reach geometry (ggslam only)")
    parser.add_argument("--close-below", type=float, default=0.0, help="end pixels so, as training does (ggslam only)")
    parser.add_argument("--no-reference", action="store_true", help="leave the torch reference out")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        libraries: dict[str, Path] = {}
        if (arguments.prototype / "ggraster.cpp").exists():
            wanted = [name for name in arguments.instruction_sets if name in TARGETS]
            libraries = {name: build_prototype(arguments.prototype, name, Path(folder)) for name in wanted}
        else:
            print(f"no prototype at {arguments.prototype} (--prototype or GGSLAM_PROTOTYPE): ggslam alone")
        columns = " | ".join(f"{part:>8} {'proto':>8} {'ratio':>6}" for part in ("forward", "backward", "step"))
        print(f"load   ch. set  threads | {columns}")
        for name in arguments.workloads:
            for features in arguments.features:
                for instruction_set in arguments.instruction_sets:
                    for threads in arguments.threads:
                        library = libraries.get(instruction_set)
                        compare(name, features, instruction_set, threads, library, arguments)
    if not arguments.no_reference:
        compare_with_reference()


if __name__ == "__main__":
    main()
