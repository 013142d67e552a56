# SPDX-License-Identifier: Apache-2.0
"""Settings of the Adam optimizer that is fused into the rasterizer's backward pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.system.tuning import Tuning

ADAM_GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest", "features")
"""Parameter groups with a learning rate of their own, in the order of the columns of an Adam schedule."""


class AdamTuning(Tuning):
    """Rows of bias corrections."""

    max_rows = 1 << 15
    """Most rows of the table of bias corrections."""


def _default_rates() -> Mapping[str, float]:
    return {
        "means": 1e-4, "quaternions": 1e-3, "log_scales": 2e-2, "opacity_logits": 5e-2,
        "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "features": 2.5e-3,
    }  # fmt: skip


@dataclass(frozen=True)
class AdamSettings:
    """Adam (Kingma and Ba 2015) with a learning rate per parameter group and an update count per Gaussian.

    A Gaussian at its u-th update (u = 1, 2, ...) uses the bias corrections 1 - beta^u and, for group g, the learning
    rate `learning_rates[g]` times `max(decay_floor, decay ** (u - 1))` if it is in `decayed_groups`, times
    `max(fall_floor, (1 + (u - 1) / fall_updates) ** -0.5)` if it is in `falling_groups`.

    Attributes:
        learning_rates: group name to rate; groups left out are frozen (rate 0). Names: means, quaternions, log_scales,
            opacity_logits, sh_dc, sh_rest, features.
        beta1, beta2, epsilon: as usual; the step is rate * m / (sqrt(v) + epsilon) of the corrected moments.
        decay, decay_floor: per update; 1 for none.
        decayed_groups: groups whose rate decays exponentially.
        falling_groups: groups whose rate falls with the root of the updates; they must not decay besides.
        fall_updates, fall_floor: of the falling groups.
    """

    learning_rates: Mapping[str, float] = field(default_factory=_default_rates)
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15
    decay: float = 1.0
    decay_floor: float = 0.0
    decayed_groups: tuple[str, ...] = ADAM_GROUPS
    falling_groups: tuple[str, ...] = ()
    fall_updates: float = 8.0
    fall_floor: float = 0.05

    def __post_init__(self) -> None:
        for name in (*self.learning_rates, *self.decayed_groups, *self.falling_groups):
            if name not in ADAM_GROUPS:
                raise RenderError(f"unknown parameter group {name!r}; known: {', '.join(ADAM_GROUPS)}")
        for name in ("beta1", "beta2", "decay_floor"):
            if not 0 <= getattr(self, name) < 1 and not (name == "decay_floor" and self.decay_floor == 1):
                raise RenderError(f"{name} must be in [0, 1), found {getattr(self, name)}")
        if not 0 < self.decay <= 1:
            raise RenderError(f"decay must be in (0, 1], found {self.decay}")
        if not self.fall_updates > 0 or not 0 < self.fall_floor <= 1:
            found = f"{self.fall_updates}, {self.fall_floor}"
            raise RenderError(f"fall_updates must be positive and fall_floor in (0, 1], found {found}")
        if both := set(self.decayed_groups) & set(self.falling_groups):
            raise RenderError(f"groups that both decay and fall: {', '.join(sorted(both))}")
        object.__setattr__(self, "learning_rates", MappingProxyType(dict(self.learning_rates)))

    def schedule(self) -> torch.Tensor:
        """float32 [rows, 8]: row u - 1 serves the u-th update, the last row all later ones. Columns: step size
        rate / (1 - beta1^u) of each group of `ADAM_GROUPS`, then 1 / sqrt(1 - beta2^u)."""
        rates = tuple(float(self.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS)
        return _schedule(_Shape.of(self), rates)


@dataclass(frozen=True)
class _Shape:
    """The parameters of a schedule without the rates, which change with every step of a final refinement."""

    beta1: float
    beta2: float
    decay: float
    decay_floor: float
    fall_updates: float
    fall_floor: float
    decayed: tuple[bool, ...]
    falling: tuple[bool, ...]

    @classmethod
    def of(cls, s: AdamSettings) -> _Shape:
        decayed, falling = (tuple(n in names for n in ADAM_GROUPS) for names in (s.decayed_groups, s.falling_groups))
        return cls(s.beta1, s.beta2, s.decay, s.decay_floor, s.fall_updates, s.fall_floor, decayed, falling)

    @property
    def rows(self) -> int:
        """Enough for everything to have settled within float32, or to where it no longer matters."""
        fall = math.ceil(self.fall_updates * (self.fall_floor**-2 - 1)) + 1 if any(self.falling) else 1
        decay = _rows_until(self.decay, max(self.decay_floor, 1e-6)) if any(self.decayed) else 1
        return min(AdamTuning.max_rows, max(_rows_until(self.beta1, 1e-8), _rows_until(self.beta2, 1e-8), decay, fall))


def _rows_until(factor: float, limit: float) -> int:
    return 1 if factor in (0.0, 1.0) else math.ceil(math.log(limit) / math.log(factor))


@lru_cache(maxsize=16)
def _schedule(shape: _Shape, rates: tuple[float, ...]) -> torch.Tensor:
    # Every step of a final refinement has rates of its own. In numpy, because torch would wake its threads for this.
    return torch.from_numpy((_unit_schedule(shape).numpy() * np.array([*rates, 1.0])).astype(np.float32))


@lru_cache(maxsize=16)
def _unit_schedule(shape: _Shape) -> torch.Tensor:
    """As `AdamSettings.schedule` with rates of 1, float64."""
    update = torch.arange(1, shape.rows + 1, dtype=torch.float64)
    decay = (shape.decay ** (update - 1)).clamp_min(shape.decay_floor)
    fall = (1 + (update - 1) / shape.fall_updates).rsqrt().clamp_min(shape.fall_floor)
    columns = [
        (decay if decays else fall if falls else torch.ones_like(update)) / (1 - shape.beta1**update)
        for decays, falls in zip(shape.decayed, shape.falling, strict=True)
    ]
    columns.append(1 / torch.sqrt(1 - shape.beta2**update))
    return torch.stack(columns, 1)
