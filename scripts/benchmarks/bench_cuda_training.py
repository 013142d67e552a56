# SPDX-License-Identifier: Apache-2.0
"""Speed of the CUDA kernels that train the map: the fused image loss, and Adam fused into the backward pass.

    python scripts/benchmarks/bench_cuda_training.py [--counts 100000 300000] [--sizes 640x480] [--repeat 50]

Loss: value and all gradients, against the same terms written in torch with autograd on the same GPU, and against the
CPU core. Step: backward and optimizer of a map on the GPU, against backward and torch's fused Adam, and against the CPU
core. Iteration: forward, loss and step on the GPU against the CPU core; the workload is that of bench_cuda_render.py.
Prints median times in milliseconds and ratios other / ggslam on the GPU (above 1: ggslam on the GPU is faster). The
candidates take turns within each repetition; torch's Adam moves every Gaussian, ours those in view.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable

import torch
from bench_cuda_render import SIZES, make_workload
from bench_loss import View, make_view
from timing import seconds

from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.losses import ssim_map
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse

Call = Callable[[], object]
CPU = torch.device("cpu")
RATE = 1e-7


def waiting(call: Call, device: torch.device) -> Call:
    """The call, and what it started on the device."""

    def run() -> None:
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()

    return run


def report(label: str, calls: dict[str, Call], device: torch.device, repeat: int) -> None:
    """The first of the calls is what the others are compared with; "cpu" is measured a few times only."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for round_number in range(repeat + 3):
        for name, call in calls.items():
            if name != "cpu" or round_number < 6:
                times[name] += seconds(waiting(call, device), 1)
    median = {name: 1e3 * statistics.median(found[3:]) for name, found in times.items()}
    first, *others = median
    text = "".join(f" | {name} {median[name]:9.3f} ratio {median[name] / median[first]:7.2f}" for name in others)
    print(f"{label:>34} {first} {median[first]:8.3f}{text}", flush=True)


def torch_loss(view: View, target: LossTarget, settings: LossSettings, device: torch.device) -> Call:
    """The default terms of the loss, by autograd."""
    leaves = [value.to(device).requires_grad_() for value in (view.image, view.depth)]
    y = target.color.permute(2, 0, 1).float() / 255
    target_depth = target.depth.to(torch.int32).float() * target.depth_scale
    valid, w = target_depth > 0, settings.dssim_weight

    def call() -> None:
        image, depth = leaves
        with torch.device(device):  # the window is made there
            loss = (1 - w) * (image - y).abs().mean() + w * (1 - ssim_map(image, y).mean())
        error = torch.where(valid, (depth - target_depth).abs(), 0.0).sum() / valid.sum()
        torch.autograd.grad(loss + settings.depth_weight * error, leaves)

    return call


def on_device(target: LossTarget, device: torch.device) -> LossTarget:
    color, depth = torch.from_numpy(target.color).to(device), torch.from_numpy(target.depth).to(device)
    return LossTarget(color, depth, target.depth_scale)


def bench_loss(label: str, size: tuple[int, int], fused: CudaImageLoss, repeat: int) -> None:
    view, target = make_view(*size)
    moved, device_target = (
        View(*(value.to(fused.device) for value in vars(view).values())),
        on_device(target, fused.device),
    )
    cpu, settings = CpuImageLoss(NativeContext()), LossSettings()
    calls: dict[str, Call] = {
        "cuda": lambda: fused.evaluate(moved, device_target, settings),
        "torch": torch_loss(view, device_target, settings, fused.device),
        "cpu": lambda: cpu.evaluate(view, target, settings),
    }
    report(f"{label} loss", calls, fused.device, repeat)


def make_map(scene: GaussianTensors, device: torch.device) -> GaussianMap:
    gaussians = GaussianMap(0, scene.features.shape[1], device)
    rows = {name: getattr(scene, name).to(device) for name in PARAMETERS if name != "sh"}
    gaussians.insert(**rows, rgb=scene.sh[:, 0].to(device))
    return gaussians


def bench_step(
    label: str, scene: GaussianTensors, camera: Camera, pose: torch.Tensor, rasterizer: CudaRasterizer, repeat: int
) -> None:
    # Steps so small that the workload stays as it is.
    T_camera_world, settings = inverse(pose.numpy()), AdamSettings(dict.fromkeys(ADAM_GROUPS, RATE))
    view, target = make_view(camera.width, camera.height)
    loss, device_target = CudaImageLoss(rasterizer.device, rasterizer.library), on_device(target, rasterizer.device)
    ours, theirs = make_map(scene, rasterizer.device), make_map(scene, rasterizer.device)
    leaves = [torch.nn.Parameter(getattr(theirs, name)) for name in PARAMETERS if getattr(theirs, name).numel()]
    adam = torch.optim.Adam(leaves, lr=RATE, eps=1e-15, fused=True)
    mine, cpu_map = View(*(value.to(rasterizer.device) for value in vars(view).values())), make_map(scene, CPU)
    cpu, cpu_loss = CpuRasterizer(), CpuImageLoss(NativeContext())

    def fused() -> None:
        view = rasterizer.forward(ours, camera, T_camera_world)
        rasterizer.backward_step(ours, mine.image, mine.depth, view.alpha, view.features, optimizer=settings)

    def separate() -> None:
        view = rasterizer.forward(theirs, camera, T_camera_world)
        gradients = rasterizer.backward(mine.image, mine.depth, view.alpha, view.features)
        found = [getattr(gradients, name) for name in PARAMETERS if getattr(gradients, name) is not None]
        for leaf, gradient in zip(leaves, found, strict=True):
            leaf.grad = gradient
        adam.step()

    def iteration() -> None:
        result = loss.evaluate(rasterizer.forward(ours, camera, T_camera_world), device_target, LossSettings())
        rasterizer.backward_step(ours, result.d_image, result.d_depth, result.d_alpha, optimizer=settings)

    def cpu_iteration() -> None:
        result = cpu_loss.evaluate(cpu.forward(cpu_map, camera, T_camera_world), target, LossSettings())
        cpu.backward_step(cpu_map, result.d_image, result.d_depth, result.d_alpha, optimizer=settings)

    report(f"{label} forward+step", {"fused": fused, "torch Adam": separate}, rasterizer.device, repeat)
    report(f"{label} iteration", {"cuda": iteration, "cpu": cpu_iteration}, rasterizer.device, repeat)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", nargs="+", type=int, default=[100_000, 300_000])
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--features", nargs="+", type=int, default=[0, 16])
    parser.add_argument("--repeat", type=int, default=50)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench_cuda_training: torch finds no CUDA device; nothing was measured", file=sys.stderr)
        return 1
    print(torch.cuda.get_device_name())
    rasterizer, loss = CudaRasterizer(), CudaImageLoss()
    for name in options.sizes:
        bench_loss(name, SIZES[name], loss, options.repeat)
        for count in options.counts:
            for features in options.features:
                scene, camera, pose = make_workload(SIZES[name], count, features)
                bench_step(f"{name} {count} {features + 4} ch.", scene, camera, pose, rasterizer, options.repeat)
    return 0


if __name__ == "__main__":
    sys.exit(main())
