# SPDX-License-Identifier: Apache-2.0
"""Rendering on CUDA by gsplat (Ye et al. 2024, https://github.com/nerfstudio-project/gsplat), version 1.5.

It keeps the rules of `ggslam.rendering.reference` but for one: gsplat stops a pixel before, not after, the Gaussian
that would take its transmittance below 1e-4. That Gaussian can be nearly opaque and is dropped whole, so a pixel can
differ by up to 0.1 of the colour range (0.095 was seen); most do not differ.
"""

from __future__ import annotations

from typing import Any

import torch

from ggslam.errors import MissingDependency, RenderError
from ggslam.rendering.autograd import rigid_inverse
from ggslam.rendering.reference import renderable, view_colours
from ggslam.rendering.types import LOW_PASS, Gaussians, RenderBuffers, active_coefficients, check_gaussians
from ggslam.scene.camera import Camera


def _rasterization() -> Any:
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise MissingDependency(
            f"the gsplat backend needs the package gsplat and a CUDA device: `pip install 'ggslam[gsplat]'` ({error})"
        ) from error
    return rasterization


def render_gsplat(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: torch.Tensor,
    *,
    features: bool = True,
    median_depth: bool = False,
    active_sh_degree: int | None = None,
    near_plane: float = 0.05,
    low_pass: float = LOW_PASS,
) -> RenderBuffers:
    """Backend "gsplat" of `ggslam.rendering.api.render`; float32 tensors on a CUDA device.

    Raises:
        MissingDependency: gsplat is not installed.
        RenderError: tensors not on a CUDA device, or the median depth was asked for, which gsplat does not offer.
    """
    rasterization = _rasterization()
    check_gaussians(gaussians)
    if gaussians.means.device.type != "cuda" or gaussians.means.dtype != torch.float32:
        found = f"{gaussians.means.dtype} on {gaussians.means.device}"
        raise RenderError(f"the gsplat backend needs float32 on a CUDA device, found {found}")
    if median_depth:
        raise RenderError("the gsplat backend has no median depth")
    coefficients = active_coefficients(gaussians, active_sh_degree)
    view = rigid_inverse(T_world_camera.to(gaussians.means))
    z = gaussians.means.detach() @ view[2, :3].detach() + view[2, 3].detach()
    rows = renderable(gaussians, z, near_plane)

    means = gaussians.means[rows]
    # Colours are evaluated here: they are cut off at black, but not with their gradient as gsplat does.
    channels = view_colours(gaussians.sh[rows][:, :coefficients], means, view)
    with_features = features and gaussians.features.shape[1] > 0
    if with_features:
        channels = torch.cat([channels, gaussians.features[rows]], 1)
    intrinsics = torch.tensor(
        [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]],  # gsplat: pixel centres at 0.5
        dtype=torch.float32, device=means.device,
    )  # fmt: skip
    rendered, alpha, _ = rasterization(
        means,
        gaussians.quaternions[rows],
        torch.exp(gaussians.log_scales[rows]),
        torch.sigmoid(gaussians.opacity_logits[rows]),
        channels,
        view[None],
        intrinsics[None],
        camera.width,
        camera.height,
        near_plane=near_plane,
        eps2d=low_pass,
        render_mode="RGB+D",
        packed=False,
    )
    planes = rendered[0].permute(2, 0, 1)
    return RenderBuffers(
        image=planes[:3],
        depth=planes[-1],
        alpha=alpha[0, ..., 0],
        features=planes[3:-1] if with_features else None,
    )
