# SPDX-License-Identifier: Apache-2.0
"""Views by cameras of all kinds, batches of them, and what stands behind the Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.rendering.distorted import render_distorted
from ggslam.rendering.orthographic import STRETCH, narrow_gaussians, pinhole_like
from ggslam.rendering.types import PARAMETERS, Gaussians, RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.camera_models import DistortedCamera, OrthographicCamera

AnyCamera = Camera | DistortedCamera | OrthographicCamera
"""What Gaussians can be seen by."""


def check_kinds(gaussians: object, camera: object) -> None:
    """Raises RenderError, in words, for what is no set of Gaussians or no camera."""
    for name in PARAMETERS:
        if not isinstance(getattr(gaussians, name, None), torch.Tensor):
            raise RenderError(
                f"gaussians: expected a GaussianMap, GaussianModel or what has their tensors {', '.join(PARAMETERS)}"
                f", found {type(gaussians).__name__} without a tensor {name!r}"
            )
    listed = isinstance(camera, Sequence) and not isinstance(camera, str)
    for one in camera if listed else [camera]:  # type: ignore[attr-defined]
        if not isinstance(one, AnyCamera):
            raise RenderError(
                f"camera: expected a Camera, DistortedCamera or OrthographicCamera, found {type(one).__name__}"
            )


def render_view(
    draw: Callable[..., RenderBuffers], gaussians: Gaussians, camera: AnyCamera, T_world_camera: torch.Tensor,
    **options: Any,
) -> RenderBuffers:  # fmt: skip
    """One view by a backend, which draws pinhole cameras; the options are those of `ggslam.render`."""
    if isinstance(camera, Camera):
        return draw(gaussians, camera, T_world_camera, **options)
    if isinstance(camera, OrthographicCamera):
        return _render_orthographic(draw, gaussians, camera, T_world_camera, **options)

    def render_pinhole(face: Camera, T_face_lens: np.ndarray, finer: float) -> RenderBuffers:
        T_lens_face = torch.as_tensor(T_face_lens.T.copy()).to(T_world_camera)
        own = {**options, "low_pass": options["low_pass"] * finer}
        return draw(gaussians, face, T_world_camera @ T_lens_face, **own)

    return render_distorted(camera, render_pinhole)


def _render_orthographic(
    draw: Callable[..., RenderBuffers], gaussians: Gaussians, camera: OrthographicCamera, T_world_camera: torch.Tensor,
    near_plane: float, active_sh_degree: int | None, **options: Any,
) -> RenderBuffers:  # fmt: skip
    if T_world_camera.requires_grad:
        raise RenderError("an orthographic view has no gradient with respect to the pose: detach it")
    T_camera_world = np.linalg.inv(T_world_camera.cpu().double().numpy())
    moved = narrow_gaussians(gaussians, T_camera_world, active_sh_degree)
    origin = torch.eye(4, dtype=torch.float64)
    view = draw(moved, pinhole_like(camera), origin.to(gaussians.means.device),
                near_plane=near_plane * STRETCH, active_sh_degree=None, **options)  # fmt: skip
    median = None if view.median_depth is None else view.median_depth / STRETCH
    return replace(view, depth=view.depth / STRETCH, median_depth=median)


def pairs(
    camera: AnyCamera | Sequence[AnyCamera], poses: torch.Tensor | list[torch.Tensor]
) -> list[tuple[AnyCamera, torch.Tensor]]:
    """Camera and T_world_camera of each view of a batch.

    Raises:
        RenderError: there are none, or as many cameras as poses neither; or their images are of different sizes.
    """
    cameras = list(camera) if isinstance(camera, Sequence) else [camera]
    matrices = poses if isinstance(poses, list) else [poses]
    count = max(len(cameras), len(matrices))
    if not cameras or not matrices or len(cameras) not in (1, count) or len(matrices) not in (1, count):
        raise RenderError(f"render: {len(cameras)} cameras do not go with {len(matrices)} poses")
    sizes = {(one.width, one.height) for one in cameras}
    if len(sizes) > 1:
        raise RenderError(f"render: a batch needs cameras of one size, found {sorted(sizes)}")
    cameras = cameras if len(cameras) == count else cameras * count
    matrices = matrices if len(matrices) == count else matrices * count
    return list(zip(cameras, matrices, strict=True))


def stack_views(views: list[RenderBuffers]) -> RenderBuffers:
    """The views of a batch as one, all images beginning with their number."""
    return RenderBuffers(
        torch.stack([view.image for view in views]),
        torch.stack([view.depth for view in views]),
        torch.stack([view.alpha for view in views]),
        _stack_if_there([view.features for view in views]),
        _stack_if_there([view.median_depth for view in views]),
    )


def _stack_if_there(images: list[torch.Tensor | None]) -> torch.Tensor | None:
    there = [image for image in images if image is not None]
    return torch.stack(there) if there else None


def over(view: RenderBuffers, background: torch.Tensor | np.ndarray | Sequence[float]) -> RenderBuffers:
    """The view over a colour [3] or an image [3, H, W]; raises RenderError for other shapes."""
    try:
        behind = torch.as_tensor(background).to(view.image)
    except (TypeError, ValueError):
        raise RenderError(f"background: expected numbers [3] or [3, H, W], found {background!r:.80}") from None
    size = tuple(view.image.shape[-2:])
    if behind.shape not in ((3,), (3, *size)):
        raise RenderError(f"background: expected shape [3] or {[3, *size]}, found {list(behind.shape)}")
    behind = behind.reshape(3, *(behind.shape[1:] or (1, 1)))
    return replace(view, image=view.image + (1 - view.alpha).unsqueeze(-3) * behind)
