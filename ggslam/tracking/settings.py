# SPDX-License-Identifier: Apache-2.0
"""Every number of the tracker, documented. One default serves all recordings: lengths follow the depth noise, the
resolution and the distance of the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ggslam.features.orb import FeatureSettings
from ggslam.system.savable import savable
from ggslam.system.settings import Conflict, setting, settings_class

PhotometricMode = Literal["never", "degenerate", "auto", "always"]
UNBOUNDED = 1e9
"""A weight that no point has: the nearest, at 0.1 m, is 10^4 times that at 1 m at most."""


@savable()
@settings_class(frozen=True)
class DepthNoise:
    """Standard deviation of a depth measurement: sigma(z) = constant + square z^2 (z, sigma in metres).

    The default is a structured-light camera's (Khoshelham and Oude Elberink, Sensors 2012, round the values up).
    """

    constant: float = setting(0.0012, 1e-6, 1, "m")
    """At the camera."""
    square: float = setting(0.0019, 0, 1, "1/m")
    """Growth with the squared depth."""

    def sigma(self, z: float) -> float:
        """Standard deviation in metres at depth `z`."""
        return self.constant + self.square * z * z

    def in_pixels(self, z: float, focal_length: float) -> float:
        """As wide as `sigma(z)` is in the image at depth `z` > 0, pixels as `focal_length` is."""
        return self.sigma(z) * focal_length / z


@settings_class(frozen=True)
class PointSettings:
    """How points are taken from a depth image."""

    count: int = setting(5000, 50, 10**6)
    """Points aimed at; the pixel stride follows from it and the number of pixels with depth."""
    window: int = setting(2, 1, 20)
    """Neighbours come from (2 window + 1)^2 samples, about as far apart as a pixel of a 320-pixel-wide image."""
    min_neighbours: float = setting(0.6, 0, 1)
    """Share of the window that must lie on the point's surface, or the point is dropped."""
    min_depth: float = setting(0.1, 0, 1e4, "m")
    """Nearer depth is not used."""
    max_depth: float = setting(8.0, 0.01, 1e4, "m", basic=True)
    """Farther depth is not used; in scenes larger than a room this bound goes with the first frame's median depth."""
    min_thickness: float = setting(0.01, 1e-4, 1)
    """Lower bound of the smallest regularised eigenvalue (equation 1 of GS-ICP): a plane's thickness."""
    max_elongation: float = setting(4.0, 1, 1e4)
    """Upper bound of the largest regularised eigenvalue."""
    near_weight: float = setting(UNBOUNDED, 1, UNBOUNDED)
    """Near points, whose noise is less, weigh at most so many times what one at the frame's median depth does."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")


@settings_class(frozen=True)
class TargetSettings:
    """How the map's Gaussians become what a frame is aligned to."""

    voxel: float = setting(0.03, 1e-3, 10, "m")
    """Edge of a fine voxel in a room, where the first frame's median depth is 1 to 4 m; in larger and smaller scenes it
    goes with that depth (`scale`). Coarse voxels are four times as wide."""
    min_opacity: float = setting(0.1, 1e-3, 0.999)
    """Gaussians less opaque than this take no part."""
    min_thickness: float = setting(0.01, 1e-4, 1)
    """Lower bound of a voxel's smallest regularised eigenvalue."""
    max_thickness: float = setting(0.01, 1e-4, 1)
    """Upper bound of the same: keeps a noisy plane a plane."""
    max_elongation: float = setting(4.0, 1, 1e4)
    """Upper bound of the largest regularised eigenvalue."""
    scatter_weight: float = setting(1.0, 0, 1e3)
    """Weight of the scatter of the means against the Gaussians' own covariances in a voxel's shape."""
    neighbour_weight: float = setting(0.3, 0, 1e3)
    """Weight of the 26 neighbours in a voxel's scatter."""

    def __post_init__(self) -> None:
        if self.min_thickness > self.max_thickness:
            raise Conflict(
                "max_thickness",
                f"expected min_thickness, {self.min_thickness:g}, or more, found {self.max_thickness:g}",
            )


@settings_class(frozen=True)
class AlignSettings:
    """How points are aligned to a target."""

    coarse_iterations: int = setting(6, 0, 1000)
    """Iterations at the coarse level; 0: fine level only."""
    coarse_points: int = setting(1500, 50, 10**6)
    """Points used at the coarse level."""
    fine_iterations: int = setting(30, 1, 1000)
    """Iterations at the fine level."""
    translation_tolerance: float = setting(1e-4, 0, 1, "m")
    """The iteration stops at a step below this and `rotation_tolerance`."""
    rotation_tolerance: float = setting(5e-5, 0, 1, "rad")
    """The iteration stops at a step below this and `translation_tolerance`."""
    kernel_constant: float = setting(0.01, 1e-4, 10, "m")
    """Width of the Geman-McClure kernel; `kernel_sigmas` adds to it."""
    kernel_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations sigma(z) of the depth noise added to `kernel_constant`."""
    coarse_kernel_factor: float = setting(2.0, 0.1, 100)
    """The coarse level's kernel is this much wider."""
    overlap_constant: float = setting(0.01, 1e-4, 10, "m")
    """A match is an inlier if its point-to-plane distance is below this; `overlap_sigmas` adds to it."""
    overlap_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations sigma(z) of the depth noise added to `overlap_constant`."""
    min_normal_dot: float = setting(0.5, -2, 1)
    """Normals of a match agree to this cosine; -2: whatever their directions."""
    min_matches: int = setting(100, 6, 10**6)
    """Points that need a match; else the alignment fails."""
    degenerate_below: float = setting(0.01, 0, 1)
    """Geometry is degenerate if some direction of motion is seen by less than this share of the points."""


@settings_class(frozen=True)
class PhotometricSettings:
    """The photometric part of the alignment (direct image alignment, Huber norm)."""

    mode: PhotometricMode = "auto"
    """never; degenerate: where geometry leaves a direction of motion open; always; auto: always if the depth camera is
    noisy, or as long as residuals of tracking have not shown that smooth depth is exact, too; else where geometry is
    degenerate."""
    noisy_m: float = setting(0.001, 0, 1, "m")
    """For "auto": the depth camera is noisy if its standard deviation at the median depth is above this, or that of
    points about the surface that earlier frames measured."""
    shrink: int = setting(2, 1, 16)
    """Images are this many times smaller, for 320-pixel-wide ones; wider ones are shrunk more."""
    points: int = setting(5000, 1, 10**6)
    """Textured points at most."""
    min_gradient: float = setting(0.02, 1e-4, 1)
    """A point is textured if grey, in [0, 1], changes by this per (shrunken) pixel."""
    sigma: float = setting(0.03, 1e-4, 1)
    """Standard deviation of a residual, grey levels in [0, 1]."""
    weight: float = setting(0.2, 0, 1e3)
    """Weight against the geometry when both are weighed by their noise, per point."""
    surface_sigma: float = setting(0.002, 1e-5, 1, "m")
    """The geometry's noise at 1 m is taken to be no less."""
    huber: float = setting(0.05, 1e-4, 1)
    """Grey difference from which a residual counts linearly."""
    depth_tolerance: float = setting(0.05, 0, 1)
    """A pixel of the reference is occluded if its depth differs by more than this share."""
    renew_translation: float = setting(0.1, 0, 1e3)
    """A frame becomes the reference after a motion of this many times the median depth since the last one."""
    renew_rotation_deg: float = setting(8.0, 0, 180, "deg")
    """A frame also becomes the reference after a turn by this."""


@settings_class(frozen=True)
class RecoverySettings:
    """What happens when constant velocity does not lead to the pose."""

    convincing_overlap: float = setting(0.6, 0, 1)
    """Under this overlap other starts are tried, too."""
    convincing_residual: float = setting(0.04, 0, 1)
    """Over this mean grey difference, where grey values were compared, other starts are tried, too."""
    min_overlap: float = setting(0.25, 0, 0.9)
    """Under this overlap from every start the frame is lost."""
    min_share: float = setting(0.2, 0, 1)
    """A pose short of the convincing overlap is believed only if this share of the textured points was compared."""
    near_weight: float = setting(1.5, 1, 1e9)
    """`points.near_weight` while something may move: what is near may take the pose along."""
    wary_frames: int = setting(16, 0, 1000)
    """Frames for which that holds, after images suddenly agreed less or something was found that may move."""
    wide_share: float = setting(0.15, 0, 10)
    """Over this share of the image width, by which the image shifts from frame to frame, an alignment starts where
    matched features have the camera, and is held to them."""
    views: int = setting(2, 1, 100)
    """Located frames whose features are matched, the latest first."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    """Of the frames, and when their matches make a start."""
    new_part_after: int = setting(10, 0, 10**9, "frames")
    """After so many lost frames in a row that show surfaces, each overlapping with the one before, a new part of the
    map begins; a loop joins it to the others. 0: never; nor without `loops.enabled`, with a limit of memory, with a
    rig, or where the map does not grow."""
    new_part_seconds: float = setting(0.3, 0, 1e9, "s")
    """And these frames span at least so long."""


@dataclass(frozen=True)
class TrackerSettings:
    """Everything the tracker needs to know."""

    noise: DepthNoise | None = None
    """Of the depth camera; None: measured on the first frame (`noise.estimate_noise`), and larger where later frames
    show that it is (`residual_noise`)."""
    points: PointSettings = field(default_factory=PointSettings)
    target: TargetSettings = field(default_factory=TargetSettings)
    align: AlignSettings = field(default_factory=AlignSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    recovery: RecoverySettings = field(default_factory=RecoverySettings)
