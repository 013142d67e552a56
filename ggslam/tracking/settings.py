# SPDX-License-Identifier: Apache-2.0
"""Every number of the tracker, documented. One default serves all recordings: lengths follow the depth noise, the
resolution and the distance of the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ggslam.errors import check_ranges
from ggslam.features.orb import FeatureSettings

PhotometricMode = Literal["never", "degenerate", "auto", "always"]


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth measurement: sigma(z) = constant + square z^2 (z, sigma in metres).

    The default is a structured-light camera's (Khoshelham and Oude Elberink, Sensors 2012, round the values up).
    """

    constant: float = 0.0012
    """Metres."""
    square: float = 0.0019
    """Metres per square metre of depth."""

    def sigma(self, z: float) -> float:
        """Standard deviation in metres at depth `z`."""
        return self.constant + self.square * z * z

    def __post_init__(self) -> None:
        ranges = {
            "constant": (1e-6, 1),
            "square": (0, 1),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class PointSettings:
    """How points are taken from a depth image."""

    count: int = 5000
    """Points aimed at; the pixel stride follows from it and the number of pixels with depth."""
    window: int = 2
    """Neighbours come from (2 window + 1)^2 samples, about as far apart as a pixel of a 320-pixel-wide image."""
    min_neighbours: float = 0.6
    """Share of the window that must lie on the point's surface, or the point is dropped."""
    min_depth: float = 0.1
    max_depth: float = 8.0
    """Depth range in metres; in scenes larger than a room the upper bound goes with the first frame's median depth."""
    min_thickness: float = 0.01
    """Lower bound of the smallest regularised eigenvalue (equation 1 of GS-ICP): a plane's thickness."""
    max_elongation: float = 4.0
    """Upper bound of the largest regularised eigenvalue."""

    def __post_init__(self) -> None:
        ranges = {
            "count": (50, 10**6),
            "window": (1, 20),
            "min_neighbours": (0, 1),
            "min_depth": (0, 1e4),
            "max_depth": (0, 1e4),
            "min_thickness": (1e-4, 1),
            "max_elongation": (1, 1e4),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class TargetSettings:
    """How the map's Gaussians become what a frame is aligned to."""

    voxel: float = 0.03
    """Edge of a fine voxel in metres in a room, where the first frame's median depth is 1 to 4 m; in larger and smaller
    scenes it goes with that depth (`scale`). Coarse voxels are four times as wide."""
    min_opacity: float = 0.1
    """Gaussians less opaque than this take no part."""
    min_thickness: float = 0.01
    max_thickness: float = 0.01
    """Bounds of a voxel's smallest regularised eigenvalue. The upper one keeps a noisy plane a plane."""
    max_elongation: float = 4.0
    """Upper bound of the largest regularised eigenvalue."""
    scatter_weight: float = 1.0
    """Weight of the scatter of the means against the Gaussians' own covariances in a voxel's shape."""
    neighbour_weight: float = 0.3
    """Weight of the 26 neighbours in a voxel's scatter."""

    def __post_init__(self) -> None:
        ranges = {
            "voxel": (1e-3, 10),
            "min_opacity": (1e-3, 0.999),
            "min_thickness": (1e-4, 1),
            "max_elongation": (1, 1e4),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class AlignSettings:
    """How points are aligned to a target."""

    coarse_iterations: int = 6
    coarse_points: int = 1500
    """Iterations and points at the coarse level; 0 iterations: fine level only."""
    fine_iterations: int = 12
    translation_tolerance: float = 1e-4
    rotation_tolerance: float = 5e-5
    """The iteration stops at a step below both (metres, radians)."""
    kernel_constant: float = 0.01
    kernel_sigmas: float = 2.0
    """Width of the Geman-McClure kernel in metres: constant + sigmas sigma(z)."""
    coarse_kernel_factor: float = 2.0
    """The coarse level's kernel is this much wider."""
    overlap_constant: float = 0.01
    overlap_sigmas: float = 2.0
    """A match is an inlier if its point-to-plane distance is below constant + sigmas sigma(z), metres."""
    min_normal_dot: float = 0.5
    """Normals of a match agree to this cosine."""
    min_matches: int = 100
    degenerate_below: float = 0.01
    """Geometry is degenerate if some direction of motion is seen by less than this share of the points."""


@dataclass(frozen=True)
class PhotometricSettings:
    """The photometric part of the alignment (direct image alignment, Huber norm)."""

    mode: PhotometricMode = "auto"
    """never; degenerate: where geometry leaves a direction of motion open; always; auto: always if the depth camera is
    noisy, else where geometry is degenerate."""
    noisy_m: float = 0.001
    """For "auto": the depth camera is noisy if its standard deviation at the median depth is above this, metres."""
    shrink: int = 2
    """Images are this many times smaller, for 320-pixel-wide ones; wider ones are shrunk more."""
    points: int = 5000
    """Textured points at most."""
    min_gradient: float = 0.02
    """A point is textured if grey, in [0, 1], changes by this per (shrunken) pixel."""
    sigma: float = 0.03
    """Standard deviation of a residual, grey levels in [0, 1]."""
    weight: float = 0.2
    """Weight against the geometry when both are weighed by their noise, per point."""
    surface_sigma: float = 0.002
    """Metres; the geometry's noise at 1 m is taken to be no less."""
    huber: float = 0.05
    """Grey difference from which a residual counts linearly."""
    depth_tolerance: float = 0.05
    """A pixel of the reference is occluded if its depth differs by more than this share."""
    renew_translation: float = 0.1
    """A frame becomes the reference after a motion of this many times the median depth since the last one."""
    renew_rotation_deg: float = 8.0
    """Likewise, degrees."""


@dataclass(frozen=True)
class RecoverySettings:
    """What happens when constant velocity does not lead to the pose."""

    convincing_overlap: float = 0.6
    """Under this overlap other starts are tried, too."""
    convincing_residual: float = 0.04
    """Over this mean grey difference, where grey values were compared, other starts are tried, too."""
    min_overlap: float = 0.25
    """Under this overlap from every start the frame is lost."""
    min_share: float = 0.2
    """A pose short of the convincing overlap is believed only if this share of the textured points was compared."""
    views: int = 2
    """Located frames whose features are matched, the latest first."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    """Of the frames, and when their matches make a start."""


@dataclass(frozen=True)
class TrackerSettings:
    """Everything the tracker needs to know."""

    noise: DepthNoise | None = None
    """Of the depth camera; None: measured on the first frame (`noise.estimate_noise`)."""
    points: PointSettings = field(default_factory=PointSettings)
    target: TargetSettings = field(default_factory=TargetSettings)
    align: AlignSettings = field(default_factory=AlignSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    recovery: RecoverySettings = field(default_factory=RecoverySettings)
