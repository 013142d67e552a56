# SPDX-License-Identifier: Apache-2.0
"""Settings of merging."""

from __future__ import annotations

from dataclasses import field

from ggslam.loops.settings import GraphSettings, VerificationSettings
from ggslam.objects.settings import SameObjectSettings
from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class SeamSettings:
    """Where maps meet."""

    voxel: float = setting(0.1, 1e-3, 10, "m")
    """Places of this size belong to one run each; in scenes of another size than a room's it goes with that."""
    share: float = setting(0.1, 0, 1)
    """A keyframe is at the seam if its own map and another one show the same surface in this share of its view."""
    alpha: float = setting(0.6, 0, 1)
    """Both maps have to be so opaque there."""
    tolerance_m: float = setting(0.05, 0, 1e3, "m")
    """And their surfaces so near to each other, in depth."""
    tolerance_relative: float = setting(0.03, 0, 1)
    """As `tolerance_m`, a share of the depth; the larger of the two counts."""


@settings_class(frozen=True)
class MergeSettings:
    """How runs are merged."""

    candidates: int = setting(3, 1, 1000)
    """Keyframes of one run that are tried for one of the other, the likeliest first."""
    queries: int = setting(150, 1, 10**6)
    """Keyframes of a run that are looked up in another one at most, spread evenly."""
    neighbourhood: int = setting(3, 0, 1000, "keyframes")
    """Keyframes before and after one that is tried whose points make its local map."""
    confirmations: int = setting(3, 1, 10**6)
    """Keyframes that have to agree on how two runs lie to each other."""
    steps: int = setting(400, 0, 10**7)
    """Optimisation steps at the seams, for each run that joins the first."""
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    graph: GraphSettings = field(default_factory=GraphSettings)
    uniting: SameObjectSettings = field(default_factory=SameObjectSettings)
    seams: SeamSettings = field(default_factory=SeamSettings)
