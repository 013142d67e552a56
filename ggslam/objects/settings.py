# SPDX-License-Identifier: Apache-2.0
"""Settings of the work on segments and objects. Lengths in pixels are for images 320 wide and grow with the width."""

from __future__ import annotations

from typing import Final, Literal

from ggslam.system.settings import setting, settings_class, tuning_class
from ggslam.system.tuning import Tuning

Mode = Literal["auto", "always", "never"]
REFERENCE_WIDTH: Final = 320
"""Image width that lengths in pixels of these settings are given for."""
IDS: Final = 1 << 16
"""Object ids are 16 bits."""


class ClassifierTuning(Tuning):
    """How the classifier of identity vectors is applied."""

    values_at_once = 1 << 22
    """Probabilities that are computed at a time."""


@tuning_class(frozen=True)
class CleaningSettings:
    """Numbers of cleaning masks."""

    min_area: float = setting(2.5e-4, 0, 0.1)
    """Connected pieces below this share of the image are filled from their surroundings."""
    band_pixels: int = setting(2, 0, 20, "px")
    """Distance from a boundary within which labels are checked against depth."""
    jump_m: float = setting(0.02, 0, 10, "m")
    """Neighbouring pixels lie on different surfaces if their depths differ by more than this; see `jump_relative`."""
    jump_relative: float = setting(0.02, 0, 1)
    """The same as a share of the depth; the larger of the two counts."""


@tuning_class(frozen=True)
class AssociationTuning:
    """Numbers of associating segments with objects."""

    depth_tolerance_m: float = setting(0.03, 0, 100, "m")
    """Map and measurement agree if their depths differ by less than this; see `depth_tolerance_relative`."""
    depth_tolerance_relative: float = setting(0.03, 0, 1)
    """The same as a share of the depth; the larger of the two counts."""
    min_confidence: float = setting(0.5, 0, 1)
    """Pixels whose label has a smaller share of the rendering weight are ignored."""
    min_overlap: float = setting(0.25, 0, 1)
    """A segment joins an object that covers this share of it."""
    min_continuation: float = setting(0.08, 0, 1)
    """The same for a segment that has most of what is visible of the object, such as a floor."""
    whole: float = setting(0.6, 0.5, 1)
    """An object lies in one segment if that has this share of its visible part."""
    min_visible: float = setting(2e-4, 0, 1)
    """Objects visible on a smaller share of the image are no evidence for or against a merge."""
    merge_observations: int = setting(3, 1, 10**6)
    """Times that two objects must share a segment before they are merged; see `merge_ratio`."""
    merge_ratio: float = setting(1.0, 0, 1e6)
    """Two objects are merged if they shared a segment this many times as often as not."""
    patience: int = setting(12, 1, 10**6)
    """An object is dropped if this many further keyframes do not find it again."""
    split_observations: int = setting(3, 1, 10**6)
    """Times that a part must be a segment of its own before it becomes an object; see `split_ratio`."""
    split_ratio: float = setting(2.0, 0, 1e6)
    """A part becomes an object if it was a segment of its own this many times as often as not."""


@settings_class(frozen=True)
class AssociationSettings(AssociationTuning):
    """How the segments of a keyframe are associated with objects; shares are of pixels where map and measured depth
    agree."""

    mode: Mode = "auto"
    """auto: use the ids of the masks if they are consistent over time, else associate; always: associate; never: use
    the ids."""


@tuning_class(frozen=True)
class GeometricTuning:
    """Numbers of segmenting depth images."""

    tolerance_m: float = setting(0.006, 1e-5, 10, "m")
    """Distance within which a pixel lies on a plane; `tolerance_sigmas` adds to it."""
    tolerance_sigmas: float = setting(3.0, 0, 100)
    """Standard deviations of the depth noise added to `tolerance_m`."""
    jump_m: float = setting(0.012, 1e-5, 10, "m")
    """Gap that separates two surfaces; `jump_sigmas` adds to it."""
    jump_sigmas: float = setting(4.0, 0, 100)
    """Standard deviations of the depth noise added to `jump_m`."""
    concave_degrees: float = setting(25.0, 1, 180, "deg")
    """Surfaces that meet in a concave edge sharper than this are different objects."""
    block_pixels: int = setting(8, 4, 100, "px")
    """Edge of the square blocks in which planes are searched."""
    min_plane_blocks: int = setting(6, 1, 10**6)
    """Planes of fewer blocks are left to the search for smooth surfaces."""
    plane_degrees: float = setting(8.0, 0.1, 90, "deg")
    """Neighbouring blocks may share a plane if their normals differ by less than this."""
    flat_m: float = setting(0.03, 0, 10, "m")
    """A piece within this distance of a plane belongs to it unless its colour differs."""
    color_contrast: float = setting(20.0, 0, 255)
    """Colour difference (CIELAB, channels 0 to 255) from which a flat piece is not part of its plane; 0: ignore
    colour."""
    min_area: float = setting(4e-4, 0, 0.5)
    """Segments below this share of the image are merged into a neighbour or dropped."""


@settings_class(frozen=True)
class GeometricSettings(GeometricTuning):
    """How a depth image is segmented; tolerances scale with the noise measured in each image."""

    max_depth_m: float = setting(8.0, 0.05, 1e4, "m")
    """Farther measurements are not segmented."""


@tuning_class(frozen=True)
class SameObjectSettings:
    """Numbers that decide when two objects, of two maps or of both ends of a loop, are one."""

    voxel: float = setting(0.04, 1e-3, 10, "m")
    """Edge of the voxels in which objects are compared."""
    min_shared: int = setting(12, 1, 10**9)
    """Voxels that two objects must share."""
    min_share: float = setting(0.08, 0, 1)
    """Least share of the smaller object's voxels that both fill."""
    min_overlap: float = setting(0.3, 0, 1)
    """Least share of the voxels that both maps know and either object fills, filled by both."""
    min_contained: float = setting(0.6, 0, 1)
    """Or least share of the voxels of the object that is smaller there, within `max_size_ratio`."""
    max_size_ratio: float = setting(4.0, 1, 1e6)
    """Largest size ratio of two objects of which one contains the other."""
