# SPDX-License-Identifier: Apache-2.0
"""Settings of the tracker. One default serves all recordings: lengths follow depth noise, resolution and distance of
the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal, TypeVar

import numpy as np

from ggslam.features.orb import FeatureSettings
from ggslam.system.savable import savable
from ggslam.system.settings import Conflict, setting, settings_class, tuning_class

Depths = TypeVar("Depths", float, np.ndarray)
PhotometricMode = Literal["never", "degenerate", "auto", "always"]
UNBOUNDED: Final = 1e9
"""A weight that no point has: the closest, at 0.1 m, has at most 10^4 times the weight of one at 1 m."""


@savable()
@settings_class(frozen=True)
class DepthNoise:
    """Standard deviation of a depth measurement: sigma(z) = constant + square z^2 (z, sigma in metres).

    The default is a structured-light camera's (Khoshelham and Oude Elberink, Sensors 2012, round the values up).
    """

    constant: float = setting(0.0012, 1e-6, 1, "m")
    """Standard deviation close to the camera."""
    square: float = setting(0.0019, 0, 1, "1/m")
    """Growth of the standard deviation with the square of the depth."""

    def sigma(self, z: Depths) -> Depths:
        """Standard deviation in metres at a depth `z`, or at each of an array."""
        return self.constant + self.square * z * z

    def in_pixels(self, z: float, focal_length: float) -> float:
        """As wide as `sigma(z)` is in the image at depth `z` > 0, pixels as `focal_length` is."""
        return self.sigma(z) * focal_length / z


@tuning_class(frozen=True)
class PointTuning:
    """Numbers of sampling points from a depth image."""

    window: int = setting(2, 1, 20)
    """Half width of the neighbourhood of (2 window + 1)^2 samples, spaced by about one pixel of a 320-pixel-wide
    image."""
    min_neighbours: float = setting(0.6, 0, 1)
    """A point is dropped if less than this share of its neighbourhood lies on its surface."""
    min_thickness: float = setting(0.01, 1e-4, 1)
    """Lower bound of the smallest regularised eigenvalue (GS-ICP, equation 1): the thickness of a plane."""
    max_elongation: float = setting(4.0, 1, 1e4)
    """Upper bound of the largest regularised eigenvalue."""
    near_weight: float = setting(UNBOUNDED, 1, UNBOUNDED)
    """A near point, which is less noisy, weighs at most this many times as much as one at the frame's median depth."""


@settings_class(frozen=True)
class PointSettings(PointTuning):
    """How points are sampled from a depth image."""

    count: int = setting(5000, 50, 10**6)
    """Target number of points per frame; sets the pixel stride. Tracking time grows with it."""
    min_depth: float = setting(0.1, 0, 1e4, "m")
    """Nearer depth is ignored by tracking."""
    max_depth: float = setting(8.0, 0.01, 1e4, "m", basic=True)
    """Farther depth is ignored by tracking. Scales with the first frame's median depth in scenes larger than a room."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")


@tuning_class(frozen=True)
class TargetSettings:
    """The surface that frames are aligned to."""

    voxel: float = setting(0.03, 1e-3, 10, "m")
    """Edge of a fine voxel at a median depth of 1 to 4 m; it scales with the first frame's median depth beyond that
    range. Coarse voxels are four times as wide."""
    min_opacity: float = setting(0.1, 1e-3, 0.999)
    """Less opaque Gaussians are left out."""
    min_thickness: float = setting(0.01, 1e-4, 1)
    """Lower bound of a voxel's smallest regularised eigenvalue."""
    max_thickness: float = setting(0.01, 1e-4, 1)
    """Upper bound of a voxel's smallest regularised eigenvalue, which keeps a noisy plane flat."""
    max_elongation: float = setting(4.0, 1, 1e4)
    """Upper bound of a voxel's largest regularised eigenvalue."""
    scatter_weight: float = setting(1.0, 0, 1e3)
    """Weight of the scatter of the means against the Gaussians' own covariances in a voxel's shape."""
    neighbour_weight: float = setting(0.3, 0, 1e3)
    """Weight of the 26 neighbouring voxels in a voxel's scatter."""

    def __post_init__(self) -> None:
        if self.min_thickness > self.max_thickness:
            raise Conflict(
                "max_thickness",
                f"expected min_thickness, {self.min_thickness:g}, or more, found {self.max_thickness:g}",
            )


@tuning_class(frozen=True)
class AlignSettings:
    """Alignment of points to a surface."""

    coarse_iterations: int = setting(6, 0, 1000)
    """Iterations at the coarse level; 0: fine level only."""
    coarse_points: int = setting(1500, 50, 10**6)
    """Points used at the coarse level."""
    fine_iterations: int = setting(30, 1, 1000)
    """Maximum iterations at the fine level."""
    translation_tolerance: float = setting(1e-4, 0, 1, "m")
    """Iteration stops at a step below this and `rotation_tolerance`."""
    rotation_tolerance: float = setting(5e-5, 0, 1, "rad")
    """Iteration stops at a step below this and `translation_tolerance`."""
    kernel_constant: float = setting(0.01, 1e-4, 10, "m")
    """Constant part of the width of the Geman-McClure kernel; `kernel_sigmas` adds to it."""
    kernel_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations of the depth noise added to `kernel_constant`."""
    coarse_kernel_factor: float = setting(2.0, 0.1, 100)
    """The kernel of the coarse level is this many times as wide."""
    overlap_constant: float = setting(0.01, 1e-4, 10, "m")
    """A match is an inlier below this point-to-plane distance; `overlap_sigmas` adds to it."""
    overlap_sigmas: float = setting(2.0, 0, 100)
    """Standard deviations of the depth noise added to `overlap_constant`."""
    min_normal_dot: float = setting(0.5, -2, 1)
    """Least cosine between the normals of a match; -2: any directions."""
    min_matches: int = setting(100, 6, 10**6)
    """Alignment fails with fewer matched points."""
    degenerate_below: float = setting(0.01, 0, 1)
    """Geometry is degenerate if less than this share of the points constrains some direction of motion."""


@tuning_class(frozen=True)
class PhotometricTuning:
    """Numbers of the photometric alignment."""

    noisy_m: float = setting(0.001, 0, 1, "m")
    """In mode auto, the depth camera counts as noisy above this standard deviation at the median depth."""
    shrink: int = setting(2, 1, 16)
    """Images are reduced by this factor at a width of 320 pixels; wider ones are reduced more."""
    points: int = setting(5000, 1, 10**6)
    """Maximum number of textured points."""
    min_gradient: float = setting(0.02, 1e-4, 1)
    """A point is textured if its grey value, in [0, 1], changes by this much per reduced pixel."""
    sigma: float = setting(0.03, 1e-4, 1)
    """Standard deviation of a residual, as a grey value in [0, 1]."""
    weight: float = setting(0.2, 0, 1e3)
    """Weight per point against geometry, after both are weighted by their noise."""
    surface_sigma: float = setting(0.002, 1e-5, 1, "m")
    """Lower bound of the noise of geometry at 1 m."""
    huber: float = setting(0.05, 1e-4, 1)
    """Residuals above this grey difference count linearly."""
    depth_tolerance: float = setting(0.05, 0, 1)
    """A pixel of the reference is occluded if its depth differs by more than this share."""
    renew_translation: float = setting(0.1, 0, 1e3)
    """A frame becomes the reference after a motion of this many times the median depth."""
    renew_rotation_deg: float = setting(8.0, 0, 180, "deg")
    """A frame becomes the reference after a turn by this angle."""


@settings_class(frozen=True)
class PhotometricSettings(PhotometricTuning):
    """Photometric alignment of frames (direct image alignment, Huber norm)."""

    mode: PhotometricMode = "auto"
    """When brightness is aligned besides geometry. never; always; degenerate: where geometry leaves a direction of
    motion open; auto: always while the depth camera is, or may be, noisy, else as degenerate. Gains 0.7 dB on
    redkitchen against never."""


@tuning_class(frozen=True)
class RecoveryTuning:
    """Numbers of the recovery of a pose."""

    convincing_overlap: float = setting(0.6, 0, 1)
    """Other initial poses are tried below this overlap."""
    convincing_residual: float = setting(0.04, 0, 1)
    """Other initial poses are tried above this mean grey difference, in [0, 1]."""
    min_share: float = setting(0.2, 0, 1)
    """A pose below `convincing_overlap` is accepted only if this share of the textured points was compared."""
    near_weight: float = setting(1.5, 1, 1e9)
    """Replaces `points.near_weight` while something may move, because a near mover can drag the pose along."""
    wary_frames: int = setting(16, 0, 1000)
    """Frames during which `near_weight` applies after a sign of something moving."""
    wide_share: float = setting(0.15, 0, 10)
    """If the image shifts by more than this share of its width between frames, alignment starts from matched
    features."""
    views: int = setting(2, 1, 100)
    """Latest located frames whose features are matched."""
    new_part_seconds: float = setting(0.3, 0, 1e9, "s")
    """Least time that these lost frames must span."""


@settings_class(frozen=True)
class RecoverySettings(RecoveryTuning):
    """What happens when the predicted pose does not lead to an alignment."""

    min_overlap: float = setting(0.25, 0, 0.9)
    """A frame is lost if less than this share of its points matches the map from every initial pose."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    """Of the frames, and when their matches make a start."""
    new_part_after: int = setting(10, 0, 10**9, "frames")
    """Start a new part of the map after this many lost frames in a row; a loop closure joins the parts later. 0: never.
    Needs `loops.enabled` and one camera, no memory limit and no `--localize-only`."""


@dataclass(frozen=True)
class TrackerSettings:
    """How the camera is tracked."""

    noise: DepthNoise | None = None
    """Noise of the depth camera. None: automatic: estimated on the first frame and raised if later frames show more."""
    points: PointSettings = field(default_factory=PointSettings)
    target: TargetSettings = field(default_factory=TargetSettings)
    align: AlignSettings = field(default_factory=AlignSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    recovery: RecoverySettings = field(default_factory=RecoverySettings)
