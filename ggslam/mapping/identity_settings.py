# SPDX-License-Identifier: Apache-2.0
"""Settings of identity learning. `scripts/bench_identity.py` shows what the choices are worth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ggslam.errors import check_ranges


@dataclass(frozen=True)
class NeighbourSettings:
    """The 3-D regularisation: a Gaussian's class distribution shall be like those of its nearest neighbours."""

    weight: float = 1.0
    """l_obj3d. 0: none."""
    value: float = 2.0
    """l_val: L_obj3d = (l_val / C) mean KL(P_j || Q_j)."""
    every: int = 5
    """In every n-th identity step."""
    samples: int = 400
    """Gaussians drawn each time."""
    neighbours: int = 5
    """Nearest Gaussians that each is compared with."""
    growth: float = 0.2
    """The index of neighbours is built anew when the map has grown by this share, or when Gaussians were removed."""

    def __post_init__(self) -> None:
        ranges = {
            "weight": (0, 1e6), "value": (0, 1e6), "every": (1, 10**6), "samples": (1, 10**6), "neighbours": (1, 100),
            "growth": (0, 1e6),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class IdentitySettings:
    """How the Gaussians learn which object they belong to."""

    enabled: bool = True
    """Learn objects when there are masks, or segments to be had (`masks.source`)."""
    schedule: Literal["sampled", "dense", "votes"] = "sampled"
    """sampled: cross-entropy on sampled pixels of the view that is rendered for its colours anyway; dense: on all
    pixels of rendered identity images, as published; votes: count only, learn nothing."""
    every: int = 5
    """An identity step in every n-th mapping iteration."""
    final_passes: int = 4
    """After the last frame all keyframes are visited so many times more for identity alone, with falling steps: what
    was inserted last has hardly been trained by then."""
    pixels: int = 2048
    """Pixels sampled in a step."""
    balance: float = 0.5
    """An object of n pixels gets a share of the sample that goes with n^(1 - balance): 0 as they come, 1 all alike."""
    boundary: float = 0.5
    """Share of the sample that is drawn at the boundaries of objects."""
    detach: bool = True
    """Identity gradients do not reach geometry and opacity. False needs the dense schedule."""
    initialisation: Literal["votes", "random"] = "votes"
    """votes: a new Gaussian begins with the code of the object it was first seen on; random: (uniform - 0.5) / C0."""
    rate: float = 0.05
    """Adam's step for identity vectors."""
    classifier_rate: float = 5e-4
    """Adam's step for the classifier."""
    weight: float = 0.1
    """l_obj, weight of the cross-entropy beside colour and depth."""
    min_confidence: float = 0.5
    """A Gaussian whose most probable object is less probable belongs to none."""
    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)

    def __post_init__(self) -> None:
        ranges = {
            "every": (1, 10**6), "pixels": (1, 10**7), "balance": (0, 1), "boundary": (0, 1), "rate": (0, 10),
            "classifier_rate": (0, 10), "weight": (0, 1e6), "min_confidence": (0, 1), "final_passes": (0, 10**4),
        }  # fmt: skip
        check_ranges(self, ranges)
