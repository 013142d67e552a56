# SPDX-License-Identifier: Apache-2.0
"""Arguments of the compiled rasterizers: checked, and in the structures of their C interface."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.errors import RenderError
from ggslam.rendering.types import (
    PARAMETERS,
    Gaussians,
    GaussianTensors,
    RenderBuffers,
    active_coefficients,
    check_gaussians,
    check_pose,
)
from ggslam.scene.camera import Camera

IMAGES = ("image", "depth", "alpha", "features")
"""Rendered images that have gradients, in the order in which `backward` takes them."""


def check_projection(near_plane: float, low_pass: float) -> None:
    """Raises RenderError for an impossible near plane (metres) or low-pass filter (pixels^2)."""
    if not near_plane > 0:
        raise RenderError(f"near_plane must be positive, found {near_plane}")
    if not 0 < low_pass < 1e3:
        raise RenderError(f"low_pass must be positive, found {low_pass}")


def check_tensor(name: str, tensor: torch.Tensor, device: torch.device, shape: torch.Size | None = None) -> None:
    """Raises RenderError unless a tensor is float32, contiguous, on the device and of the shape, if one is given."""
    if shape is not None and tensor.shape != shape:
        raise RenderError(f"{name}: expected shape {list(shape)}, found {list(tensor.shape)}")
    if tensor.dtype != torch.float32 or tensor.device != device:
        place = "the CPU" if device.type == "cpu" else device
        raise RenderError(f"{name}: expected float32 on {place}, found {tensor.dtype} on {tensor.device}")
    if not tensor.is_contiguous():
        raise RenderError(f"{name}: expected a contiguous tensor, found strides {tensor.stride()}")


def checked_parameters(gaussians: Gaussians, device: torch.device) -> GaussianTensors:
    """The parameter arrays without their history.

    Raises:
        RenderError: as `check_gaussians` and `check_tensor`; or a parameter requires gradients, which autograd would
            never get from here.
    """
    tensors = {name: getattr(gaussians, name) for name in PARAMETERS}
    if torch.is_grad_enabled():
        for name, tensor in tensors.items():
            if tensor.requires_grad:
                raise RenderError(
                    f"{name} requires gradients, which rasterizers do not record: call ggslam.render, or render the "
                    "detached parameters or under torch.no_grad()"
                )
    tensors = {name: tensor.detach() for name, tensor in tensors.items()}
    parameters = GaussianTensors(**tensors)
    check_gaussians(parameters)
    for name, tensor in tensors.items():
        check_tensor(name, tensor, device)
    return parameters


def gaussian_arrays(
    parameters: GaussianTensors, features: bool, active_sh_degree: int | None
) -> structures.GaussianArrays:
    """Where the parameters lie and what of them is rendered; the tensors must stay alive."""
    p = parameters
    return structures.GaussianArrays(
        count=p.means.shape[0], means=p.means.data_ptr(), quaternions=p.quaternions.data_ptr(),
        log_scales=p.log_scales.data_ptr(), opacity_logits=p.opacity_logits.data_ptr(), sh=p.sh.data_ptr(),
        features=p.features.data_ptr(),
        sh_coefficients=parameters.sh.shape[1],
        active_sh_coefficients=active_coefficients(parameters, active_sh_degree),
        feature_channels=parameters.features.shape[1],
        render_features=int(features and parameters.features.shape[1] > 0),
    )  # fmt: skip


def posed_view(
    camera: Camera, T_camera_world: np.ndarray, near_plane: float, low_pass: float
) -> structures.CameraView:
    """Camera and pose [4, 4]; raises RenderError as `check_pose`."""
    view = camera_view(camera, near_plane, low_pass)
    view.camera_world[:] = check_pose(T_camera_world)[:3].ravel().tolist()
    return view


def camera_view(camera: Camera, near_plane: float, low_pass: float) -> structures.CameraView:
    """The camera without its pose, which stays zero."""
    return structures.CameraView(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, near_plane, low_pass
    )


def image_buffers(
    images: dict[str, torch.Tensor], camera: Camera, channels: int, median_depth: bool, device: torch.device
) -> RenderBuffers:
    """Images to render to, from `images` where they fit; others are made and put there."""

    def image(name: str, *shape: int) -> torch.Tensor:
        found = images.get(name)
        if found is None or found.shape != shape:
            found = images[name] = torch.empty(shape, dtype=torch.float32, device=device)
        return found

    size = (camera.height, camera.width)
    return RenderBuffers(
        image=image("image", 3, *size),
        depth=image("depth", *size),
        alpha=image("alpha", *size),
        features=image("features", channels, *size) if channels else None,
        median_depth=image("median_depth", *size) if median_depth else None,
    )


def image_gradients(
    buffers: RenderBuffers, grads: tuple[torch.Tensor | None, ...], detach_features: bool, device: torch.device
) -> structures.ImageGradients:
    """Gradients with respect to `IMAGES`, None for zero; raises RenderError where they do not fit the images."""
    given = dict(zip(IMAGES, grads, strict=True))
    if given["features"] is not None and buffers.features is None:
        raise RenderError("grad_features was given, but no features were rendered")
    for name, gradient in given.items():
        if gradient is not None:
            check_tensor(f"grad_{name}", gradient, device, getattr(buffers, name).shape)
    addresses = {name: None if gradient is None else gradient.data_ptr() for name, gradient in given.items()}
    return structures.ImageGradients(**addresses, detach_features=int(detach_features))
