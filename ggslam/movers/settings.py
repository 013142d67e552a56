# SPDX-License-Identifier: Apache-2.0
"""Settings of the detection of moving things."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class MoverTuning:
    """Numbers of detecting moving things."""

    columns: int = setting(107, 16, 10**4, "px")
    """Approximate width of the images compared."""
    margin_m: float = setting(0.004, 0, 10, "m")
    """Largest depth difference on one surface; `margin_sigmas` adds to it."""
    margin_sigmas: float = setting(5.0, 0, 100)
    """Standard deviations of the depth noise added to `margin_m`."""
    min_passed: int = setting(2, 1, 100)
    """Frames that must have looked through a place; a clear one counts twice."""
    min_pixels: int = setting(8, 1, 10**6)
    """Least size of a moving region in the small image; a quarter of it for a segment."""
    min_share: float = setting(0.12, 0, 1)
    """A segment moves if frames looked through this share of it."""
    at_rest: float = setting(0.95, 0, 1)
    """A thing rests if all of the latest `rest_frames` frames saw this share of it in place."""
    rest_frames: int = setting(8, 1, 1000)
    """Frames of `at_rest`."""
    max_share: float = setting(0.75, 0, 1)
    """If more than this share of the image seems to move, the pose is wrong and nothing is masked."""


@settings_class(frozen=True)
class MoverSettings(MoverTuning):
    """Things that move during a recording."""

    enabled: bool = setting(True, basic=True)
    """Detect moving things and mask them out of tracking and map. Not with a rig of cameras."""
