# SPDX-License-Identifier: Apache-2.0
"""The CPU rasterizer as a torch operation, with gradients to all parameters and to the camera pose."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import torch

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors, RenderBuffers
from ggslam.scene.camera import Camera

_local = threading.local()


def _rasterizer() -> CpuRasterizer:
    """One rasterizer per calling thread."""
    if not hasattr(_local, "rasterizer"):
        _local.rasterizer = CpuRasterizer()
    return _local.rasterizer


class _Render(torch.autograd.Function):
    """Inputs: the six parameter arrays, T_world_camera, and what to render. Outputs: image, depth, alpha, features,
    median depth; the last two may be None."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[torch.Tensor | None, ...]:
        parameters, (T_world_camera, camera, options) = list(inputs[:-3]), inputs[-3:]
        ctx.save_for_backward(*parameters, T_world_camera)
        ctx.camera, ctx.options = camera, options
        ctx.rasterizer = _rasterizer()
        buffers = _forward(ctx.rasterizer, parameters, T_world_camera, camera, options)
        ctx.rendering = ctx.rasterizer.rendering
        images = (buffers.image, buffers.depth, buffers.alpha, buffers.features, buffers.median_depth)
        outputs = tuple(None if image is None else image.clone() for image in images)
        if outputs[4] is not None:
            ctx.mark_non_differentiable(outputs[4])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        *parameters, T_world_camera = ctx.saved_tensors
        if ctx.rasterizer.rendering != ctx.rendering:  # it has rendered something else meanwhile: render again
            _forward(ctx.rasterizer, parameters, T_world_camera, ctx.camera, ctx.options)
            ctx.rendering = ctx.rasterizer.rendering
        image, depth, alpha, features = (None if g is None else g.contiguous() for g in grads[:4])
        result = ctx.rasterizer.backward(image, depth, alpha, features)
        pose = twist_to_matrix_gradient(result.twist, T_world_camera.detach().cpu().numpy())
        return (
            *(getattr(result, name) for name in PARAMETERS),
            torch.as_tensor(pose).to(T_world_camera),
            None,
            None,
        )


def _forward(
    rasterizer: CpuRasterizer,
    parameters: list[torch.Tensor],
    T_world_camera: torch.Tensor,
    camera: Camera,
    options: dict[str, Any],
) -> RenderBuffers:
    options = dict(options)
    rasterizer.near_plane, rasterizer.low_pass = options.pop("near_plane"), options.pop("low_pass")
    T_camera_world = rigid_inverse(T_world_camera.detach().double().cpu()).numpy()
    return rasterizer.forward(GaussianTensors(*parameters), camera, T_camera_world, **options)


def rigid_inverse(T: torch.Tensor) -> torch.Tensor:
    """Inverse of a rigid transform [4, 4]; differentiable."""
    R = T[:3, :3].T
    top = torch.cat([R, -(R @ T[:3, 3:])], 1)
    return torch.cat([top, T.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def twist_to_matrix_gradient(twist: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """Gradient [4, 4] with respect to the entries of T_world_camera from d loss / d xi (`Gradients.twist`).

    It is the gradient's part along rigid motions, which is all that a parametrisation of poses can see: with
    T_camera_world <- exp(xi) T_camera_world, T_world_camera changes by -T_world_camera xi^.
    """
    R = np.asarray(T_world_camera, np.float64)[:3, :3]
    x, y, z = twist[3:]
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = -0.5 * R @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    gradient[:3, 3] = -R @ twist[:3]
    return gradient


def render_cpu(gaussians: Gaussians, camera: Camera, T_world_camera: torch.Tensor, **options: Any) -> RenderBuffers:
    """Backend "cpu" of `ggslam.rendering.api.render`. Images are the caller's own."""
    parameters = [getattr(gaussians, name).contiguous() for name in PARAMETERS]
    image, depth, alpha, features, median = _Render.apply(*parameters, T_world_camera, camera, options)
    return RenderBuffers(image, depth, alpha, features, median)
