# SPDX-License-Identifier: Apache-2.0
"""Settings of the work on segments and objects. Lengths in pixels are for images 320 wide and grow with the width."""

from __future__ import annotations

from typing import Literal

from ggslam.system.settings import setting, settings_class

Mode = Literal["auto", "always", "never"]


@settings_class(frozen=True)
class CleaningSettings:
    """What is taken out of the masks before they are used."""

    min_area: float = setting(2.5e-4, 0, 0.1)
    """Connected pieces below this share of the image are dots (19 pixels at 320x240); the surroundings fill them."""
    band_pixels: int = setting(2, 0, 20, "px")
    """How far from a segment's boundary its label is checked against depth."""
    jump_m: float = setting(0.02, 0, 10, "m")
    """Neighbouring pixels whose depths differ by more than this are on different surfaces; see `jump_relative`."""
    jump_relative: float = setting(0.02, 0, 1)
    """As `jump_m`, a share of the depth; the larger of the two counts."""


@settings_class(frozen=True)
class AssociationSettings:
    """How the segments of a keyframe find their objects. Shares are of pixels where map and measured depth agree."""

    mode: Mode = "auto"
    """auto: use the masks' own ids when they prove consistent over time; always: associate; never: trust the ids."""
    depth_tolerance_m: float = setting(0.03, 0, 100, "m")
    """Map and measurement show the same surface if their depths differ by less than this; see
    `depth_tolerance_relative`."""
    depth_tolerance_relative: float = setting(0.03, 0, 1)
    """As `depth_tolerance_m`, a share of the depth; the larger of the two counts."""
    min_confidence: float = setting(0.5, 0, 1)
    """Pixels whose label has a smaller share of the rendering weight say nothing."""
    min_overlap: float = setting(0.25, 0, 1)
    """A segment goes to an object that already shows on this share of it; see `min_continuation`."""
    min_continuation: float = setting(0.08, 0, 1)
    """As `min_overlap`, of a segment that has most of what is seen of the object (a floor that continues)."""
    whole: float = setting(0.6, 0.5, 1)
    """An object is found in one segment if the segment has this share of its visible part."""
    min_visible: float = setting(2e-4, 0, 1)
    """Objects visible on a smaller share of the image are no evidence for or against a merge."""
    merge_observations: int = setting(3, 1, 10**6)
    """Two objects become one after lying together in one segment this often; see `merge_ratio`."""
    merge_ratio: float = setting(1.0, 0, 1e6)
    """Two objects become one if they lay together this many times as often as apart."""
    patience: int = setting(12, 1, 10**6)
    """An object that none of so many further keyframes found again is forgotten: noise of a segmenter."""
    split_observations: int = setting(3, 1, 10**6)
    """A part of an object becomes an object after being a segment of its own this often; see `split_ratio`."""
    split_ratio: float = setting(2.0, 0, 1e6)
    """A part becomes an object if it was a segment of its own this many times as often as in that of the rest."""


@settings_class(frozen=True)
class GeometricSettings:
    """How a depth image falls into segments. Depth tolerances are sums of a floor and of multiples of the noise, which
    is measured in every image."""

    tolerance_m: float = setting(0.006, 1e-5, 10, "m")
    """Distance from a plane within which a pixel lies on it; `tolerance_sigmas` adds to it."""
    tolerance_sigmas: float = setting(3.0, 0, 100)
    """Standard deviations sigma(z) of the depth noise added to `tolerance_m`."""
    jump_m: float = setting(0.012, 1e-5, 10, "m")
    """Gap between two surfaces that separates them; `jump_sigmas` adds to it."""
    jump_sigmas: float = setting(4.0, 0, 100)
    """Standard deviations sigma(z) of the depth noise added to `jump_m`."""
    concave_degrees: float = setting(25.0, 1, 180, "deg")
    """Surfaces that meet in a concave edge sharper than this are different objects."""
    block_pixels: int = setting(8, 4, 100, "px")
    """Planes are looked for in square blocks of this size."""
    min_plane_blocks: int = setting(6, 1, 10**6)
    """Planes with fewer blocks are left to the search for smooth surfaces."""
    plane_degrees: float = setting(8.0, 0.1, 90, "deg")
    """Neighbouring blocks whose normals differ by less than this may share a plane."""
    flat_m: float = setting(0.03, 0, 10, "m")
    """Pieces no higher above or lower below a plane than this are a part of it unless their colour differs."""
    color_contrast: float = setting(20.0, 0, 255)
    """Difference of colour (CIELAB, each channel scaled to 0 to 255) from which what lies flat on a plane is something
    else than the plane. 0: colour is not looked at."""
    min_area: float = setting(4e-4, 0, 0.5)
    """Segments below this share of the image are joined to a neighbour on the same surface, or left unlabelled; of
    six times this share they are joined, too, if they look like noise of a plane."""
    max_depth_m: float = setting(8.0, 0.05, 1e4, "m")
    """Farther measurements are left unlabelled."""


@settings_class(frozen=True)
class SameObjectSettings:
    """When objects of two maps, or of both ends of a loop, are one thing."""

    voxel: float = setting(0.04, 1e-3, 10, "m")
    """Edge of the voxels in which objects are compared."""
    min_shared: int = setting(12, 1, 10**9)
    """Voxels that two objects have in common at least."""
    min_share: float = setting(0.08, 0, 1)
    """Share of the smaller object's voxels that they have in common at least: things that only touch have less."""
    min_overlap: float = setting(0.3, 0, 1)
    """Of the voxels that both maps know and either object fills, so many are filled by both."""
    min_contained: float = setting(0.6, 0, 1)
    """Or so many of the voxels of the object that is smaller there, as long as `max_size_ratio` is kept."""
    max_size_ratio: float = setting(4.0, 1, 1e6)
    """A piece is the whole only if that is at most so many times larger: a cup on a table is no piece of it."""
