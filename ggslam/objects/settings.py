# SPDX-License-Identifier: Apache-2.0
"""Settings of the work on segments and objects. Lengths in pixels are for images 320 wide and grow with the width."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ggslam.errors import ConfigError, check_ranges

Mode = Literal["auto", "always", "never"]


@dataclass(frozen=True)
class CleaningSettings:
    """What is taken out of the masks before they are used."""

    min_area: float = 2.5e-4
    """Connected pieces below this share of the image are dots (19 pixels at 320x240); the surroundings fill them."""
    band_pixels: int = 2
    """How far from a segment's boundary its label is checked against depth."""
    jump_m: float = 0.02
    """Neighbouring pixels whose depths differ by more than this are on different surfaces..."""
    jump_relative: float = 0.02
    """...or by more than this share of their depth, whichever is larger."""

    def __post_init__(self) -> None:
        ranges = {"min_area": (0, 0.1), "band_pixels": (0, 20), "jump_m": (0, 10), "jump_relative": (0, 1)}
        check_ranges(self, ranges)


@dataclass(frozen=True)
class AssociationSettings:
    """How the segments of a keyframe find their objects. Shares are of pixels where map and measured depth agree."""

    mode: Mode = "auto"
    """auto: use the masks' own ids when they prove consistent over time; always: associate; never: trust the ids."""
    depth_tolerance_m: float = 0.03
    """Map and measurement show the same surface if their depths differ by less than this..."""
    depth_tolerance_relative: float = 0.03
    """...or by less than this share of the depth, whichever is larger."""
    min_confidence: float = 0.5
    """Pixels whose label has a smaller share of the rendering weight say nothing."""
    min_overlap: float = 0.25
    """A segment goes to an object that already shows on this share of it..."""
    min_continuation: float = 0.08
    """...or on this share, if it has most of what is seen of the object (a floor that continues)."""
    whole: float = 0.6
    """An object is found in one segment if the segment has this share of its visible part."""
    min_visible: float = 2e-4
    """Objects visible on a smaller share of the image are no evidence for or against a merge."""
    merge_observations: int = 3
    """Two objects become one after lying together in one segment this often..."""
    merge_ratio: float = 1.0
    """...if together outweighs apart by this factor."""
    split_observations: int = 3
    """A part of an object becomes an object after being a segment of its own this often..."""
    split_ratio: float = 2.0
    """...if that is this many times as often as being in the segment of the rest."""

    def __post_init__(self) -> None:
        if self.mode not in ("auto", "always", "never"):
            raise ConfigError(f"AssociationSettings.mode: expected auto, always or never, found '{self.mode}'")
        ranges = {
            "depth_tolerance_m": (0, 100), "depth_tolerance_relative": (0, 1), "min_confidence": (0, 1),
            "min_overlap": (0, 1), "min_continuation": (0, 1), "whole": (0.5, 1), "min_visible": (0, 1),
            "merge_observations": (1, 10**6), "merge_ratio": (0, 1e6),
            "split_observations": (1, 10**6), "split_ratio": (0, 1e6),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class GeometricSettings:
    """How a depth image falls into segments. Depth tolerances are sums of a floor and of multiples of the noise, which
    is measured in every image."""

    tolerance_m: float = 0.006
    """Distance from a plane within which a pixel lies on it, without noise..."""
    tolerance_sigmas: float = 3.0
    """...plus this many standard deviations of the depth noise."""
    jump_m: float = 0.012
    """Gap between two surfaces that separates them, without noise..."""
    jump_sigmas: float = 4.0
    """...plus this many standard deviations of the depth noise."""
    concave_degrees: float = 25.0
    """Surfaces that meet in a concave edge sharper than this are different objects."""
    block_pixels: int = 8
    """Planes are looked for in square blocks of this size."""
    min_plane_blocks: int = 6
    """Planes with fewer blocks are left to the search for smooth surfaces."""
    plane_degrees: float = 8.0
    """Neighbouring blocks whose normals differ by less than this may share a plane."""
    min_area: float = 4e-4
    """Segments below this share of the image are joined to a neighbour on the same surface, or left unlabelled."""
    max_depth_m: float = 8.0
    """Farther measurements are left unlabelled."""

    def __post_init__(self) -> None:
        ranges = {
            "tolerance_m": (1e-5, 10), "tolerance_sigmas": (0, 100), "jump_m": (1e-5, 10), "jump_sigmas": (0, 100),
            "concave_degrees": (1, 180), "block_pixels": (4, 100), "min_plane_blocks": (1, 10**6),
            "plane_degrees": (0.1, 90), "min_area": (0, 0.5), "max_depth_m": (0.05, 1e4),
        }  # fmt: skip
        check_ranges(self, ranges)
