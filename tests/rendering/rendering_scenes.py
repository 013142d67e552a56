# SPDX-License-Identifier: Apache-2.0
"""Small scenes, and the float64 reference's gradients of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import PARAMETERS, GaussianTensors, Gradients, RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp

CAMERA = Camera(37, 29, 30.0, 31.0, 18.3, 14.1)
"""No side is a multiple of a tile or sub-block."""

POSE = se3_exp(np.array([0.1, 0.05, 0.2, 0.07, 0.05, 0.1]))


def make_scene(count: int = 200, features: int = 0, coefficients: int = 1, seed: int = 0) -> GaussianTensors:
    """Gaussians of a few pixels in front of `CAMERA`."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    box = torch.rand(count, 3, generator=random)
    means = box * torch.tensor([2.4, 1.8, 2.0]) + torch.tensor([-1.2, -0.9, 1.0])
    return GaussianTensors(
        means, normal(count, 4), 0.4 * normal(count, 3) - 2.6, normal(count) + 0.5,
        0.3 * normal(count, coefficients, 3), normal(count, features),
    )  # fmt: skip


@dataclass
class ImageGradients:
    """Random gradients of a loss with respect to the images."""

    image: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor
    features: torch.Tensor | None

    def loss(self, rendered: RenderBuffers) -> torch.Tensor:
        total = (rendered.image * self.image).sum() + (rendered.depth * self.depth).sum()
        total = total + (rendered.alpha * self.alpha).sum()
        return total if self.features is None else total + (rendered.features * self.features).sum()

    def arguments(self) -> tuple[torch.Tensor | None, ...]:
        return self.image, self.depth, self.alpha, self.features


def make_image_gradients(camera: Camera, features: int, seed: int = 1) -> ImageGradients:
    random = torch.Generator().manual_seed(seed)
    size = (camera.height, camera.width)
    sizes = [(3, *size), size, size, (features, *size)]
    image, depth, alpha, feature = (torch.randn(shape, generator=random) for shape in sizes)
    return ImageGradients(image, depth, alpha, feature if features else None)


def twist_matrix(xi: torch.Tensor) -> torch.Tensor:
    """exp of a twist [6] (translation first) as a 4x4 matrix, differentiable at zero."""
    zero = torch.zeros((), dtype=xi.dtype)
    v, w = xi[:3], xi[3:]
    rows = [[zero, -w[2], w[1], v[0]], [w[2], zero, -w[0], v[1]], [-w[1], w[0], zero, v[2]], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def reference_gradients(
    scene: GaussianTensors, camera: Camera, T_camera_world: np.ndarray, gradients: ImageGradients, **options: object
) -> tuple[RenderBuffers, dict[str, torch.Tensor]]:
    """Images and gradients (of the parameters and the `twist`) by autograd in float64."""
    leaves = {name: getattr(scene, name).double().requires_grad_() for name in PARAMETERS}
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = twist_matrix(twist) @ torch.as_tensor(T_camera_world)
    rendered = render_reference(GaussianTensors(**leaves), camera, pose, **options)  # type: ignore[arg-type]
    gradients.loss(rendered).backward()
    found = {**leaves, "twist": twist}
    return rendered, {name: torch.zeros_like(x) if x.grad is None else x.grad for name, x in found.items()}


def relative_error(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Norm of the difference over the norm of `expected` (at least 1e-12)."""
    return float((found.double() - expected.detach()).norm() / expected.detach().norm().clamp_min(1e-12))


def assert_gradients_agree(found: Gradients, expected: dict[str, torch.Tensor], tolerance: float) -> None:
    for name, gradient in expected.items():
        value = torch.as_tensor(found.twist) if name == "twist" else getattr(found, name)
        if value is None:
            assert gradient.numel() == 0 or not gradient.any()
        elif value.numel():
            assert relative_error(value, gradient) < tolerance, name


def all_arrays(rendered: RenderBuffers, gradients: Gradients) -> dict[str, torch.Tensor]:
    """Copies of everything that came out, to compare bit by bit."""
    arrays = {f"rendered_{name}": value for name, value in vars(rendered).items()}
    arrays |= {name: getattr(gradients, name) for name in (*PARAMETERS, "touched")}
    arrays["twist"] = torch.as_tensor(gradients.twist)
    return {name: value.clone() for name, value in arrays.items() if value is not None}


def render_and_differentiate(
    rasterizer: CpuRasterizer, scene: GaussianTensors, camera: Camera = CAMERA, pose: np.ndarray = POSE, **options: bool
) -> dict[str, torch.Tensor]:
    rendered = rasterizer.forward(scene, camera, pose, **options)
    features = 0 if rendered.features is None else rendered.features.shape[0]
    gradients = rasterizer.backward(*make_image_gradients(camera, features).arguments())
    return all_arrays(rendered, gradients)
