# SPDX-License-Identifier: Apache-2.0
"""How exact the gradients of long, thin splats are in float32: the compiled core and plain torch, both against float64.

One splat at a time, of a given length (standard deviation in the image) and aspect ratio, turned at random, under
random image gradients. Printed are the median and the largest relative error of the gradients of the scales, the
rotation and the mean, each over all draws.

python scripts/benchmarks/bench_gradients.py [--draws 20] [--size 640x480]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.camera import Camera

LENGTHS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
ASPECTS = (1.0, 10.0, 100.0, 1000.0)
DEPTH_M, FOCAL = 2.0, 500.0
NAMES = ("log_scales", "quaternions", "means")


@dataclass
class Errors:
    """Relative errors of the gradients of `NAMES`, one list each."""

    core: dict[str, list[float]]
    torch32: dict[str, list[float]]


def make_splat(length_px: float, aspect: float, camera: Camera, random: np.random.Generator) -> GaussianTensors:
    """One Gaussian facing the camera near the middle of the image, turned at random about the optical axis and a
    little out of the plane."""
    sigma = length_px * DEPTH_M / camera.fx
    angle, tilt = random.uniform(0, math.pi), random.normal(0, 0.1, 2)
    quaternion = np.array([math.cos(angle / 2), *tilt, math.sin(angle / 2)])
    offset = random.uniform(-0.2, 0.2, 2)
    numbers = {
        "means": [[*offset, DEPTH_M]], "quaternions": [quaternion / np.linalg.norm(quaternion)],
        "log_scales": [np.log([sigma, sigma / aspect, sigma / aspect / 1.1])], "opacity_logits": [0.5],
        "sh": [[[0.3, -0.2, 0.5]]], "features": np.zeros((1, 0)),
    }  # fmt: skip
    return GaussianTensors(**{name: torch.tensor(np.array(v), dtype=torch.float32) for name, v in numbers.items()})


def reference_gradients(
    splat: GaussianTensors, camera: Camera, gradient: torch.Tensor, dtype: torch.dtype
) -> dict[str, torch.Tensor]:
    """Gradients of sum(gradient * image) by autograd in the given precision."""
    parts = {name: value.clone().to(dtype).requires_grad_(name in NAMES) for name, value in vars(splat).items()}
    rendered = render_reference(GaussianTensors(**parts), camera, torch.eye(4, dtype=dtype))
    (rendered.image * gradient.to(dtype)).sum().backward()
    return {name: parts[name].grad.double() for name in NAMES}


def measure(length_px: float, aspect: float, camera: Camera, draws: int) -> Errors:
    random = np.random.default_rng(0)
    rasterizer = CpuRasterizer()
    errors = Errors({name: [] for name in NAMES}, {name: [] for name in NAMES})
    for _ in range(draws):
        splat = make_splat(length_px, aspect, camera, random)
        gradient = torch.from_numpy(random.normal(0, 1, (3, camera.height, camera.width)).astype(np.float32))
        exact = reference_gradients(splat, camera, gradient, torch.float64)
        single = reference_gradients(splat, camera, gradient, torch.float32)
        rasterizer.forward(splat, camera, np.eye(4))
        found = rasterizer.backward(gradient)
        for name in NAMES:
            norm = exact[name].norm()
            errors.core[name].append(float((getattr(found, name).double() - exact[name]).norm() / norm))
            errors.torch32[name].append(float((single[name] - exact[name]).norm() / norm))
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20, help="splats of each shape")
    parser.add_argument("--size", default="640x480", help="of the image")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    camera = Camera(width, height, FOCAL, FOCAL, (width - 1) / 2, (height - 1) / 2)
    print("relative errors in percent, median / largest" + " " * 10 + "compiled core" + " " * 12 + "torch float32")
    for length in LENGTHS:
        for aspect in ASPECTS:
            errors = measure(length, aspect, camera, arguments.draws)
            for name in NAMES:
                cells = [
                    f"{100 * np.median(e[name]):11.5f} /{100 * np.max(e[name]):11.5f}"
                    for e in (errors.core, errors.torch32)
                ]
                print(f"sigma {length:5g} px, aspect {aspect:5g}  {name:12}  {cells[0]}  {cells[1]}", flush=True)


if __name__ == "__main__":
    main()
