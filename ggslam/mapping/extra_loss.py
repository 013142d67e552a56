# SPDX-License-Identifier: Apache-2.0
"""A user's own loss beside the mapper's. torch differentiates it, and its gradients join those of the iteration."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.losses import LossGradients
from ggslam.rendering.types import RenderBuffers

_RENDERED: Final = ("image", "depth", "alpha", "features")


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
    grad_features: torch.Tensor | None, faults: torch.Tensor | None = None,
) -> torch.Tensor | None:  # fmt: skip
    """Adds the gradients of an extra loss to those of an iteration, in place.

    Args:
        loss: see `ExtraLoss`.
        view: as rendered.
        keyframe: whose view it is.
        gradients: of the mapper's own loss.
        grad_features: of the rendered features so far, if there is one.
        faults: see `new_faults`: where the gradient is not finite it counts as 0, and that is noted there; None: it is
            refused.

    Returns:
        The gradient of the rendered features, None if there is none.

    Raises:
        RenderError: the loss is no scalar, or, without `faults`, its gradient is not finite.
    """
    with torch.enable_grad():
        rendered = {name: getattr(view, name) for name in _RENDERED}
        leaves = {name: t.detach().clone().requires_grad_() for name, t in rendered.items() if t is not None}
        value = loss(RenderBuffers(**leaves), keyframe)
        if not isinstance(value, torch.Tensor) or value.numel() != 1:
            found = list(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            raise RenderError(f"extra_loss: expected a scalar tensor, found {found}")
        if not value.requires_grad:  # of nothing that was rendered
            return grad_features
        found_gradients = torch.autograd.grad(value.reshape(()), list(leaves.values()), allow_unused=True)
    by_name = {name: _check(name, g, faults) for name, g in zip(leaves, found_gradients, strict=True)}
    for name, own in (("image", gradients.d_image), ("depth", gradients.d_depth), ("alpha", gradients.d_alpha)):
        given = by_name[name]
        if given is not None:
            own.add_(given)
    extra = by_name.get("features")
    if extra is None:
        return grad_features
    return extra.contiguous() if grad_features is None else grad_features + extra


def _check(name: str, gradient: torch.Tensor | None, faults: torch.Tensor | None) -> torch.Tensor | None:
    """A gradient whose numbers are finite, by what was rendered."""
    if gradient is None:
        return None
    finite = torch.isfinite(gradient)
    if faults is None:
        if not finite.all():
            raise _not_finite(name)
        return gradient
    faults[_RENDERED.index(name)].add_((~finite).any())
    return torch.where(finite, gradient, 0.0)


def _not_finite(name: str) -> RenderError:
    return RenderError(f"extra_loss: its gradient by the rendered {name} is not finite")


def new_faults(device: torch.device) -> torch.Tensor:
    """Counts gradients that are not finite on a device, so that no step has to wait for it; to be read now and then."""
    return torch.zeros(len(_RENDERED), dtype=torch.int32, device=device)


def refuse_faults(faults: np.ndarray) -> None:
    """Raises RenderError if there was any."""
    for name, count in zip(_RENDERED, faults.tolist(), strict=True):
        if count:
            raise _not_finite(name)
