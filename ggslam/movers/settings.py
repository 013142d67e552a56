# SPDX-License-Identifier: Apache-2.0
"""Every number of the search for things that move, documented."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class MoverSettings:
    """Things that move while a recording is made."""

    enabled: bool = setting(True, basic=True)
    """Whether they are looked for, and kept out of tracking and map; not with a rig of cameras."""
    columns: int = setting(107, 16, 10**4, "px")
    """Width of the images that are compared, about."""
    margin_m: float = setting(0.004, 0, 10, "m")
    """Depths of one surface differ by no more than this and `margin_sigmas` standard deviations of the depth camera."""
    margin_sigmas: float = setting(5.0, 0, 100)
    """See `margin_m`."""
    min_passed: int = setting(2, 1, 100)
    """So many frames have to have looked past a place at something farther; one that did so clearly, where both saw
    something smooth, counts twice."""
    min_pixels: int = setting(8, 1, 10**6)
    """Connected places of the small image that are something that moves; of a segment a quarter of them."""
    min_share: float = setting(0.12, 0, 1)
    """A segment moves if this share of it is where frames looked past."""
    at_rest: float = setting(0.95, 0, 1)
    """What is where all of the latest `rest_frames` saw it, but for a share of one minus this, has come to rest."""
    rest_frames: int = setting(8, 1, 1000)
    """See `at_rest`."""
    max_share: float = setting(0.75, 0, 1)
    """Where more than this share of what can be compared seems to move the pose is wrong, and nothing is said."""
