# SPDX-License-Identifier: Apache-2.0
"""How paths are planned."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class PlanSettings:
    """Trade between short paths and wide ones."""

    margin: float = setting(0.3, 0, 100, "m")
    """Clearance beyond the least one that a path keeps where it can."""
    weight: float = setting(0.03, 0, 1000)
    """What a metre costs more at the least clearance than outside of the margin. Paths are at most this share longer
    than the shortest one."""
    passes: int = setting(40, 0, 10_000)
    """How often the points of a path are moved to smooth it, at most; 0: straight lines between corners."""
    push: float = setting(0.03, 0, 1)
    """Part of the missing margin that smoothing pushes a point away from obstacles in a pass."""
    unknown: bool = False
    """Whether a path may enter space that nobody has seen."""
