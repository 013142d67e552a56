# SPDX-License-Identifier: Apache-2.0
"""The CUDA rasterizer as a torch operation, with gradients to all parameters and to the camera pose."""

from __future__ import annotations

import threading
from typing import Any

import torch

from ggslam.cuda.memory import GrowingMemory
from ggslam.errors import RenderError
from ggslam.rendering.autograd import rigid_inverse
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors, RenderBuffers
from ggslam.scene.camera import Camera

_local = threading.local()


def _rasterizer(device: torch.device) -> CudaRasterizer:
    """One rasterizer per calling thread and device."""
    if not hasattr(_local, "rasterizers"):
        _local.rasterizers = {}
    if device not in _local.rasterizers:
        _local.rasterizers[device] = CudaRasterizer(device)
    return _local.rasterizers[device]


class _Render(torch.autograd.Function):
    """Inputs: the six parameter arrays, T_world_camera, and what to render by what. Outputs: image, depth, alpha,
    features, median depth; the last two may be None. Every rendering has memory of its own until it is differentiated
    or forgotten."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[torch.Tensor | None, ...]:
        parameters, (T_world_camera, camera, rasterizer, options) = list(inputs[:-4]), inputs[-4:]
        ctx.save_for_backward(*parameters, T_world_camera)
        ctx.rasterizer, ctx.memory = rasterizer, GrowingMemory(rasterizer.device)
        options = dict(options)
        rasterizer.near_plane, rasterizer.low_pass = options.pop("near_plane"), options.pop("low_pass")
        pose = rigid_inverse(T_world_camera.detach().double().cpu()).numpy()
        ctx.rendering = rasterizer.render(GaussianTensors(*parameters), camera, pose, ctx.memory, {}, **options)
        buffers = ctx.rendering.buffers
        images = (buffers.image, buffers.depth, buffers.alpha, buffers.features, buffers.median_depth)
        # New tensors: outputs that the context itself holds would keep it, and all its memory, alive for ever.
        outputs = tuple(None if image is None else image.detach() for image in images)
        if outputs[4] is not None:
            ctx.mark_non_differentiable(outputs[4])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        *_, T_world_camera = ctx.saved_tensors  # checks that no parameter was changed since
        given = tuple(None if g is None else g.contiguous() for g in grads[:4])
        result = ctx.rasterizer.differentiate(ctx.rendering, given, ctx.memory)
        pose = None
        if ctx.needs_input_grad[len(PARAMETERS)]:
            pose = _pose_gradient(result.twist.to(T_world_camera), T_world_camera)
        return (*(getattr(result, name) for name in PARAMETERS), pose, None, None, None)


def _pose_gradient(twist: torch.Tensor, T_world_camera: torch.Tensor) -> torch.Tensor:
    """`ggslam.rendering.autograd.twist_to_matrix_gradient` where the pose is, without waiting for the device."""
    R = T_world_camera[:3, :3]
    gradient = torch.zeros_like(T_world_camera)
    # Columns of [omega]x R^T are omega x (rows of R): R [omega]x is minus its transpose.
    gradient[:3, :3] = 0.5 * torch.linalg.cross(twist[3:].expand(3, 3), R)
    gradient[:3, 3] = -R @ twist[:3]
    return gradient


def render_cuda(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: torch.Tensor,
    *,
    rasterizer: CudaRasterizer | None = None,
    **options: Any,
) -> RenderBuffers:
    """Backend "cuda" of `ggslam.rendering.api.render`. Images are the caller's own.

    Args:
        rasterizer: to render with; None: one of the calling thread's own.

    Raises:
        RenderError: as `CudaRasterizer`; tensors not on a CUDA device.
        MissingDependency: the rasterizer cannot be compiled.
    """
    device = gaussians.means.device
    if rasterizer is None:
        if device.type != "cuda":
            found = f"{gaussians.means.dtype} on {device}"
            raise RenderError(f"the cuda backend needs float32 on a CUDA device, found {found}")
        rasterizer = _rasterizer(device)
    parameters = [getattr(gaussians, name).contiguous() for name in PARAMETERS]
    image, depth, alpha, features, median = _Render.apply(*parameters, T_world_camera, camera, rasterizer, options)
    return RenderBuffers(image, depth, alpha, features, median)
