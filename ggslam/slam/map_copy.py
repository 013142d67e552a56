# SPDX-License-Identifier: Apache-2.0
"""Copies of a growing map, for who shows or saves it while the run goes on. In real time the mapper's thread trains the
map, and adds to it, meanwhile."""

from __future__ import annotations

import torch

from ggslam.errors import ConfigError
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.slam import Slam
from ggslam.system.tuning import Tuning


class MapCopyTuning(Tuning):
    """How a whole copy is tried for."""

    tries = 20
    """Times that a map is copied that another thread adds to meanwhile."""


def shown_gaussians(slam: Slam, harmonics: int | None = None) -> GaussianTensors:
    """The Gaussians on the CPU, without identities, to be shown: rows of one copy may be of different steps, which is
    gone with the next. `harmonics`: coefficients of their colours; None: all."""
    g = slam.map
    views = [g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh[:, :harmonics], g.features[:, :0]]
    count = min(len(view) for view in views)
    with slam.mapper.in_turn():
        return GaussianTensors(*(view[:count].to("cpu", copy=True) for view in views))


def whole_map(slam: Slam) -> GaussianMap:
    """The map on the CPU with all that belongs to it, to be saved.

    Raises:
        ConfigError: it changes faster than it can be copied.
    """
    for _ in range(MapCopyTuning.tries):
        count = len(slam.map)
        try:
            with slam.mapper.in_turn(), torch.no_grad():
                copy = slam.map.copy("cpu")
        except RuntimeError:  # arrays of two lengths
            continue
        if len(copy) == count == len(slam.map):
            return copy
    raise ConfigError("the map changes faster than it can be copied; ask again")
