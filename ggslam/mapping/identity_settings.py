# SPDX-License-Identifier: Apache-2.0
"""Settings of identity learning. `scripts/benchmarks/bench_identity.py` shows what the choices are worth."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class NeighbourSettings:
    """The 3-D regularisation: a Gaussian's class distribution shall be like those of its nearest neighbours."""

    weight: float = setting(1.0, 0, 1e6)
    """l_obj3d. 0: none."""
    value: float = setting(2.0, 0, 1e6)
    """l_val: L_obj3d = (l_val / C) mean KL(P_j || Q_j)."""
    every: int = setting(5, 1, 10**6)
    """In every n-th identity step."""
    samples: int = setting(400, 1, 10**6)
    """Gaussians drawn each time."""
    neighbours: int = setting(5, 1, 100)
    """Nearest Gaussians that each is compared with."""
    growth: float = setting(0.2, 0, 1e6)
    """The index of neighbours is built anew when the map has grown by this share, or when Gaussians were removed."""


@settings_class(frozen=True)
class IdentitySettings:
    """How the Gaussians learn which object they belong to."""

    enabled: bool = setting(True, basic=True)
    """Learn objects when there are masks, or segments to be had (`masks.source`)."""
    schedule: Literal["sampled", "dense", "votes"] = "sampled"
    """sampled: cross-entropy on sampled pixels of the view that is rendered for its colours anyway; dense: on all
    pixels of rendered identity images, as published; votes: count only, learn nothing."""
    every: int = setting(7, 1, 10**6)
    """An identity step in every n-th mapping iteration."""
    final_passes: int = setting(4, 0, 10**4)
    """After the last frame all keyframes are visited so many times more for identity alone, with falling steps: what
    was inserted last has hardly been trained by then."""
    pixels: int = setting(2048, 1, 10**7)
    """Pixels sampled in a step."""
    balance: float = setting(0.5, 0, 1)
    """An object of n pixels gets a share of the sample that goes with n^(1 - balance): 0 as they come, 1 all alike."""
    boundary: float = setting(0.5, 0, 1)
    """Share of the sample that is drawn at the boundaries of objects."""
    detach: bool = True
    """Identity gradients do not reach geometry and opacity. False needs the dense schedule."""
    initialisation: Literal["votes", "random"] = "votes"
    """votes: a new Gaussian begins with the code of the object it was first seen on; random: (uniform - 0.5) / C0."""
    rate: float = setting(0.05, 0, 10)
    """Adam's step for identity vectors."""
    classifier_rate: float = setting(5e-4, 0, 10)
    """Adam's step for the classifier."""
    weight: float = setting(0.1, 0, 1e6)
    """l_obj, weight of the cross-entropy beside colour and depth."""
    min_confidence: float = setting(0.5, 0, 1)
    """A Gaussian whose most probable object is less probable belongs to none."""
    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)
