# SPDX-License-Identifier: Apache-2.0
"""Pictures by lenses that distort, of pinhole pictures that see at least as much.

Up to 110 degrees across one pinhole picture is rendered; wider lenses take the faces of a cube around the camera.
Every pixel is looked up where its ray, by the lens's own formula, meets the picture; between pixels values are
interpolated linearly. The pictures are `FINER` times as fine as the lens, and `low_pass` grows with that, so it is
measured in pixels of the lens. All of it is differentiable with respect to the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.camera_models import DistortedCamera
from ggslam.scene.poses import rotation_about

FINER: Final = 2.0
"""Pixels of a pinhole picture for one of the lens, along a line, at the middle of the view."""
ONE_PICTURE_DEG: Final = 55.0
"""Largest angle to the axis that one pinhole picture shows."""
MAX_SIDE: Final = 8192
"""Largest side of a pinhole picture in pixels; of wider ones the resolution is lower."""
BORDER: Final = 3
"""Pixels beyond the outermost ray on each side."""

RenderPinhole = Callable[[Camera, np.ndarray, float], RenderBuffers]
"""Renders a pinhole camera, which is turned against the lens by T_face_lens [4, 4], at a factor to `low_pass`."""


@dataclass(frozen=True)
class Face:
    """A pinhole picture and the pixels of the lens that are looked up in it.

    Attributes:
        camera: of the picture.
        T_face_lens: float64 [4, 4], a rotation.
        pixels: int64 [n], numbers of the lens's pixels, row by row.
        grid: float32 [n, 2], where they are looked up, as `torch.nn.functional.grid_sample` counts.
        depth_factors: float32 [n], depth along the lens's axis of what has depth 1 m along the face's.
        finer: pixels of the picture for one of the lens.
    """

    camera: Camera
    T_face_lens: np.ndarray
    pixels: np.ndarray
    grid: np.ndarray
    depth_factors: np.ndarray
    finer: float


def render_distorted(camera: DistortedCamera, render_pinhole: RenderPinhole) -> RenderBuffers:
    """The picture by a distorting lens; pixels that see nothing are 0.

    Raises:
        RenderError: the lens sees nothing at all.
    """
    out: dict[str, torch.Tensor] = {}
    for face in faces_of(camera):
        view = render_pinhole(face.camera, face.T_face_lens, face.finer**2)
        device = view.image.device
        pixels = torch.as_tensor(face.pixels, device=device)
        grid, factors = (torch.as_tensor(a, device=device).to(view.image) for a in (face.grid, face.depth_factors))
        for name, image in _images(view).items():
            nearest = name == "median_depth"
            found = _sample_image(image, grid, "nearest" if nearest else "bilinear")
            found = found * factors if name.endswith("depth") else found
            if name not in out:
                out[name] = image.new_zeros(len(found), camera.height * camera.width)
            out[name] = out[name].index_add(1, pixels, found)
    shaped = {name: rows.reshape(-1, camera.height, camera.width) for name, rows in out.items()}
    return RenderBuffers(
        shaped["image"], shaped["depth"][0], shaped["alpha"][0], shaped.get("features"),
        shaped["median_depth"][0] if "median_depth" in shaped else None,
    )  # fmt: skip


def _images(view: RenderBuffers) -> dict[str, torch.Tensor]:
    """All that was rendered, each [C, H, W]."""
    found = {name: getattr(view, name) for name in ("image", "depth", "alpha", "features", "median_depth")}
    return {name: i if i.ndim == 3 else i[None] for name, i in found.items() if i is not None}


def _sample_image(image: torch.Tensor, grid: torch.Tensor, mode: str) -> torch.Tensor:
    """Values [C, n] of an image [C, H, W] at places [n, 2]."""
    found = torch.nn.functional.grid_sample(
        image[None], grid[None, None], mode=mode, padding_mode="border", align_corners=True
    )
    return found[0, :, 0]


@lru_cache(maxsize=4)
def faces_of(camera: DistortedCamera) -> tuple[Face, ...]:
    """The pinhole pictures that a lens's picture is made of."""
    rays = camera.rays().reshape(-1, 3)
    seen = np.flatnonzero(np.isfinite(rays).all(1))
    if not len(seen):
        raise RenderError(f"no direction falls on a pixel of {camera}")
    spacing = _pixel_angle(camera)
    if np.degrees(np.arccos(np.clip(rays[seen, 2], -1, 1))).max() <= ONE_PICTURE_DEG:
        return (_face(rays, seen, np.eye(3), spacing),)
    turns = [np.eye(3), *(rotation_about(np.array([0.0, 1.0, 0.0]), d) for d in (90.0, -90.0, 180.0)),
             *(rotation_about(np.array([1.0, 0.0, 0.0]), d) for d in (90.0, -90.0))]  # fmt: skip
    nearest = np.argmax(np.stack([rays[seen] @ turn[2] for turn in turns]), 0)
    return tuple(_face(rays, seen[nearest == i], turn, spacing) for i, turn in enumerate(turns) if (nearest == i).any())


def _pixel_angle(camera: DistortedCamera) -> float:
    """Median angle between neighbouring rays in radians."""
    rays = camera.rays()
    steps = [np.linalg.norm(np.diff(rays, axis=axis), axis=-1) for axis in (0, 1) if rays.shape[axis] > 1]
    known = np.concatenate([step[np.isfinite(step)] for step in steps]) if steps else np.zeros(0)
    return float(np.median(known)) if len(known) else 1 / max(camera.pinhole.fx, camera.pinhole.fy)


def _face(rays: np.ndarray, pixels: np.ndarray, R_face_lens: np.ndarray, spacing: float) -> Face:
    """The picture that rays [n, 3] number `pixels` are looked up in."""
    turned = rays[pixels] @ R_face_lens.T
    plane = turned[:, :2] / turned[:, 2:]
    low, high = plane.min(0), plane.max(0)
    widest = max(float((high - low).max()), spacing)
    focal = min(FINER / spacing, (MAX_SIDE - 2 * BORDER - 1) / widest)
    width, height = (math.ceil(focal * side) + 2 * BORDER + 1 for side in high - low)
    middle = BORDER - focal * low
    camera = Camera(width, height, focal, focal, float(middle[0]), float(middle[1]))
    places = 2 * (focal * plane + middle) / (np.array([width, height]) - 1) - 1
    T = np.eye(4)
    T[:3, :3] = R_face_lens
    factors = rays[pixels, 2] / turned[:, 2]
    return Face(camera, T, pixels, places.astype(np.float32), factors.astype(np.float32), focal * spacing)
