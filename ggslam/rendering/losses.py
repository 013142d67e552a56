# SPDX-License-Identifier: Apache-2.0
"""The losses that maps are trained with, as torch functions on whatever `ggslam.render` gave: differentiable by
autograd, on any device. Runs compute the same in the compiled core.

    colour       (1 - w) mean |x - y| + w (1 - mean SSIM(x, y))                  w = 0.2
    depth        mean over pixels with depth of |D - D_measured|
    identity     mean over labelled pixels of -log softmax(W f + b)[label]
    neighbours   mean over Gaussians j and their k neighbours i of KL(P_j || P_i), P = softmax(W f + b)

Colour and depth as in Kerbl et al., "3D Gaussian Splatting", 2023, and Keetha et al., "SplaTAM", 2024; identity and
neighbours as in Ye et al., "Gaussian Grouping", 2024, eq. 3 and 4, with being no object as one class more, whose logit
is the constant 1.
"""

from __future__ import annotations

import torch
from torch.nn.functional import conv2d

from ggslam.errors import RenderError
from ggslam.scene.identity import IdentityVectorTuning


def color_loss(image: torch.Tensor, target: torch.Tensor, dssim_weight: float = 0.2) -> torch.Tensor:
    """(1 - w) mean |x - y| + w (1 - mean SSIM(x, y)), a scalar.

    Args:
        image: rendered colour x, [3, H, W].
        target: y, [3, H, W] in [0, 1].
        dssim_weight: w, in [0, 1]; 0 leaves out SSIM, which is most of the work.

    Raises:
        RenderError: the shapes differ, or an image has no floating-point numbers.
    """
    _check_images("color_loss", image, target)
    loss = (image - target).abs().mean()
    if dssim_weight:
        loss = (1 - dssim_weight) * loss + dssim_weight * (1 - ssim_map(image, target).mean())
    return loss


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity of each value, [C, H, W], of two images [C, H, W] in [0, 1].

    Wang et al. 2004: 11x11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2.
    """
    c1, c2 = 0.01**2, 0.03**2
    mx, my = _blur(image), _blur(target)
    vx, vy, vxy = _blur(image * image) - mx**2, _blur(target * target) - my**2, _blur(image * target) - mx * my
    return (2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))


def _blur(images: torch.Tensor) -> torch.Tensor:
    """Convolution of [N, H, W] with the window of SSIM."""
    offsets = torch.arange(-5, 6, dtype=images.dtype, device=images.device)
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = window / window.sum()
    return conv2d(images[:, None], torch.outer(window, window)[None, None], padding=5)[:, 0]


def depth_loss(depth: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean |D - D_measured| in metres over the pixels that have a measured depth, a scalar; 0 if none has.

    Args:
        depth: rendered depth D, [H, W]: `RenderBuffers.depth` (so that a transparent pixel is too near, as runs train)
            or `expected_depth`.
        target: measured depth [H, W], metres; 0, negative, infinite or NaN: none.

    Raises:
        RenderError: the shapes differ, or an image has no floating-point numbers.
    """
    _check_images("depth_loss", depth, target)
    valid = torch.isfinite(target) & (target > 0)
    error = (depth - torch.where(valid, target, torch.zeros_like(target))).abs()
    return torch.where(valid, error, torch.zeros_like(error)).sum() / valid.sum().clamp(min=1)


def identity_loss(logits: torch.Tensor, classes: torch.Tensor) -> torch.Tensor:
    """Mean softmax cross-entropy of object classes, a scalar; 0 if nothing is labelled.

    Args:
        logits: [P, C], the classifier's W f + b at P pixels (of a rendered image [F, H, W]:
            `features.flatten(1).T @ W.T + b`).
        classes: int64 [P], 0 to C - 1; negative: not labelled, left out.

    Raises:
        RenderError: shapes that do not fit, or a class outside 0 to C - 1.
    """
    if logits.ndim != 2 or classes.shape != logits.shape[:1]:
        raise RenderError(
            f"identity_loss: expected [P, C] and [P], found {list(logits.shape)} and {list(classes.shape)}"
        )
    known = classes >= 0
    if not known.any():
        return logits.sum() * 0
    if int(classes.max()) >= logits.shape[1]:
        raise RenderError(f"identity_loss: expected classes 0 to {logits.shape[1] - 1}, found {int(classes.max())}")
    return -_log_softmax(logits[known]).gather(1, classes[known, None].long()).mean()


def neighbour_loss(logits: torch.Tensor, neighbour_logits: torch.Tensor) -> torch.Tensor:
    """Mean KL(P_j || P_i) over M Gaussians j and their k nearest neighbours i, a scalar: neighbours in space are the
    same object. Runs weight it by `identity.neighbours.value` / C.

    Args:
        logits: [M, C], the classifier's W f + b of sampled Gaussians.
        neighbour_logits: [M, k, C], of each one's neighbours, found with `scipy.spatial.cKDTree` for example.

    Raises:
        RenderError: shapes that do not fit.
    """
    fits = logits.ndim == 2 and neighbour_logits.ndim == 3
    if not fits or neighbour_logits.shape[::2] != logits.shape or not neighbour_logits.numel():
        shapes = f"{list(logits.shape)} and {list(neighbour_logits.shape)}"
        raise RenderError(f"neighbour_loss: expected [M, C] and [M, k, C], found {shapes}")
    own, others = _log_softmax(logits)[:, None], _log_softmax(neighbour_logits)
    return (own.exp() * (own - others)).sum(-1).mean()


def _log_softmax(logits: torch.Tensor) -> torch.Tensor:
    """Of the classes and, in the last place, of being nothing: [..., C + 1]."""
    nothing = torch.full_like(logits[..., :1], IdentityVectorTuning.nothing_logit)
    return torch.log_softmax(torch.cat([logits, nothing], -1), -1)


def _check_images(name: str, one: torch.Tensor, other: torch.Tensor) -> None:
    for image in (one, other):
        if not isinstance(image, torch.Tensor) or not image.is_floating_point():
            found = str(image.dtype) if isinstance(image, torch.Tensor) else type(image).__name__
            hint = "; divide it by 255" if name == "color_loss" and found == "torch.uint8" else ""
            raise RenderError(f"{name}: expected tensors of floating-point numbers, found {found}{hint}")
    if one.shape != other.shape:
        raise RenderError(f"{name}: expected two images of one shape, found {list(one.shape)} and {list(other.shape)}")
