# SPDX-License-Identifier: Apache-2.0
"""Settings of loop closing."""

from __future__ import annotations

from dataclasses import field

from ggslam.features.orb import FeatureSettings
from ggslam.features.registration import RegistrationSettings
from ggslam.system.settings import Conflict, setting, settings_class, tuning_class


@tuning_class(frozen=True)
class GraphSettings:
    """Weights of odometry and closures in the pose graph, and when a closure is accepted.

    G-ICP's own covariance takes points as independent and knows no bias, so that it says tenths of millimetres where
    a run drifts by centimetres. Drift is modelled as a random walk on top of it: its variance grows with the path,
    whatever the number of keyframes on it. The defaults allow for 7 cm (one standard deviation) over 20 m.
    """

    translation_drift: float = setting(0.015, 1e-5, 10, "m")
    """Standard deviation of odometry per axis after 1 m; it grows with the root of the path."""
    rotation_drift_deg: float = setting(0.3, 1e-4, 90, "deg")
    """Standard deviation of odometry per axis after 1 m; it grows with the root of the path."""
    turn_length: float = setting(1.0, 0, 1e3, "m")
    """Path length that a turn by one radian counts as."""
    loop_translation: float = setting(0.01, 1e-5, 10, "m")
    """Standard deviation per axis added to a closure's translation."""
    loop_rotation_deg: float = setting(0.3, 1e-4, 90, "deg")
    """Standard deviation per axis added to a closure's rotation."""
    found_translation: float = setting(0.02, 1e-5, 10, "m")
    """Standard deviation per axis added to the translation of a relocated frame."""
    found_rotation_deg: float = setting(0.7, 1e-4, 90, "deg")
    """Standard deviation per axis added to the rotation of a relocated frame."""
    drift_probability: float = setting(0.999, 0.5, 1 - 1e-12)
    """A closure is dismissed if drift stays below its correction with this probability."""
    inlier_probability: float = setting(0.99, 0.5, 1 - 1e-12)
    """Probability of the chi-square limit on residuals of agreeing closures (threshold of GNC)."""


@tuning_class(frozen=True)
class PlaceSettings:
    """Place recognition."""

    features: FeatureSettings = field(default_factory=lambda: FeatureSettings(count=1000))
    """Of the ORB features that a place is known by."""
    bits: int = setting(16, 1, 24, "bits")
    """Bits of a descriptor that make a word."""
    tables: int = setting(8, 1, 100)
    """Words of a descriptor."""
    entries: int = setting(20000, 1, 10**9)
    """List entries that a query reads, those of the rarest words first."""
    ferns: int = setting(500, 1, 10**5)
    """Pixels of a thumbnail that are compared."""
    near: float = setting(0.8, 0, 1e3, "m")
    """Lower bound of the depth thresholds of ferns."""
    far: float = setting(3.5, 0, 1e3, "m")
    """Upper bound of the depth thresholds of ferns."""
    shortlist: int = setting(50, 1, 10**6)
    """Keyframes with the most common words whose thumbnails are compared."""
    support: float = setting(0.25, 0, 1)
    """Share of the score of the next keyframe in time that is added to a score."""

    def __post_init__(self) -> None:
        if self.near >= self.far:
            raise Conflict("far", f"expected more than near, {self.near:g}, found {self.far:g}")


@tuning_class(frozen=True)
class VerificationTuning:
    """Numbers of the check of a closure."""

    min_cells: int = setting(5, 1, 16)
    """Cells of the image's 4 x 4 grid that must contain inliers."""
    min_cells_alike: int = setting(4, 1, 16)
    """Cells required if the surfaces overlap by 1.5 times `min_overlap`."""
    min_kept: float = setting(0.6, 0, 1)
    """Share of the inliers that must still agree, within twice the limits, after alignment of the geometry."""
    min_alignment_overlap: float = setting(0.5, 0, 1)
    """Least share of points that G-ICP matches to the old surface."""
    max_rmse_constant: float = setting(0.01, 0, 10, "m")
    """Largest RMSE of G-ICP; `max_rmse_sigmas` adds to it."""
    max_rmse_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations of the depth noise at the median depth added to `max_rmse_constant`."""
    min_overlap: float = setting(0.4, 0, 1)
    """Least share of the new points' voxels that old points fill."""
    voxel_constant: float = setting(0.03, 1e-3, 10, "m")
    """Edge of the voxels of `min_overlap`; `voxel_sigmas` adds to it."""
    voxel_sigmas: float = setting(4.0, 0, 100)
    """Standard deviations of the depth noise added to `voxel_constant`."""


@settings_class(frozen=True)
class VerificationSettings(VerificationTuning):
    """What a loop closure must show to be accepted; lengths scale with the depth noise."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    """Of the feature matches."""
    min_inliers: int = setting(15, 6, 10**5)
    """Feature matches that must agree on one pose. More reject false loops, but lose true ones."""
