# SPDX-License-Identifier: Apache-2.0
"""Settings of the tracker of edges and planes.

The defaults are for depth cameras indoors; `LIDAR` are those for a spinning LiDAR outdoors.
"""

from __future__ import annotations

from dataclasses import field

from ggslam.system.settings import Conflict, setting, settings_class, tuning_class


@tuning_class(frozen=True)
class ExtractionTuning:
    """Numbers of extracting edges and planes."""

    row_step: int = setting(8, 1, 100, "px")
    """Distance of scanned rows in a 320-pixel-wide image."""
    column_step: int = setting(10, 0, 100, "px")
    """Distance of scanned columns, which yield edges only; 0: none."""
    segments: int = setting(8, 1, 1000)
    """Equal parts of a line from which features are picked separately, so that they spread."""
    edges_per_segment: int = setting(2, 0, 100)
    """Maximum number of edges of a segment; an edge is the most curved of its 11 neighbours."""
    planes_per_segment: int = setting(7, 1, 100)
    """Maximum number of planes of a segment; a plane is the flattest of its 11 neighbours."""
    roughness: float = setting(0.001, 0, 1)
    """Share of the distance added to the standard deviation of depth for the unevenness of surfaces."""
    edge_sigmas: float = setting(6.0, 0, 1e3)
    """Least curvature of an edge in standard deviations of a noisy straight line."""
    plane_sigmas: float = setting(6.0, 0, 1e3)
    """Largest curvature of a plane in the same standard deviations."""
    edge_angle_deg: float = setting(35.0, 0, 180, "deg")
    """Least angle by which the line turns at an edge (equation 2)."""
    gap: float = setting(0.03, 0, 1)
    """Neighbours lie on different surfaces if their distances differ by more than this share and the noise."""
    occluding_edges: bool = True
    """Use the near side of an occlusion border as an edge."""
    patch_step: int = setting(2, 1, 20, "px")
    """Spacing of the 5 x 5 pixels, of a 320-pixel-wide image, that a plane's surface is fitted to."""
    min_cosine: float = setting(0.15, 0, 1)
    """Planes seen at a smaller cosine between normal and ray are dropped."""
    min_depth: float = setting(0.1, 0, 1e4, "m")
    """Nearer depth is ignored."""
    segment_angle_deg: float = setting(0.0, 0, 89, "deg")
    """Neighbours belong to one segment if the line through them makes a larger angle with the farther one's ray (10 is
    usual), and small segments have no features; 0: no segments are looked for."""
    segment_sigmas: float = setting(4.0, 0, 1e3)
    """Standard deviations of the depth noise by which neighbours of one segment may be farther apart than that."""
    segment_pixels: int = setting(30, 1, 10**6, "px")
    """Smallest segment that has features, in pixels of a 320-pixel-wide image."""


@settings_class(frozen=True)
class ExtractionSettings(ExtractionTuning):
    """How edges and planes are extracted from scan lines (image rows and columns, LiDAR rings)."""

    max_depth: float = setting(8.0, 0.01, 1e4, "m")
    """Farther depth is ignored by this tracker."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")


@tuning_class(frozen=True)
class FeatureMapSettings:
    """The local map, a hash table of plane and edge voxels."""

    plane_voxel: float = setting(0.08, 1e-3, 100, "m")
    """Edge of a plane voxel."""
    edge_voxel: float = setting(0.1, 1e-3, 100, "m")
    """Edge of an edge voxel."""
    slots: int = setting(1 << 17, 2, 1 << 24)
    """Slots for voxels, a power of two; the newer of two voxels in a slot stays."""
    match_voxels: float = setting(1.7, 0.1, 2, "voxels")
    """Largest distance of a point to the mean of its voxel."""
    min_normal_dot: float = setting(0.5, -1, 1)
    """Least cosine between the normals of a plane and its match."""
    max_weight: float = setting(200.0, 1, 1e9)
    """Largest weight of a voxel, in measurements."""
    min_plane_points: float = setting(5.0, 1, 1e6)
    """Measurements that make a voxel a plane if it has no fitted patch."""
    min_edge_points: float = setting(4.0, 2, 1e6)
    """Measurements that make a voxel an edge."""
    plane_ratio: float = setting(8.0, 1, 1e6)
    """Least ratio of a plane's second variance to its smallest."""
    edge_ratio: float = setting(6.0, 1, 1e6)
    """Least ratio of an edge's largest variance to its second."""

    def __post_init__(self) -> None:
        if self.slots & (self.slots - 1):
            raise Conflict("slots", f"expected a power of two, found {self.slots}")


@tuning_class(frozen=True)
class FeatureAlignTuning:
    """Numbers of the alignment of features."""

    planes: int = setting(2500, 6, 10**7)
    """Maximum number of planes aligned."""
    edges: int = setting(1000, 0, 10**7)
    """Maximum number of edges aligned."""
    outer_iterations: int = setting(2, 1, 1000)
    """Maximum number of times that features are matched."""
    inner_iterations: int = setting(2, 1, 1000)
    """Maximum Levenberg-Marquardt steps per matching."""
    rematch_share: float = setting(0.05, 0, 1)
    """Matching ends when features move by less than this share of a plane voxel."""
    translation_tolerance: float = setting(1e-4, 0, 1, "m")
    """Iteration stops at a step below this and `rotation_tolerance`."""
    rotation_tolerance: float = setting(5e-5, 0, 1, "rad")
    """Iteration stops at a step below this and `translation_tolerance`."""
    huber_sigmas: float = setting(1.5, 0.01, 1e3)
    """Residuals above this many standard deviations count linearly."""
    gate_constant: float = setting(0.02, 0, 1e3, "m")
    """Larger residuals are outliers in the last matching; `gate_sigmas` adds to it."""
    gate_sigmas: float = setting(4.0, 0, 1e3)
    """Standard deviations of the depth noise added to `gate_constant`."""
    edge_weight: float = setting(1.0, 0, 1e3)
    """Weight of an edge's residual against a plane's, after both are weighted by their noise."""
    overlap_constant: float = setting(0.01, 0, 1e3, "m")
    """A match is an inlier below this point-to-plane distance; `overlap_sigmas` adds to it."""
    overlap_sigmas: float = setting(2.0, 0, 1e3)
    """Standard deviations of the depth noise added to `overlap_constant`."""
    min_matches: int = setting(60, 6, 10**6)
    """Alignment fails with fewer matched features."""
    convincing_overlap: float = setting(0.6, 0, 1)
    """A pose with less overlap is rejected."""
    degenerate_below: float = setting(0.01, 0, 1)
    """Geometry is degenerate if less than this share of the features constrains some direction of motion."""


@settings_class(frozen=True)
class FeatureAlignSettings(FeatureAlignTuning):
    """How the features of a scan are aligned to the local map."""

    budget_ms: float = setting(10.0, 0, 1e6, "ms")
    """Time for one frame, from image to pose and local map; 0: no limit. A step that would exceed it is skipped; only a
    frame that would be lost may take longer. A GPU has no limit."""


@tuning_class(frozen=True)
class FeatureUpdateSettings:
    """When a located scan is added to the local map."""

    translation: float = setting(0.05, 0, 1e6)
    """Add a scan after a motion of this many times the features' median distance."""
    rotation_deg: float = setting(4.0, 0, 360, "deg")
    """Add a scan after a turn by this angle."""
    overlap: float = setting(0.85, 0, 1)
    """Add a scan if less than this share of it matches the map."""
    urgent_overlap: float = setting(0.7, 0, 1)
    """Below this overlap a scan is added even beyond the time budget."""


@tuning_class(frozen=True)
class FeatureTrackerTuning:
    """Numbers of the tracker of edges and planes."""

    device: str = "cpu"
    """Torch device of features, local map and alignment where the run is on the CPU; on a GPU kernels do this."""


@settings_class(frozen=True)
class FeatureTrackerSettings(FeatureTrackerTuning):
    """The tracker of edges and planes (`tracker` = edges_planes)."""

    gicp_fallback: bool = True
    """Locate a frame by G-ICP where edges and planes fail or leave a direction of motion open. Takes time beyond
    `features.align.budget_ms`."""
    extraction: ExtractionSettings = field(default_factory=ExtractionSettings)
    map: FeatureMapSettings = field(default_factory=FeatureMapSettings)
    align: FeatureAlignSettings = field(default_factory=FeatureAlignSettings)
    update: FeatureUpdateSettings = field(default_factory=FeatureUpdateSettings)


LIDAR = FeatureTrackerSettings(
    extraction=ExtractionSettings(
        segments=6, edges_per_segment=8, planes_per_segment=40, roughness=0.002, edge_sigmas=8.0, plane_sigmas=2.0,
        gap=0.05,
    ),
    map=FeatureMapSettings(plane_voxel=2.0, edge_voxel=2.0, match_voxels=1.5, min_plane_points=6.0),
    align=FeatureAlignSettings(
        planes=1500, edges=500, gate_constant=0.2, overlap_constant=0.1, translation_tolerance=1e-3,
        rotation_tolerance=1e-4, rematch_share=0.005, inner_iterations=3, convincing_overlap=0.35,
    ),
    update=FeatureUpdateSettings(translation=0.02, overlap=0.5, urgent_overlap=0.45),
)  # fmt: skip
"""Settings for a spinning LiDAR outdoors: 16 to 64 rings, 100 m."""
