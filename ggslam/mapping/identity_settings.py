# SPDX-License-Identifier: Apache-2.0
"""Settings of identity learning. `scripts/benchmarks/bench_identity.py` shows what the choices are worth."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class NeighbourSettings:
    """The 3-D regularisation: neighbouring Gaussians get similar class distributions."""

    weight: float = setting(1.0, 0, 1e6)
    """Weight l_obj3d; 0: none."""
    value: float = setting(2.0, 0, 1e6)
    """Factor l_val of L_obj3d = (l_val / C) mean KL(P_j || Q_j)."""
    every: int = setting(5, 1, 10**6)
    """In every n-th identity step."""
    samples: int = setting(400, 1, 10**6)
    """Gaussians drawn each time."""
    neighbours: int = setting(5, 1, 100)
    """Nearest Gaussians compared with each."""
    growth: float = setting(0.2, 0, 1e6)
    """The index of neighbours is rebuilt when the map has grown by this share or lost Gaussians."""


@tuning_class(frozen=True)
class IdentityTuning:
    """Numbers of learning objects."""

    every: int = setting(7, 1, 10**6)
    """An identity step in every n-th training step."""
    pixels: int = setting(2048, 1, 10**7)
    """Pixels sampled in a step."""
    balance: float = setting(0.5, 0, 1)
    """Shares of objects in a sample, from 0 (by area) to 1 (all equal)."""
    boundary: float = setting(0.5, 0, 1)
    """Share of the sample taken at boundaries of objects."""
    detach: bool = True
    """Keep gradients of identity from geometry and opacity; false needs a schedule that renders images of
    them: dense or colors."""
    initialisation: Literal["votes", "random"] = "votes"
    """votes: a new Gaussian starts with the code of the object it is seen on; random: (uniform - 0.5) / C0."""
    rate: float = setting(0.05, 0, 10)
    """Adam's step of identity vectors."""
    classifier_rate: float = setting(5e-4, 0, 10)
    """Adam's step of the classifier."""
    weight: float = setting(0.1, 0, 1e6)
    """Weight l_obj of the cross-entropy against colour and depth."""
    min_confidence: float = setting(0.5, 0, 1)
    """A Gaussian belongs to no object if its most probable object is less probable than this."""


@settings_class(frozen=True)
class IdentitySettings(IdentityTuning):
    """How Gaussians learn which object they belong to."""

    enabled: bool = setting(True, basic=True)
    """Learn objects from masks (`masks.source`)."""
    schedule: Literal["sampled", "dense", "colors", "votes"] = "sampled"
    """How identities are learned. sampled: on sampled pixels of views rendered for colour anyway; dense: on all pixels
    of rendered identity images, as published; colors: likewise, but as colours of objects compared in L1, the nearest
    of which tells the object, as in SGS-SLAM (CPU); votes: by counting, without training."""
    final_passes: int = setting(4, 0, 10**4)
    """Passes over all keyframes with masks after the last frame that train identities only."""
    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)

    @property
    def renders_images(self) -> bool:
        """Whether whole images of identities are rendered and differentiated."""
        return self.schedule in ("dense", "colors")
