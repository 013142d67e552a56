# SPDX-License-Identifier: Apache-2.0
"""Every number of loop closing, documented."""

from __future__ import annotations

from dataclasses import field

from ggslam.features.orb import FeatureSettings
from ggslam.features.registration import RegistrationSettings
from ggslam.system.settings import Conflict, setting, settings_class


@settings_class(frozen=True)
class GraphSettings:
    """What the pose graph takes odometry and closures to be worth, and when it believes a closure.

    G-ICP's own covariance takes points as independent and knows no bias, so that it says tenths of millimetres where
    a run drifts by centimetres. Drift is modelled as a random walk on top of it: its variance grows with the path,
    whatever the number of keyframes on it. The defaults allow for 7 cm (one standard deviation) over 20 m.
    """

    translation_drift: float = setting(0.015, 1e-5, 10, "m")
    """Standard deviation per axis after a path of one metre; it grows with the root of the path."""
    rotation_drift_deg: float = setting(0.3, 1e-4, 90, "deg")
    """Standard deviation per axis after a path of one metre, likewise."""
    turn_length: float = setting(1.0, 0, 1e3, "m")
    """A turn by one radian counts as a path of this length."""
    loop_translation: float = setting(0.01, 1e-5, 10, "m")
    """Standard deviation of the translation per axis that is added to a closure's own."""
    loop_rotation_deg: float = setting(0.3, 1e-4, 90, "deg")
    """Standard deviation of the rotation per axis that is added to a closure's own."""
    found_translation: float = setting(0.02, 1e-5, 10, "m")
    """Standard deviation of the translation per axis that is added where a camera that was lost is found again: it is
    located by one frame alone."""
    found_rotation_deg: float = setting(0.7, 1e-4, 90, "deg")
    """Standard deviation of the rotation per axis that is added there."""
    drift_probability: float = setting(0.999, 0.5, 1 - 1e-12)
    """A closure is dismissed when drift stays below its correction with this probability."""
    inlier_probability: float = setting(0.99, 0.5, 1 - 1e-12)
    """Closures that agree have residuals below the chi-square limit of this probability (GNC's threshold)."""


@settings_class(frozen=True)
class PlaceSettings:
    """How places are described and compared."""

    features: FeatureSettings = field(default_factory=lambda: FeatureSettings(count=1000))
    """Of the ORB features that a place is known by."""
    bits: int = setting(16, 1, 24, "bits")
    """Bits of the descriptor that make a word."""
    tables: int = setting(8, 1, 100)
    """Words that a descriptor makes."""
    entries: int = setting(20000, 1, 10**9)
    """A query reads so many entries of the words' lists, those of the rarest words first."""
    ferns: int = setting(500, 1, 10**5)
    """Pixels of the thumbnail that are compared."""
    near: float = setting(0.8, 0, 1e3, "m")
    """Ferns tell near from far by a depth drawn between this and `far`."""
    far: float = setting(3.5, 0, 1e3, "m")
    """Ferns tell near from far by a depth drawn between `near` and this."""
    shortlist: int = setting(50, 1, 10**6)
    """So many keyframes with the most common words have their thumbnails compared."""
    support: float = setting(0.25, 0, 1)
    """A keyframe next in time that scores as well adds this share to a score; a lucky hit stands alone."""

    def __post_init__(self) -> None:
        if self.near >= self.far:
            raise Conflict("far", f"expected more than near, {self.near:g}, found {self.far:g}")


@settings_class(frozen=True)
class VerificationSettings:
    """What a closure has to show before it goes into the graph. Lengths follow the depth noise."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    """Of the feature matches."""
    min_inliers: int = setting(15, 6, 10**5)
    """Matches that agree with one pose."""
    min_cells: int = setting(5, 1, 16)
    """Of the 4x4 cells of the image, so many have inliers."""
    min_cells_alike: int = setting(4, 1, 16)
    """So many are enough where the surfaces have 1.5 times as much in common as `min_overlap` asks for."""
    min_kept: float = setting(0.6, 0, 1)
    """After refinement by geometry this share of the inliers still agrees (within twice the limits): a refinement that
    slides along a wall or into another minimum leaves the matches behind."""
    min_alignment_overlap: float = setting(0.5, 0, 1)
    """Share of the points that G-ICP matches to the old surface."""
    max_rmse_constant: float = setting(0.01, 0, 10, "m")
    """G-ICP's RMSE stays below this; `max_rmse_sigmas` adds to it."""
    max_rmse_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations sigma(z) at the points' median depth z added to `max_rmse_constant`."""
    min_overlap: float = setting(0.4, 0, 1)
    """Share of the new points' voxels that the old points also fill."""
    voxel_constant: float = setting(0.03, 1e-3, 10, "m")
    """Edge of the voxels of `min_overlap`; `voxel_sigmas` adds to it."""
    voxel_sigmas: float = setting(4.0, 0, 100)
    """Standard deviations sigma(z) added to `voxel_constant`."""
