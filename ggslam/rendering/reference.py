# SPDX-License-Identifier: Apache-2.0
"""The rendering rules, as the plainest torch code: dense, differentiable by autograd, any float dtype, slow.

This file is the contract; the other backends are tested against it.

1.  A Gaussian is skipped if its depth z in the camera is under the near plane or above 1e6 m, if any of its numbers is
    not finite (features apart, which are not looked at), if a log_scale lies outside [-23, 10] or if the squared norm
    of its quaternion lies outside [1e-20, 1e20]. Skipped Gaussians get zero gradients.
2.  Projection (EWA splatting, Zwicker et al. 2001): the 2D mean is the pinhole projection of the mean (centre of the
    top-left pixel = (0, 0)); the 2D covariance is J W Sigma W^T J^T + low_pass I (pixels^2) with
    Sigma = R diag(exp(log_scale))^2 R^T. In the Jacobian J, x/z and y/z are clamped to the image enlarged by 15 % of
    its size on each side; the clamp passes no gradient.
3.  Colour = 0.5 + sum_k Y_k(d) sh_k with d the direction from the camera centre to the mean, in the world frame, and Y
    the real spherical harmonics of 3D Gaussian Splatting, cut off at black (0, as 3DGS does; there is no upper limit).
    What is cut off passes only gradients whose descent brightens it, so that no Gaussian stays black for good.
4.  Gaussians are composited in the order of z; equal depths in the order of their rows.
5.  alpha = sigmoid(opacity_logit) * exp(-d^T cov^-1 d / 2). A contribution with alpha < 1/255 (before the next rule) is
    skipped; alpha is limited to 0.999, and there passes no gradient.
6.  A pixel takes no further Gaussian once its transmittance T = prod (1 - alpha) is below 1e-4; the Gaussian that took
    it there still counts. Weight of a Gaussian = alpha * T before it. With `close_below` > 0 (as in training)
    that is the limit instead, and the Gaussian that takes T below it counts with alpha 0.999, which passes no gradient.
7.  image, features, depth = sums of weight times colour, feature, z. alpha = 1 - T at the end = sum of weights.
    Background is black. median_depth = z of the Gaussian that takes T from at least 0.5 to below 0.5, else 0.
"""

from __future__ import annotations

from typing import Any, Final

import torch

from ggslam.rendering.types import LOW_PASS, Gaussians, RenderBuffers, active_coefficients, check_gaussians
from ggslam.scene.camera import Camera
from ggslam.scene.harmonics import spherical_harmonics

MIN_ALPHA: Final = 1.0 / 255.0
"""Smallest alpha that is drawn, as in 3D Gaussian Splatting."""
MAX_ALPHA: Final = 0.999
"""Largest alpha of one Gaussian."""
MIN_TRANSMITTANCE: Final = 1e-4
"""Transmittance at which a pixel is finished."""
FRUSTUM_MARGIN: Final = 0.15
"""Share of the image size by which projections are linearised beyond the border."""
MAX_DEPTH: Final = 1e6
"""Largest depth that is drawn."""
LOG_SCALE_RANGE: Final = (-23.0, 10.0)
"""Range of logarithms of scales that are drawn."""
QUATERNION_NORM2_RANGE: Final = (1e-20, 1e20)
"""Range of squared norms of quaternions that are drawn."""


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    T_camera_world: torch.Tensor,
    *,
    features: bool = True,
    median_depth: bool = False,
    active_sh_degree: int | None = None,
    near_plane: float = 0.05,
    low_pass: float = LOW_PASS,
    close_below: float = 0.0,
) -> RenderBuffers:
    """Renders with memory N x H x W: for small scenes.

    Args:
        gaussians: tensors of one float dtype, see `Gaussians`.
        T_camera_world: [4, 4] tensor of that dtype; differentiable.
        Others: as `CpuRasterizer.forward`.
    """
    check_gaussians(gaussians)
    coefficients = active_coefficients(gaussians, active_sh_degree)
    rows = _renderable_in_order(gaussians, T_camera_world, near_plane)
    means, quaternions = gaussians.means[rows], gaussians.quaternions[rows]
    log_scales, opacities = gaussians.log_scales[rows], torch.sigmoid(gaussians.opacity_logits[rows])

    position = means @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    mean2d, precision = _project(position, quaternions, log_scales, camera, T_camera_world[:3, :3], low_pass)
    colour = view_colours(gaussians.sh[rows, :coefficients], means, T_camera_world)
    z = position[:, 2]

    weights, before, after = _weights(mean2d, precision, opacities, camera, close_below)
    size = (camera.height, camera.width)
    with_features = features and gaussians.features.shape[1] > 0
    crossing = (before >= 0.5) & (after < 0.5)
    return RenderBuffers(
        image=(colour.T @ weights).reshape(3, *size),
        depth=(z @ weights).reshape(size),
        alpha=weights.sum(0).reshape(size),
        features=(gaussians.features[rows].T @ weights).reshape(-1, *size) if with_features else None,
        median_depth=(z.detach() @ crossing.to(z)).reshape(size) if median_depth else None,
    )


def renderable(gaussians: Gaussians, z: torch.Tensor, near_plane: float) -> torch.Tensor:
    """bool [N]: which Gaussians of depths z [N] are not skipped (rule 1)."""
    with torch.no_grad():
        parts = [gaussians.means, gaussians.quaternions, gaussians.opacity_logits[:, None], gaussians.sh.flatten(1)]
        numbers = torch.cat(parts, 1)
        norm2 = (gaussians.quaternions**2).sum(1)
        low, high = LOG_SCALE_RANGE
        ok = torch.isfinite(numbers).all(1) & (z >= near_plane) & (z <= MAX_DEPTH)
        ok &= ((gaussians.log_scales >= low) & (gaussians.log_scales <= high)).all(1)
        return ok & (norm2 >= QUATERNION_NORM2_RANGE[0]) & (norm2 <= QUATERNION_NORM2_RANGE[1])


def _renderable_in_order(gaussians: Gaussians, T_camera_world: torch.Tensor, near_plane: float) -> torch.Tensor:
    """Rows to render, nearest first (rules 1 and 4)."""
    with torch.no_grad():
        z = gaussians.means @ T_camera_world[2, :3] + T_camera_world[2, 3]
        rows = torch.nonzero(renderable(gaussians, z, near_plane))[:, 0]
        return rows[torch.argsort(z[rows], stable=True)]


def rotation_matrices(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1, eps=1e-15).unbind(-1)
    return torch.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
    ).reshape(-1, 3, 3)  # fmt: skip


def _project(
    position: torch.Tensor,
    quaternions: torch.Tensor,
    log_scales: torch.Tensor,
    camera: Camera,
    W: torch.Tensor,
    low_pass: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """2D means [N, 2] and inverse covariances [N, 2, 2] (rule 2)."""
    x, y, z = position.unbind(-1)
    u, v = x / z, y / z
    margin_x, margin_y = FRUSTUM_MARGIN * camera.width, FRUSTUM_MARGIN * camera.height
    clamped_u = u.clamp(
        (-0.5 - camera.cx - margin_x) / camera.fx, (camera.width - 0.5 - camera.cx + margin_x) / camera.fx
    )
    clamped_v = v.clamp(
        (-0.5 - camera.cy - margin_y) / camera.fy, (camera.height - 0.5 - camera.cy + margin_y) / camera.fy
    )
    zero = torch.zeros_like(z)
    J = torch.stack(
        [camera.fx / z, zero, -camera.fx * clamped_u / z, zero, camera.fy / z, -camera.fy * clamped_v / z], -1
    ).reshape(-1, 2, 3)
    V = J @ W @ (rotation_matrices(quaternions) * torch.exp(log_scales)[:, None, :])
    covariance = V @ V.transpose(1, 2) + low_pass * torch.eye(2, dtype=V.dtype, device=V.device)
    mean2d = torch.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], -1)
    return mean2d, torch.linalg.inv(covariance)


def _weights(
    mean2d: torch.Tensor, precision: torch.Tensor, opacities: torch.Tensor, camera: Camera, close_below: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights [N, H W] of Gaussians in depth order, and transmittance before and after each (rules 5 and 6)."""
    v, u = torch.meshgrid(
        torch.arange(camera.height, dtype=mean2d.dtype, device=mean2d.device),
        torch.arange(camera.width, dtype=mean2d.dtype, device=mean2d.device),
        indexing="ij",
    )
    dx, dy = u.reshape(1, -1) - mean2d[:, :1], v.reshape(1, -1) - mean2d[:, 1:]
    a, b, d = precision[:, 0, 0, None], precision[:, 0, 1, None], precision[:, 1, 1, None]
    alpha = opacities[:, None] * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + d * dy * dy))
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), torch.zeros_like(alpha))
    after, before = _transmittance(alpha)
    least = MIN_TRANSMITTANCE
    if close_below > 0:
        least = close_below
        closes = (before.detach() >= least) & (after.detach() < least)
        alpha = torch.where(closes, torch.full_like(alpha, MAX_ALPHA), alpha)
        after, before = _transmittance(alpha)
    weights = alpha * before * (before.detach() >= least)
    return weights, before.detach(), after.detach()


def _transmittance(alpha: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """[N, P] after and before each of the Gaussians with `alpha` [N, P]."""
    after = torch.cumprod(1 - alpha, 0)
    return after, torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(after) else after


class _CutAtBlack(torch.autograd.Function):
    """max(0, colour), with the gradient of rule 3."""

    @staticmethod
    def forward(ctx: Any, colour: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(colour < 0)
        return colour.clamp_min(0)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        (cut,) = ctx.saved_tensors
        return torch.where(cut, gradient.clamp_max(0), gradient)


def view_colours(sh: torch.Tensor, means: torch.Tensor, T_camera_world: torch.Tensor) -> torch.Tensor:
    """View-dependent colours [N, 3] of coefficients sh [N, K, 3] (rule 3)."""
    centre = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
    basis = spherical_harmonics(torch.nn.functional.normalize(means - centre, dim=-1), sh.shape[1])
    return _CutAtBlack.apply(0.5 + (basis[:, :, None] * sh).sum(1))
