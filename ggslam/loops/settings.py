# SPDX-License-Identifier: Apache-2.0
"""Every number of loop closing, documented."""

from __future__ import annotations

from dataclasses import dataclass, field

from ggslam.errors import check_ranges
from ggslam.features.orb import FeatureSettings
from ggslam.features.registration import RegistrationSettings


@dataclass(frozen=True)
class GraphSettings:
    """What the pose graph takes odometry and closures to be worth, and when it believes a closure.

    G-ICP's own covariance takes points as independent and knows no bias, so that it says tenths of millimetres where
    a run drifts by centimetres. Drift is modelled as a random walk on top of it: its variance grows with the path,
    whatever the number of keyframes on it. The defaults allow for 7 cm (one standard deviation) over 20 m.
    """

    translation_drift: float = 0.015
    """Standard deviation per axis in metres after a path of one metre; it grows with the root of the path."""
    rotation_drift_deg: float = 0.3
    """Likewise, degrees."""
    turn_length: float = 1.0
    """A turn by one radian counts as a path of so many metres."""
    loop_translation: float = 0.01
    loop_rotation_deg: float = 0.3
    """Standard deviation per axis (metres, degrees) that is added to a closure's own."""
    drift_probability: float = 0.999
    """A closure is dismissed when drift stays below its correction with this probability."""
    inlier_probability: float = 0.99
    """Closures that agree have residuals below the chi-square limit of this probability (GNC's threshold)."""

    def __post_init__(self) -> None:
        ranges = {
            "translation_drift": (1e-5, 10), "rotation_drift_deg": (1e-4, 90), "turn_length": (0, 1e3),
            "loop_translation": (1e-5, 10), "loop_rotation_deg": (1e-4, 90), "drift_probability": (0.5, 1 - 1e-12),
            "inlier_probability": (0.5, 1 - 1e-12),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class PlaceSettings:
    """How places are described and compared."""

    features: FeatureSettings = field(default_factory=lambda: FeatureSettings(count=1000))
    """Of the ORB features that a place is known by."""
    bits: int = 16
    tables: int = 8
    """A descriptor makes `tables` words of so many of its bits each."""
    entries: int = 20000
    """A query reads so many entries of the words' lists, those of the rarest words first."""
    ferns: int = 500
    """Pixels of the thumbnail that are compared."""
    near: float = 0.8
    far: float = 3.5
    """Depths in metres between which ferns tell near from far."""
    shortlist: int = 50
    """So many keyframes with the most common words have their thumbnails compared."""
    support: float = 0.25
    """A keyframe next in time that scores as well adds this share to a score; a lucky hit stands alone."""

    def __post_init__(self) -> None:
        ranges = {
            "bits": (1, 24), "tables": (1, 100), "entries": (1, 10**9), "ferns": (1, 10**5), "near": (0, 1e3),
            "far": (0, 1e3), "shortlist": (1, 10**6), "support": (0, 1),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class VerificationSettings:
    """What a closure has to show before it goes into the graph. Lengths follow the depth noise."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    """Of the feature matches."""
    min_inliers: int = 15
    """Matches that agree with one pose."""
    min_cells: int = 5
    """Of the 4x4 cells of the image, so many have inliers."""
    min_kept: float = 0.6
    """After refinement by geometry this share of the inliers still agrees (within twice the limits): a refinement that
    slides along a wall or into another minimum leaves the matches behind."""
    min_alignment_overlap: float = 0.5
    """Share of the points that G-ICP matches to the old surface."""
    max_rmse_constant: float = 0.01
    max_rmse_sigmas: float = 2.0
    """G-ICP's RMSE stays below constant + sigmas sigma(z) metres at the points' median depth z."""
    min_overlap: float = 0.4
    """Share of the new points' voxels that the old points also fill."""
    voxel_constant: float = 0.03
    voxel_sigmas: float = 4.0
    """Edge of those voxels in metres: constant + sigmas sigma(z)."""

    def __post_init__(self) -> None:
        ranges = {
            "min_inliers": (6, 10**5), "min_cells": (1, 16), "min_kept": (0, 1), "min_alignment_overlap": (0, 1),
            "max_rmse_constant": (0, 10), "max_rmse_sigmas": (0, 100), "min_overlap": (0, 1),
            "voxel_constant": (1e-3, 10), "voxel_sigmas": (0, 100),
        }  # fmt: skip
        check_ranges(self, ranges)
