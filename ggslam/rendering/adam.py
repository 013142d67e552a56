# SPDX-License-Identifier: Apache-2.0
"""Settings of the Adam optimizer that is fused into the rasterizer's backward pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType

import torch

from ggslam.errors import RenderError

ADAM_GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest", "features")
"""Parameter groups with a learning rate of their own, in the order of the columns of an Adam schedule."""
_MAX_ROWS = 1 << 15


def _default_rates() -> Mapping[str, float]:
    return {
        "means": 1e-4, "quaternions": 1e-3, "log_scales": 2e-2, "opacity_logits": 5e-2,
        "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "features": 2.5e-3,
    }  # fmt: skip


@dataclass(frozen=True)
class AdamSettings:
    """Adam (Kingma and Ba 2015) with a learning rate per parameter group and an update count per Gaussian.

    A Gaussian at its u-th update (u = 1, 2, ...) uses the bias corrections 1 - beta^u and, for group g, the learning
    rate `learning_rates[g] * max(decay_floor, decay ** (u - 1))`; groups not in `decayed_groups` keep theirs.

    Attributes:
        learning_rates: group name to rate; groups left out are frozen (rate 0). Names: means, quaternions, log_scales,
            opacity_logits, sh_dc, sh_rest, features.
        beta1, beta2, epsilon: as usual; the step is rate * m / (sqrt(v) + epsilon) of the corrected moments.
        decay, decay_floor: per update; 1 for none.
        decayed_groups: groups whose rate decays.
    """

    learning_rates: Mapping[str, float] = field(default_factory=_default_rates)
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15
    decay: float = 1.0
    decay_floor: float = 0.0
    decayed_groups: tuple[str, ...] = ADAM_GROUPS

    def __post_init__(self) -> None:
        for name in (*self.learning_rates, *self.decayed_groups):
            if name not in ADAM_GROUPS:
                raise RenderError(f"unknown parameter group {name!r}; known: {', '.join(ADAM_GROUPS)}")
        for name in ("beta1", "beta2", "decay_floor"):
            if not 0 <= getattr(self, name) < 1 and not (name == "decay_floor" and self.decay_floor == 1):
                raise RenderError(f"{name} must be in [0, 1), found {getattr(self, name)}")
        if not 0 < self.decay <= 1:
            raise RenderError(f"decay must be in (0, 1], found {self.decay}")
        object.__setattr__(self, "learning_rates", MappingProxyType(dict(self.learning_rates)))

    def schedule(self) -> torch.Tensor:
        """float32 [rows, 8]: row u - 1 serves the u-th update, the last row all later ones. Columns: step size
        rate / (1 - beta1^u) of each group of `ADAM_GROUPS`, then 1 / sqrt(1 - beta2^u)."""
        rates = tuple(float(self.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS)
        decayed = tuple(name in self.decayed_groups for name in ADAM_GROUPS)
        return _schedule(rates, decayed, self.beta1, self.beta2, self.decay, self.decay_floor)


@lru_cache(maxsize=16)
def _schedule(
    rates: tuple[float, ...],
    decayed: tuple[bool, ...],
    beta1: float,
    beta2: float,
    decay: float,
    decay_floor: float,
) -> torch.Tensor:
    def rows_until(factor: float, limit: float) -> int:
        return 1 if factor in (0.0, 1.0) else math.ceil(math.log(limit) / math.log(factor))

    # Long enough for everything to have settled within float32, or to where it no longer matters.
    rows = max(rows_until(beta1, 1e-8), rows_until(beta2, 1e-8), rows_until(decay, max(decay_floor, 1e-6)))
    update = torch.arange(1, min(rows, _MAX_ROWS) + 1, dtype=torch.float64)
    factor = (decay ** (update - 1)).clamp_min(decay_floor)
    columns = [
        rate * (factor if decays else torch.ones_like(factor)) / (1 - beta1**update)
        for rate, decays in zip(rates, decayed, strict=True)
    ]
    columns.append(1 / torch.sqrt(1 - beta2**update))
    return torch.stack(columns, 1).float().contiguous()
