# SPDX-License-Identifier: Apache-2.0
"""Settings of loop closing."""

from __future__ import annotations

from dataclasses import field

from ggslam.loops.activity import ActivitySettings
from ggslam.loops.revisits import RevisitSettings
from ggslam.loops.settings import GraphSettings, PlaceSettings, VerificationSettings
from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class LoopTuning:
    """Internal settings of loop closing."""

    candidates: int = setting(3, 1, 1000)
    """Old keyframes tried for a new keyframe or a lost frame, the likeliest first."""
    confirmation_gap: int = setting(5, 1, 10**6, "keyframes")
    """Largest distance between keyframes that confirm the same correction."""
    agreement_m: float = setting(0.05, 0, 1e3, "m")
    """Two corrections agree if they move the camera to positions within this distance and `agreement_deg`."""
    agreement_deg: float = setting(2.0, 0, 180, "deg")
    """Two corrections agree if they turn the camera to within this angle and `agreement_m`."""
    neighbourhood: int = setting(3, 0, 1000, "keyframes")
    """Keyframes before and after an old one whose points make its local map."""
    repair_iterations: int = setting(40, 0, 10**6)
    """Training steps after a closure, on the keyframes at both ends of the loop."""


@settings_class(frozen=True)
class LoopSettings(LoopTuning):
    """When loops are searched for and when they are accepted."""

    enabled: bool = setting(True, basic=True)
    """Close loops, and relocate lost frames among all keyframes."""
    confirmations: int = setting(2, 1, 100)
    """Consecutive keyframes that must find the same correction before a loop is closed. More reject false loops, but
    close true ones later."""
    activity: ActivitySettings = field(default_factory=ActivitySettings)
    revisits: RevisitSettings = field(default_factory=RevisitSettings)
    places: PlaceSettings = field(default_factory=PlaceSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    graph: GraphSettings = field(default_factory=GraphSettings)
