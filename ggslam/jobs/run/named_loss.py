# SPDX-License-Identifier: Apache-2.0
"""A loss of the user's own that the command line names: `module:function` or `path/to/file.py:function`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ggslam.errors import ConfigError, GgslamError, RenderError
from ggslam.mapping.extra_loss import add_extra_loss, uses_features
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.losses import LossGradients
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.frame import Frame
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.system.named_code import load_named, tell_with_line


@dataclass(frozen=True)
class NamedLoss:
    """An `ExtraLoss` by name. What its function raises is told as an error of the user's.

    Attributes:
        name: as it was given.
        function: see `mapping.extra_loss.ExtraLoss`.
    """

    name: str
    function: Callable[[RenderBuffers, Keyframe], Any]

    @staticmethod
    def load(name: str) -> NamedLoss:
        """Imports it. The code in it is run: never load a name that a file of somebody else gives.

        Raises:
            ConfigError: there is no such file, module or function, or importing it fails.
        """
        try:
            function = load_named(name)
        except ValueError as error:
            raise ConfigError(f"`loss` {name}: {error}") from error
        if not callable(function):
            raise ConfigError(f"`loss` {name}: is no function")
        return NamedLoss(name, function)

    @property
    def uses_features(self) -> bool:
        """See `ExtraLoss`."""
        return uses_features(self.function)

    def __call__(self, view: RenderBuffers, keyframe: Keyframe, /) -> torch.Tensor:
        """See `ExtraLoss`; raises ConfigError where the function raises anything that is no error of ggslam."""
        try:
            value: torch.Tensor = self.function(view, keyframe)
        except (GgslamError, MemoryError, torch.cuda.OutOfMemoryError):
            raise
        except Exception as error:
            raise ConfigError(f"`loss` {self.name}: {tell_with_line(error)}") from error
        return value

    def try_on(self, frame: Frame, device: torch.device) -> None:
        """Computes the loss and its gradient once, of a view that is the frame itself, before a run begins.

        Raises:
            ConfigError: the function raises an error, or gives no finite scalar that can be differentiated.
        """
        color = torch.from_numpy(np.ascontiguousarray(frame.color)).to(device).permute(2, 0, 1) / 255
        depth = torch.from_numpy(np.ascontiguousarray(frame.depth)).to(device)
        features = torch.zeros(IDENTITY_CHANNELS, *depth.shape, device=device) if self.uses_features else None
        view = RenderBuffers(color, depth, torch.ones_like(depth), features)
        nothing = LossGradients(torch.zeros_like(color), torch.zeros_like(depth), torch.zeros_like(depth))
        try:
            add_extra_loss(self, view, make_keyframe(0, frame, np.eye(4)), nothing, None)
        except RenderError as error:
            raise ConfigError(f"`loss` {self.name}: {str(error).removeprefix('extra_loss: ')}") from error
