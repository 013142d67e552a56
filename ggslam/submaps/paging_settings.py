# SPDX-License-Identifier: Apache-2.0
"""Settings of Gaussian paging: what is kept in memory of a map that does not fit."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class PagingTuning:
    """Numbers of moving parts of the map to disk."""

    cell: float = setting(2.0, 0.1, 1e4, "m")
    """Edge of the cells that move to disk together."""
    keep_radius: float = setting(3.0, 0, 1e6, "m")
    """Cells with centres closer to the camera than this stay in memory."""
    view_range: float = setting(12.0, 0.1, 1e6, "m")
    """Cells farther from the camera than this are not rendered."""
    view_margin: float = setting(1.1, 1, 100)
    """A tile of a view needs the map up to its deepest measurement times this plus `view_spare`."""
    view_spare: float = setting(0.3, 0, 1e6, "m")
    """Depth added to what `view_margin` allows."""
    images: float = setting(0.25, 0.01, 0.9)
    """Share of the budget for keyframe images and points."""
    slack: float = setting(0.1, 0, 0.9)
    """Share of the Gaussians' budget that is freed beyond need."""


@settings_class(frozen=True)
class PagingSettings(PagingTuning):
    """How a run keeps to `memory_limit_mb`; without a limit none of this has an effect."""

    budget_mb: float = setting(0.0, 0, 1e9, "MB")
    """Memory for map and keyframe images; 0: automatic: `memory_limit_mb` minus the measured use of the program. With a
    fixed budget a run repeats bit for bit."""
