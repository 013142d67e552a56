# SPDX-License-Identifier: Apache-2.0
"""What training steps have of their keyframes: rows, as the library takes them, that are made once and hold until
something that they are made from is another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch

from ggslam.abi.cuda import TrainingStep
from ggslam.mapping.cuda.image_store import CudaKeyframeImages
from ggslam.mapping.pixel_grid import PixelGrid
from ggslam.mapping.settings import LossSettings, MapperSettings
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.scene.camera import Camera

_KEPT_KINDS: Final = 16


@dataclass(frozen=True, eq=False)
class StepKind:
    """What steps of one call have in common. There is one object of each kind, see `StepKinds`.

    Attributes:
        camera: of the pictures.
        settings: of the mapper.
        loss: of the images.
        exposed: whether keyframes have exposures of their own, which follow their gradients.
        low_pass: filter of the renderings, pixels^2.
        close_below: see `CudaRasterizer`.
    """

    camera: Camera
    settings: MapperSettings
    loss: LossSettings
    exposed: bool
    low_pass: float
    close_below: float

    def is_like(self, other: StepKind) -> bool:
        """Whether all of it is equal."""
        return vars(self) == vars(other)


class StepKinds:
    """The kinds of steps that came up last."""

    def __init__(self) -> None:
        self._kinds: list[StepKind] = []

    def only(self, kind: StepKind) -> StepKind:
        """The one object for all kinds that are like this one."""
        for known in self._kinds:
            if known.is_like(kind):
                return known
        self._kinds = [kind, *self._kinds[: _KEPT_KINDS - 1]]
        return kind


@dataclass(eq=False)
class StepRow:
    """A keyframe, or a frame between keyframes, as steps on a grid's pixels take it.

    Attributes:
        kind: of the steps.
        step: for the library, with rates of the map and of the pose.
        images: what a step is compared with.
        shown: bool [h, w] on the device, where colours count; None: everywhere.
        is_world: whether its pose stays for good.
        optimizer, pose_rate: that the rates are of.
    """

    kind: StepKind
    step: TrainingStep
    images: CudaKeyframeImages
    shown: torch.Tensor | None
    is_world: bool
    optimizer: AdamSettings | None = None
    pose_rate: float = -1.0

    def set_rates(self, optimizer: AdamSettings, pose_rate: float) -> None:
        """The steps that follow have the optimizer's rates; `pose_rate`: size of the pose's step in metres and radians
        where it is not the world's, 0: it stays."""
        self.optimizer, self.pose_rate = optimizer, pose_rate
        self.step.rates[:] = [float(optimizer.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS]
        self.step.keyframe.pose_rate = 0.0 if self.is_world else pose_rate


@dataclass(eq=False)
class KeptRow:
    """A row while it holds.

    Attributes:
        grid: of the pixels.
        sources: what it was made from; it holds as long as these are the same objects.
        row: the row.
    """

    grid: PixelGrid
    sources: tuple[object, ...]
    row: StepRow
