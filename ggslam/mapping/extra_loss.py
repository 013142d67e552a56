# SPDX-License-Identifier: Apache-2.0
"""A user's own loss beside the mapper's. torch differentiates it, and its gradients join those of the iteration."""

from __future__ import annotations

from typing import Protocol

import torch

from ggslam.errors import RenderError
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.losses import LossGradients
from ggslam.rendering.types import RenderBuffers


class ExtraLoss(Protocol):
    """Called in every mapping iteration with what was rendered: while there is one, all pixels of a keyframe. Features
    are rendered for it only if it has a true attribute `uses_features`."""

    def __call__(self, view: RenderBuffers, keyframe: Keyframe, /) -> torch.Tensor:
        """The loss.

        Args:
            view: of the map at the keyframe: `image` [3, H, W], `depth` [H, W], `alpha` [H, W] and perhaps `features`
                [F, H, W], float32 tensors that require gradients; copies, to be kept if need be.
            keyframe: `color` uint8 [H, W, 3], `depth_m()` float32 [H, W], `mask` uint16 [H, W] or None,
                `T_world_camera`, `frame_index` and so on.

        Returns:
            A scalar, in units of the mapper's own loss.
        """


def uses_features(loss: ExtraLoss | None) -> bool:
    """Whether an extra loss wants features rendered."""
    return bool(getattr(loss, "uses_features", False))


def add_extra_loss(
    loss: ExtraLoss, view: RenderBuffers, keyframe: Keyframe, gradients: LossGradients,
    grad_features: torch.Tensor | None,
) -> torch.Tensor | None:  # fmt: skip
    """Adds the gradients of an extra loss to those of an iteration, in place.

    Args:
        loss: see `ExtraLoss`.
        view: as rendered.
        keyframe: whose view it is.
        gradients: of the mapper's own loss.
        grad_features: of the rendered features so far, if there is one.

    Returns:
        The gradient of the rendered features, None if there is none.

    Raises:
        RenderError: the loss is no scalar, or it or its gradient is not finite.
    """
    with torch.enable_grad():
        rendered = {name: getattr(view, name) for name in ("image", "depth", "alpha", "features")}
        leaves = {name: t.detach().clone().requires_grad_() for name, t in rendered.items() if t is not None}
        value = loss(RenderBuffers(**leaves), keyframe)
        if not isinstance(value, torch.Tensor) or value.numel() != 1:
            found = list(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            raise RenderError(f"extra_loss: expected a scalar tensor, found {found}")
        if not value.requires_grad:  # of nothing that was rendered
            return grad_features
        found_gradients = torch.autograd.grad(value.reshape(()), list(leaves.values()), allow_unused=True)
    by_name = dict(zip(leaves, found_gradients, strict=True))
    for name, gradient in by_name.items():
        if gradient is not None and not torch.isfinite(gradient).all():
            raise RenderError(f"extra_loss: its gradient by the rendered {name} is not finite")
    for name, own in (("image", gradients.d_image), ("depth", gradients.d_depth), ("alpha", gradients.d_alpha)):
        if by_name[name] is not None:
            own.add_(by_name[name])
    extra = by_name.get("features")
    if extra is None:
        return grad_features
    return extra.contiguous() if grad_features is None else grad_features + extra
