# SPDX-License-Identifier: Apache-2.0
"""Settings of refining a store."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class RefineSettings:
    """How a finished map is trained further."""

    steps: int = setting(300, 0, 10**7)
    """Optimisation steps, of a store for each cell."""
    seed: int = setting(0, 0, 2**63 - 1)
    """Of the order of the keyframes; each cell's own follows from it and from where the cell is."""
    halo: float = setting(0.5, 0, 1e3, "m")
    """Gaussians of other cells so near to a cell are rendered with its own, but stay as they are."""
    border: float = setting(0.25, 0, 1e3, "m")
    """Pixels that measured something so near to a cell count in its training."""
    views: int = setting(96, 1, 10**6)
    """Keyframes that a cell is trained on at most, spread evenly over those that may see it."""
    share: float = setting(0.005, 0, 1)
    """Of a keyframe's pixels so many at least have to count, or it is passed over."""
