# SPDX-License-Identifier: Apache-2.0
"""Speed of the CUDA rasterizer against gsplat (if installed) and against the CPU rasterizer, in one run on one machine.

    python scripts/benchmarks/bench_cuda_render.py [--counts 100000 300000 1000000] [--channels 4 20] [--no-cpu]

Prints median times in milliseconds and ratios other / ggslam's cuda backend (above 1: that backend is faster), for the
forward alone and for forward and backward, both through torch's autograd; activations are inside all times. Channels:
4 = colour and depth, 20 = colour, 16 features and depth. The backends take turns within each repetition. Before
measuring, images and gradients are compared with the CPU rasterizer's; the largest relative errors are printed.

Workload: the box-shaped room of bench_render.py, Gaussians of about 1.5 pixels standing on the visible surfaces.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from bench_render import surface_points

from ggslam.cuda.library import library_for_device
from ggslam.rendering.autograd import render_cpu, rigid_inverse
from ggslam.rendering.cuda.autograd import render_cuda
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera

LOW_PASS, NEAR = 0.3, 0.05
SIZES = {"640x480": (640, 480), "1200x680": (1200, 680)}
Images = list[torch.Tensor]


def make_workload(size: tuple[int, int], count: int, features: int) -> tuple[GaussianTensors, Camera, torch.Tensor]:
    """Gaussians in random order on the CPU, camera, T_world_camera."""
    width, height = size
    focal = 260.0 * width / 320
    camera = Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    centre = np.array([0.0, 0.0, -1.8])
    scale = int(np.ceil(np.sqrt(count / (width * height))))
    surface, depth = surface_points(camera.resize(width * scale, height * scale), np.eye(3), centre)
    random = np.random.default_rng(0)
    chosen = random.choice(len(surface), count, replace=False)
    size_in_metres = 1.5 * depth[chosen] / focal
    position = surface[chosen] + random.normal(size=(count, 3)) * size_in_metres[:, None] * 0.2
    arrays = (
        position, random.normal(size=(count, 4)),
        np.log(size_in_metres)[:, None] + 0.2 * random.normal(size=(count, 3)), random.normal(size=count) + 1.0,
        random.uniform(-1, 1, size=(count, 1, 3)), random.normal(size=(count, features)),
    )  # fmt: skip
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.as_tensor(centre)
    return GaussianTensors(*(torch.as_tensor(array, dtype=torch.float32) for array in arrays)), camera, pose


def leaves(scene: GaussianTensors, device: str) -> GaussianTensors:
    return GaussianTensors(**{name: getattr(scene, name).clone().to(device).requires_grad_() for name in PARAMETERS})


@dataclass
class Candidate:
    """A backend with its own copy of the scene."""

    render: Callable[[GaussianTensors], Images]
    scene: GaussianTensors
    grads: Images
    device: str
    forward_ms: list[float] = field(default_factory=list)
    both_ms: list[float] = field(default_factory=list)

    def forward(self) -> None:
        with torch.no_grad():
            self.render(self.scene)

    def both(self) -> None:
        images = self.render(self.scene)
        used = [(image, grad) for image, grad in zip(images, self.grads, strict=True) if image.numel()]
        torch.autograd.backward([image for image, _ in used], [grad for _, grad in used])

    def gradients(self) -> dict[str, torch.Tensor]:
        self.clear()
        self.both()
        return {name: getattr(self.scene, name).grad.cpu() for name in PARAMETERS if getattr(self.scene, name).numel()}

    def clear(self) -> None:
        for name in PARAMETERS:
            getattr(self.scene, name).grad = None

    def measure(self, repeat: int) -> None:
        for _ in range(repeat):
            self.forward_ms.append(_milliseconds(self.forward, self.device))
            self.clear()
            self.both_ms.append(_milliseconds(self.both, self.device))


def _milliseconds(call: Callable[[], None], device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    call()
    if device == "cuda":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) * 1e3


def _ggslam(render: Callable, camera: Camera, pose: torch.Tensor) -> Callable[[GaussianTensors], Images]:
    def run(scene: GaussianTensors) -> Images:
        buffers = render(scene, camera, pose, near_plane=NEAR, low_pass=LOW_PASS)
        features = buffers.features if buffers.features is not None else buffers.image[:0]
        return [buffers.image, buffers.depth, buffers.alpha, features]

    return run


def _gsplat(camera: Camera, pose: torch.Tensor) -> Callable[[GaussianTensors], Images]:
    from gsplat import rasterization

    view = rigid_inverse(pose).float().cuda()[None]
    numbers = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]  # pixel centres at 0.5
    intrinsics = torch.tensor([numbers], dtype=torch.float32, device="cuda")

    def run(scene: GaussianTensors) -> Images:
        colours = torch.cat([0.5 + 0.28209479177387814 * scene.sh[:, 0], scene.features], 1)
        rendered, alpha, _ = rasterization(
            scene.means, scene.quaternions, torch.exp(scene.log_scales), torch.sigmoid(scene.opacity_logits), colours,
            view, intrinsics, camera.width, camera.height, near_plane=NEAR, eps2d=LOW_PASS, render_mode="RGB+D",
            packed=False,
        )  # fmt: skip
        planes = rendered[0].permute(2, 0, 1)
        return [planes[:3], planes[-1], alpha[0, ..., 0], planes[3:-1]]

    return run


def make_candidates(size: tuple[int, int], count: int, features: int, names: list[str]) -> dict[str, Candidate]:
    scene, camera, pose = make_workload(size, count, features)
    torch.manual_seed(0)
    height, width = camera.height, camera.width
    grads = [torch.randn(shape) for shape in ((3, height, width), (height, width), (height, width))]
    grads.append(torch.randn(features, height, width))
    made = {}
    for name in names:
        device = "cpu" if name == "cpu" else "cuda"
        render = _gsplat(camera, pose) if name == "gsplat" else None
        render = render or _ggslam(render_cpu if name == "cpu" else render_cuda, camera, pose)
        made[name] = Candidate(render, leaves(scene, device), [grad.to(device) for grad in grads], device)
    return made


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm().clamp_min(1e-12))


def agreement(candidates: dict[str, Candidate], name: str) -> str:
    """Largest relative errors of images and of gradients against the CPU rasterizer."""
    with torch.no_grad():
        images = [image.cpu() for image in candidates[name].render(candidates[name].scene)]
        expected = candidates["cpu"].render(candidates["cpu"].scene)
    image_error = max(relative(a, b) for a, b in zip(images, expected, strict=True) if b.numel())
    found, wanted = candidates[name].gradients(), candidates["cpu"].gradients()
    gradient_error = max(relative(found[key], wanted[key]) for key in wanted)
    return f"{name} against cpu: images {image_error:.1e}, gradients {gradient_error:.1e}"


def report(label: str, candidates: dict[str, Candidate]) -> None:
    for part, times in (("forward", "forward_ms"), ("forward+backward", "both_ms")):
        median = {name: statistics.median(getattr(c, times)) for name, c in candidates.items() if getattr(c, times)}
        text = f"{label} {part:>16} cuda {median['cuda']:8.3f}"
        for name in ("gsplat", "cpu"):
            if name in median:
                text += f" | {name} {median[name]:9.3f} ratio {median[name] / median['cuda']:7.2f}"
        print(text, flush=True)


def run(size_name: str, count: int, channels: int, names: list[str], options: argparse.Namespace) -> None:
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    candidates = make_candidates(SIZES[size_name], count, channels - 4, names)
    label = f"{size_name:>8} {count:>8} {channels:>2} ch."
    if "cpu" in candidates:
        for name in names[:-1]:
            print(f"{label} {agreement(candidates, name)}", flush=True)
        candidates["cpu"].measure(2)
    on_gpu = [candidate for candidate in candidates.values() if candidate.device == "cuda"]
    for round_number in range(options.repeat + 3):
        for candidate in on_gpu:
            candidate.measure(1)
            if round_number < 3:  # warming up
                candidate.forward_ms.clear()
                candidate.both_ms.clear()
    report(label, candidates)
    print(f"{label} peak memory of all on the GPU: {torch.cuda.max_memory_allocated() / 1e6:.0f} MB", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", nargs="+", type=int, default=[100_000, 300_000, 1_000_000])
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--channels", nargs="+", type=int, choices=[4, 8, 12, 20], default=[4, 20])
    parser.add_argument("--repeat", type=int, default=30)
    parser.add_argument("--no-cpu", action="store_true", help="leave out the CPU rasterizer and comparing with it")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench_cuda_render: torch finds no CUDA device; nothing was measured", file=sys.stderr)
        return 1
    start = time.perf_counter()
    library_for_device()
    print(f"{torch.cuda.get_device_name()}; rasterizer compiled or found in {time.perf_counter() - start:.1f} s")
    names = ["cuda"]
    try:
        import gsplat

        names.append("gsplat")
        print(f"gsplat {gsplat.__version__}")
    except ImportError as error:
        print(f"gsplat is left out: {error}")
    names += [] if options.no_cpu else ["cpu"]
    for size_name in options.sizes:
        for count in options.counts:
            for channels in options.channels:
                run(size_name, count, channels, names, options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
