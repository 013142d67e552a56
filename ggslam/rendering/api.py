# SPDX-License-Identifier: Apache-2.0
"""Rendering for library users: one function, several backends, gradients by torch autograd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ggslam.cuda.availability import cuda_backend_problem
from ggslam.errors import RenderError
from ggslam.rendering.autograd import render_cpu, rigid_inverse
from ggslam.rendering.cuda.autograd import render_cuda
from ggslam.rendering.gsplat_backend import render_gsplat
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import LOW_PASS, Gaussians, RenderBuffers, check_pose
from ggslam.scene.camera import Camera
from ggslam.scene.poses import is_valid_pose

Backend = Callable[..., RenderBuffers]


def _reference(gaussians: Gaussians, camera: Camera, T_world_camera: torch.Tensor, **options: Any) -> RenderBuffers:
    return render_reference(gaussians, camera, rigid_inverse(T_world_camera).to(gaussians.means), **options)


_BACKENDS: dict[str, Backend] = {
    "cpu": render_cpu, "cuda": render_cuda, "gsplat": render_gsplat, "reference": _reference,
}  # fmt: skip


def register_backend(name: str, backend: Backend) -> None:
    """Adds a backend, called as backend(gaussians, camera, T_world_camera tensor, features=, median_depth=,
    active_sh_degree=, near_plane=, low_pass=). Its contract is that of `ggslam.rendering.reference`."""
    _BACKENDS[name] = backend


def backends() -> list[str]:
    """Names of the backends, whether or not they can be used here. "auto" stands for `choose_backend`."""
    return list(_BACKENDS)


def choose_backend(device: torch.device | None = None) -> str:
    """The backend that "auto" stands for.

    Args:
        device: of the Gaussians; None: they can be anywhere.

    Returns:
        "cuda" if there is a CUDA device, not ruled out by `device`, for which the rasterizer can be compiled;
        else "cpu".
    """
    ruled_out = device is not None and device.type != "cuda"
    return "cuda" if not ruled_out and torch.cuda.is_available() and cuda_backend_problem() is None else "cpu"


def render(
    gaussians: Gaussians,
    camera: Camera,
    T_camera_world: torch.Tensor | np.ndarray | None = None,
    *,
    T_world_camera: torch.Tensor | np.ndarray | None = None,
    backend: str = "auto",
    features: bool = True,
    median_depth: bool = False,
    active_sh_degree: int | None = None,
    near_plane: float = 0.05,
    low_pass: float = LOW_PASS,
) -> RenderBuffers:
    """Renders Gaussians, differentiable with respect to their parameters and to the pose.

    Args:
        gaussians: a `GaussianModel`, a `GaussianMap` or anything else with the tensors of `Gaussians`; float32 on the
            CPU for "cpu", on a CUDA device for "cuda" and "gsplat", any float for "reference".
        camera: the camera.
        T_camera_world: [4, 4] rigid transform, world to camera; a tensor may require gradients. The gradient of "cpu"
            and "cuda" is the part along rigid motions.
        T_world_camera: its inverse, camera to world, as trajectories and frames have it. One of the two is given.
        backend: one of `backends()`, or "auto": "cuda" for Gaussians on a CUDA device, else "cpu".
        features: render the feature channels, if there are any.
        median_depth: render the median depth, too.
        active_sh_degree: highest spherical-harmonic degree to evaluate; None: all.
        near_plane: metres; Gaussians whose mean is nearer are left out.
        low_pass: pixels^2 added to both variances of a projected Gaussian.

    Returns:
        `.image` [3, H, W], `.depth` [H, W], `.alpha` [H, W], `.features` [F, H, W] or None, see `RenderBuffers`; the
        caller's own.

    Raises:
        RenderError: unknown backend, wrong shapes, dtypes or devices, an impossible pose or degree.
        MissingDependency: the backend's package is not installed, or it cannot be compiled.
    """
    if backend == "auto":
        backend = "cuda" if gaussians.means.device.type == "cuda" else "cpu"
    if backend not in _BACKENDS:
        raise RenderError(f"unknown rendering backend {backend!r}; available: {', '.join(_BACKENDS)}")
    return _BACKENDS[backend](
        gaussians,
        camera,
        _camera_to_world(T_camera_world, T_world_camera),
        features=features,
        median_depth=median_depth,
        active_sh_degree=active_sh_degree,
        near_plane=near_plane,
        low_pass=low_pass,
    )


def _camera_to_world(
    T_camera_world: torch.Tensor | np.ndarray | None, T_world_camera: torch.Tensor | np.ndarray | None
) -> torch.Tensor:
    """T_world_camera as a tensor, whichever of the two was given."""
    if (T_camera_world is None) == (T_world_camera is None):
        raise RenderError("render: expected one of T_camera_world and T_world_camera")
    name = "T_camera_world" if T_world_camera is None else "T_world_camera"
    given = T_camera_world if T_world_camera is None else T_world_camera
    pose = given if isinstance(given, torch.Tensor) else torch.as_tensor(np.asarray(given, np.float64))
    matrix = check_pose(pose.detach().cpu().numpy(), name)
    if not is_valid_pose(matrix):
        raise RenderError(f"{name}: expected a rotation in the upper left, found {matrix[:3, :3].tolist()}")
    return rigid_inverse(pose) if T_world_camera is None else pose
