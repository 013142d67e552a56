# SPDX-License-Identifier: Apache-2.0
"""The mean of a map over optimisation steps.

Single steps follow single views, so parameters swing about what all views agree on. Their mean is nearer to it than
what steps that get ever smaller end at (Polyak and Juditsky, "Acceleration of stochastic approximation by averaging",
1992).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ggslam.rendering.types import PARAMETERS
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.savable import savable

AVERAGED = tuple(name for name in PARAMETERS if name != "features")


@savable()
@dataclass
class MeanMap:
    """Running mean of all parameters but the feature vectors.

    Attributes:
        count: maps that were added.
        arrays: their mean, by name; of the shapes of the map.
    """

    count: int = 0
    arrays: dict[str, torch.Tensor] = field(default_factory=dict)

    def add(self, gaussians: GaussianMap) -> None:
        """A map joins the mean; of the same Gaussians as those before."""
        self.count += 1
        for name in AVERAGED:
            now = getattr(gaussians, name)
            if self.count == 1:
                self.arrays[name] = now.clone()
            else:
                self.arrays[name].lerp_(now, 1 / self.count)

    def fits(self, gaussians: GaussianMap) -> bool:
        """Whether it is of the map's Gaussians."""
        return all(
            name in AVERAGED and array.shape == getattr(gaussians, name).shape for name, array in self.arrays.items()
        ) and len(self.arrays) == (len(AVERAGED) if self.count else 0)

    def move_into(self, gaussians: GaussianMap) -> None:
        """The map becomes the mean of what was added, if anything was; the mean begins anew."""
        for name, array in self.arrays.items():
            getattr(gaussians, name).copy_(array)
        self.count, self.arrays = 0, {}
