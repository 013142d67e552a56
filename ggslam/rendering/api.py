# SPDX-License-Identifier: Apache-2.0
"""Rendering for library users: one function, several backends, gradients by torch autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from ggslam.rendering.views import AnyCamera, check_kinds, over, pairs, render_view, stack_views
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
    camera: AnyCamera | Sequence[AnyCamera],
    T_camera_world: torch.Tensor | np.ndarray | None = None,
    *,
    T_world_camera: torch.Tensor | np.ndarray | None = None,
    backend: str = "auto",
    features: bool = True,
    median_depth: bool = False,
    active_sh_degree: int | None = None,
    near_plane: float = 0.05,
    low_pass: float = LOW_PASS,
    background: torch.Tensor | np.ndarray | Sequence[float] | None = None,
) -> RenderBuffers:
    """Renders Gaussians, differentiable with respect to their parameters and to the pose.

    Args:
        gaussians: a `GaussianModel`, a `GaussianMap` or anything else with the tensors of `Gaussians`; float32 on the
            CPU for "cpu", on a CUDA device for "cuda" and "gsplat", any float for "reference".
        camera: a pinhole `Camera`, a `DistortedCamera` (fisheye lenses, too) or an `OrthographicCamera`; or B of them,
            all of one size.
        T_camera_world: [4, 4] rigid transform, world to camera; a tensor may require gradients. The gradient of "cpu"
            and "cuda" is the part along rigid motions. [B, 4, 4] renders a batch, with one camera for all or B.
        T_world_camera: its inverse, camera to world, as trajectories and frames have it. One of the two is given.
        backend: one of `backends()`, or "auto": "cuda" for Gaussians on a CUDA device, else "cpu".
        features: render the feature channels, if there are any.
        median_depth: render the median depth, too.
        active_sh_degree: highest spherical-harmonic degree to evaluate; None: all.
        near_plane: metres; Gaussians whose mean is nearer are left out.
        low_pass: pixels^2 added to both variances of a projected Gaussian.
        background: colour [3] or image [3, H, W] behind the Gaussians, in [0, 1]; None: black.

    Returns:
        `.image` [3, H, W], `.depth` [H, W], `.alpha` [H, W], `.features` [F, H, W] or None, see `RenderBuffers`; the
        caller's own. Of a batch all of them begin with B.

    Raises:
        RenderError: unknown backend, wrong shapes, dtypes or devices, an impossible pose or degree; an orthographic
            camera whose pose requires gradients, or a batch of different sizes.
        MissingDependency: the backend's package is not installed, or it cannot be compiled.
    """
    check_kinds(gaussians, camera)
    if backend == "auto":
        backend = "cuda" if gaussians.means.device.type == "cuda" else "cpu"
    if backend not in _BACKENDS:
        raise RenderError(f"unknown rendering backend {backend!r}; available: {', '.join(_BACKENDS)}")
    poses = _camera_to_world(T_camera_world, T_world_camera)
    options = {"features": features, "median_depth": median_depth, "active_sh_degree": active_sh_degree,
               "near_plane": near_plane, "low_pass": low_pass}  # fmt: skip
    draw = _BACKENDS[backend]
    if isinstance(camera, Sequence) or isinstance(poses, list):
        views = [render_view(draw, gaussians, one, T, **options) for one, T in pairs(camera, poses)]
        view = stack_views(views)
    else:
        view = render_view(draw, gaussians, camera, poses, **options)
    return view if background is None else over(view, background)


def _camera_to_world(
    T_camera_world: torch.Tensor | np.ndarray | None, T_world_camera: torch.Tensor | np.ndarray | None
) -> torch.Tensor | list[torch.Tensor]:
    """T_world_camera as a tensor, or a list of them, whichever of the two was given."""
    if (T_camera_world is None) == (T_world_camera is None):
        raise RenderError("render: expected one of T_camera_world and T_world_camera")
    name = "T_camera_world" if T_world_camera is None else "T_world_camera"
    given = T_camera_world if T_world_camera is None else T_world_camera
    try:
        poses = given if isinstance(given, torch.Tensor) else torch.as_tensor(np.asarray(given, np.float64))
    except (TypeError, ValueError):
        raise RenderError(f"{name}: expected numbers [4, 4] or [B, 4, 4], found {type(given).__name__}") from None
    checked = [_checked_pose(pose, name) for pose in (poses if poses.ndim == 3 else [poses])]
    found = [rigid_inverse(pose) for pose in checked] if T_world_camera is None else checked
    return found if poses.ndim == 3 else found[0]


def _checked_pose(pose: torch.Tensor, name: str) -> torch.Tensor:
    """The pose itself; raises RenderError unless it is rigid."""
    matrix = check_pose(pose.detach().cpu().numpy(), name)
    if not is_valid_pose(matrix):
        raise RenderError(f"{name}: expected a rotation in the upper left, found {matrix[:3, :3].tolist()}")
    return pose
