# SPDX-License-Identifier: Apache-2.0
"""3D Gaussian Splatting as its paper and its published rasterizer draw it, Gaussian by Gaussian in float64: slow, and
without any of ggslam's code.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023; Zwicker et al., "EWA Volume
Splatting", 2001. One thing is left out: the published rasterizer cuts a Gaussian off where the tiles end that its
three standard deviations reach; other renderers do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from splat_maps import Splats

MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
VIEW_MARGIN = 1.3
"""Where the projection is linearised at most, in half widths of the image from its middle."""


@dataclass(frozen=True)
class Rules:
    """In what renderers differ. The defaults are the published rasterizer's.

    Attributes:
        low_pass: pixels^2, added to both variances of a projected Gaussian.
        near: metres; what is not farther is left out.
        max_alpha: of a contribution.
        draws_last: the Gaussian after which less than `MIN_TRANSMITTANCE` is left is still drawn.
        clamps_colors: colours below 0 are 0.
    """

    low_pass: float = 0.3
    near: float = 0.2
    max_alpha: float = 0.99
    draws_last: bool = False
    clamps_colors: bool = True


@dataclass(frozen=True)
class Pinhole:
    """A camera: pixels; the centre of the top-left pixel is (0, 0); x right, y down, z forward."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def centred(width: int = 96, height: int = 72, focal: float = 80.0) -> Pinhole:
        return Pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """T_camera_world of a camera that looks from one point at another; y of the world is down."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = [right, np.cross(forward, right), forward]
    T[:3, 3] = -T[:3, :3] @ np.array(eye, float)
    return T


def render(splats: Splats, camera: Pinhole, T_camera_world: np.ndarray, rules: Rules | None = None) -> np.ndarray:
    """The picture over black, float64 [H, W, 3], not limited to 1."""
    rules = rules or Rules()
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    points = splats.means.astype(float) @ R.T + t
    seen = np.flatnonzero((points[:, 2] > rules.near) & (splats.opacities >= MIN_ALPHA))
    splats, points = splats.take(seen), points[seen]
    middles, covariances = _project(splats, points, camera, R, rules.low_pass)
    colors = splats.colors(splats.means + R.T @ t)  # along the rays from the camera's centre, -R^T t
    colors = np.maximum(colors, 0) if rules.clamps_colors else colors
    inverses = np.linalg.inv(covariances)
    # Outside of this ellipse a contribution is below 1/255.
    reach = np.sqrt(2 * np.log(splats.opacities / MIN_ALPHA))[:, None] * np.sqrt(
        np.stack([covariances[:, 0, 0], covariances[:, 1, 1]], 1)
    )
    first = np.clip(np.ceil(middles - reach), 0, [camera.width, camera.height]).astype(int)
    last = np.clip(np.floor(middles + reach) + 1, 0, [camera.width, camera.height]).astype(int)
    image, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    for i in np.argsort(points[:, 2], kind="stable"):
        if (last[i] <= first[i]).any():
            continue
        box = slice(first[i, 1], last[i, 1]), slice(first[i, 0], last[i, 0])
        x = np.arange(first[i, 0], last[i, 0]) - middles[i, 0]
        y = (np.arange(first[i, 1], last[i, 1]) - middles[i, 1])[:, None]
        (a, b), (_, c) = inverses[i]
        alpha = np.minimum(splats.opacities[i] * np.exp(-(a * x * x + 2 * b * x * y + c * y * y) / 2), rules.max_alpha)
        _blend(image[box], left[box], alpha, colors[i], rules.draws_last)
    return image


def _blend(image: np.ndarray, left: np.ndarray, alpha: np.ndarray, color: np.ndarray, draws_last: bool) -> None:
    """Lays a Gaussian behind what a part of the picture shows; `left`: what still comes through there, less than
    `MIN_TRANSMITTANCE` where nothing does any more."""
    drawn = (alpha >= MIN_ALPHA) & (left >= MIN_TRANSMITTANCE)
    after = left * (1 - alpha)
    ends = drawn & (after < MIN_TRANSMITTANCE)
    weight = np.where(drawn if draws_last else drawn & ~ends, alpha * left, 0)
    image += weight[..., None] * color
    left[drawn] = after[drawn]


def _project(
    splats: Splats, points: np.ndarray, camera: Pinhole, R: np.ndarray, low_pass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Middles [N, 2] in pixels and covariances [N, 2, 2] in pixels^2."""
    x, y, z = points.T
    middles = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
    wide, high = VIEW_MARGIN * camera.width / (2 * camera.fx), VIEW_MARGIN * camera.height / (2 * camera.fy)
    J = np.zeros((len(points), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx / z, -camera.fx * np.clip(x / z, -wide, wide) / z
    J[:, 1, 1], J[:, 1, 2] = camera.fy / z, -camera.fy * np.clip(y / z, -high, high) / z
    M = J @ R
    return middles, M @ splats.covariances() @ M.transpose(0, 2, 1) + low_pass * np.eye(2)


def decibels(images: list[np.ndarray], references: list[np.ndarray]) -> float:
    """Peak signal-to-noise ratio over all pixels of all pictures, as shown: between 0 and 1. Inf: the same."""
    error = np.mean([np.square(a.clip(0, 1) - b.clip(0, 1)) for a, b in zip(images, references, strict=True)])
    return -10 * math.log10(error) if error else math.inf
