# SPDX-License-Identifier: Apache-2.0
"""Settings of loop closing."""

from __future__ import annotations

from dataclasses import field

from ggslam.loops.activity import ActivitySettings
from ggslam.loops.revisits import RevisitSettings
from ggslam.loops.settings import GraphSettings, PlaceSettings, VerificationSettings
from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class LoopSettings:
    """When loops are looked for, and when they are believed."""

    enabled: bool = setting(True, basic=True)
    """Whether loops are closed and lost frames are looked up among all keyframes."""
    candidates: int = setting(3, 1, 1000)
    """Old keyframes that are tried for a new one, and for a frame that is lost, the likeliest first."""
    confirmations: int = setting(2, 1, 100)
    """A loop is closed when so many keyframes in a row have found the same correction."""
    confirmation_gap: int = setting(5, 1, 10**6, "keyframes")
    """In a row: no more than so many keyframes apart."""
    agreement_m: float = setting(0.05, 0, 1e3, "m")
    """Two corrections are the same if they move the camera to places nearer than this and within `agreement_deg`."""
    agreement_deg: float = setting(2.0, 0, 180, "deg")
    """Two corrections are the same if they turn the camera to directions nearer than this and within `agreement_m`."""
    neighbourhood: int = setting(3, 0, 1000, "keyframes")
    """Keyframes before and after an old one whose points make its local map."""
    repair_iterations: int = setting(40, 0, 10**6)
    """Optimisation steps after a closure, on the keyframes at both of its ends."""
    activity: ActivitySettings = field(default_factory=ActivitySettings)
    revisits: RevisitSettings = field(default_factory=RevisitSettings)
    places: PlaceSettings = field(default_factory=PlaceSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    graph: GraphSettings = field(default_factory=GraphSettings)
