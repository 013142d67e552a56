# SPDX-License-Identifier: Apache-2.0
"""Settings of change detection."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class ChangeSettings:
    """When something counts as changed. Lengths go with the size of the scene, these are a room's."""

    width: int = setting(320, 16, 10**4, "px")
    """Width of the pictures of the maps that surfaces are looked up in, at most that of the keyframes."""
    opaque: float = setting(0.8, 0.1, 1)
    """A map has a surface where its picture is so opaque."""
    tolerance_m: float = setting(0.015, 1e-4, 10, "m")
    """Surfaces so near to each other are one..."""
    tolerance_relative: float = setting(0.008, 0, 1)
    """...or so near for their distance from the camera, as a share of it..."""
    tolerance_spread: float = setting(4.0, 0, 100)
    """...or this many times what the maps' surfaces usually differ by, as a share of the distance, if that is more."""
    measured_m: float = setting(0.01, 1e-4, 10, "m")
    """What lies farther off the surface that was measured..."""
    measured_relative: float = setting(0.012, 0, 1)
    """...and farther for its distance from the camera, as a share of it..."""
    around_m: float = setting(0.06, 1e-3, 10, "m")
    """...within this distance was not measured: maps go on behind what was seen."""
    contradicted: float = setting(0.15, 0, 1)
    """What a visit saw through itself, in more than this share of its views of it, is no surface."""
    min_views: int = setting(2, 1, 1000)
    """Keyframes that have to agree that something is gone, or still there."""
    min_points: int = setting(60, 1, 10**6)
    """Things of fewer points are not looked at."""
    min_seen: float = setting(0.2, 0, 1)
    """Nothing is said of a thing of which less than this share was seen by the other visit."""
    min_changed: float = setting(0.12, 0, 1)
    """A thing of which less than this share changed is where it was."""
    shifted: float = setting(0.25, 0, 1)
    """Where ids are believed, a thing was pushed along what it lies on if this share of it or more is something else in
    the other visit, both ways."""
    min_width: float = setting(2.0, 0, 100)
    """What is gone and is no object by itself has to be so many times as wide as surfaces differ: at outlines maps err
    by slivers."""
    whole: float = setting(0.5, 0, 1)
    """A thing of which more than this share is gone is gone as a whole; of one with less, the gone part alone."""
    linking_m: float = setting(0.03, 1e-3, 10, "m")
    """Changed places nearer to each other than this belong to one thing."""
    spacing_m: float = setting(0.005, 1e-4, 1, "m")
    """Distance of the points that surfaces are compared by."""
    fit_m: float = setting(0.012, 1e-4, 1, "m")
    """Surfaces of one thing before and after lie so near to each other once it is moved back."""
    min_fit: float = setting(0.8, 0, 1)
    """Share of a thing's surface that has to fit, of what both visits saw of it."""
    max_color: float = setting(0.1, 0, 1)
    """Colours of one thing differ by no more than this, mean of the channels' medians."""
    max_size_ratio: float = setting(1.6, 1, 100)
    """Things of more different size are not compared."""
    least_motion_m: float = setting(0.012, 0, 10, "m")
    """A thing that moved less..."""
    least_turn_deg: float = setting(4.0, 0, 180, "deg")
    """...and turned less did not move."""
    look: float = setting(0.16, 0, 1)
    """A thing whose colours differ by more than this, brightness of the whole apart, has changed its look."""
    swapped: float = setting(0.07, 0, 1)
    """A thing of which a part changed, and whose colours differ by more than this, is another thing."""
    ids_alike: float = setting(0.9, 0, 1)
    """Where so many of the things that stayed have the same id in both visits, ids are believed."""
    favour: float = setting(4.0, 1, 1e6)
    """To bring a map up to date: what the newer visit measured counts so many times where both measured a place."""
