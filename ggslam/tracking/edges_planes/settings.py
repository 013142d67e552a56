# SPDX-License-Identifier: Apache-2.0
"""Every number of the edge/plane front-end, documented.

The defaults are for depth cameras indoors; `LIDAR` are those for a spinning LiDAR outdoors.
"""

from __future__ import annotations

from dataclasses import field

from ggslam.system.settings import Conflict, setting, settings_class


@settings_class(frozen=True)
class ExtractionSettings:
    """How edges and planes are taken from scan lines (rows and columns of a depth image, rings of a LiDAR)."""

    row_step: int = setting(8, 1, 100, "px")
    """Every so many rows of a 320-pixel-wide image are scanned, for edges and planes."""
    column_step: int = setting(10, 0, 100, "px")
    """Every so many columns are scanned, for edges only: a row does not see an edge along itself. 0: none."""
    segments: int = setting(8, 1, 1000)
    """Parts of a line that features are chosen from separately, so that they are spread out."""
    edges_per_segment: int = setting(2, 0, 100)
    """Most edges of a segment; an edge is the most curved of its 11 neighbours."""
    planes_per_segment: int = setting(7, 1, 100)
    """Most planes of a segment; a plane is the flattest of its 11 neighbours."""
    roughness: float = setting(0.001, 0, 1)
    """Share of the distance added to the depth noise as standard deviation: how even real surfaces are."""
    edge_sigmas: float = setting(6.0, 0, 1e3)
    """An edge's curvature is above this many standard deviations of what noise makes of a straight line."""
    plane_sigmas: float = setting(6.0, 0, 1e3)
    """A plane's curvature is below this many."""
    edge_angle_deg: float = setting(35.0, 0, 180, "deg")
    """At an edge the line turns by at least this angle (equation 2)."""
    gap: float = setting(0.03, 0, 1)
    """Neighbours whose distances differ by more than this share, and by more than noise allows, are not on one
    surface: an occlusion border."""
    occluding_edges: bool = True
    """Whether the near side of an occlusion border is an edge. The far side never is."""
    patch_step: int = setting(2, 1, 20, "px")
    """In depth images the surface about a plane feature is fitted to 5 x 5 pixels this far apart (of a 320-pixel-wide
    image)."""
    min_cosine: float = setting(0.15, 0, 1)
    """Planes seen at a flatter angle (cosine between normal and ray) are left out."""
    min_depth: float = setting(0.1, 0, 1e4, "m")
    """Nearer depth of depth images is not used."""
    max_depth: float = setting(8.0, 0.01, 1e4, "m")
    """Farther depth of depth images is not used."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")


@settings_class(frozen=True)
class FeatureMapSettings:
    """The local map: voxels of planes and of edges in a table of fixed size."""

    plane_voxel: float = setting(0.08, 1e-3, 100, "m")
    """Edge of the voxels of planes."""
    edge_voxel: float = setting(0.1, 1e-3, 100, "m")
    """Edge of the voxels of edges."""
    slots: int = setting(1 << 17, 2, 1 << 24)
    """Places for voxels, a power of two. Of two voxels with the same place the newer one stays."""
    match_voxels: float = setting(1.7, 0.1, 2, "voxels")
    """A point is matched to a voxel whose mean is nearer than this many voxels."""
    min_normal_dot: float = setting(0.5, -1, 1)
    """The normals of a plane and its match agree to this cosine, where both are known."""
    max_weight: float = setting(200.0, 1, 1e9)
    """A voxel's weight grows no further than this, in measurements: later ones keep some influence."""
    min_plane_points: float = setting(5.0, 1, 1e6)
    """A voxel is a plane from this many measurements without a fitted patch; one patch is enough."""
    min_edge_points: float = setting(4.0, 2, 1e6)
    """A voxel is an edge from this many measurements."""
    plane_ratio: float = setting(8.0, 1, 1e6)
    """A plane's second variance is at least this many times its smallest."""
    edge_ratio: float = setting(6.0, 1, 1e6)
    """An edge's largest variance is at least this many times its second."""

    def __post_init__(self) -> None:
        if self.slots & (self.slots - 1):
            raise Conflict("slots", f"expected a power of two, found {self.slots}")


@settings_class(frozen=True)
class FeatureAlignSettings:
    """How a scan's features are aligned to the local map."""

    planes: int = setting(2500, 6, 10**7)
    """Planes aligned at most, evenly chosen; all go into the map."""
    edges: int = setting(1000, 0, 10**7)
    """Edges aligned at most, likewise."""
    outer_iterations: int = setting(2, 1, 1000)
    """Times that features are matched anew."""
    inner_iterations: int = setting(2, 1, 1000)
    """Levenberg-Marquardt steps per matching at most."""
    rematch_share: float = setting(0.05, 0, 1)
    """A matching that moved the features by less than this share of a plane voxel is the last one."""
    budget_ms: float = setting(10.0, 0, 1e6, "ms")
    """Wall-clock time for a frame, from the image to the pose and the map; 0: no limit. It is looked at between steps:
    one that usually takes longer than what is left is not begun (the first matching always is). A frame that would
    be lost may take longer."""
    translation_tolerance: float = setting(1e-4, 0, 1, "m")
    """The iteration stops at a step below this and `rotation_tolerance`."""
    rotation_tolerance: float = setting(5e-5, 0, 1, "rad")
    """The iteration stops at a step below this and `translation_tolerance`."""
    huber_sigmas: float = setting(1.5, 0.01, 1e3)
    """From this many standard deviations on a residual counts linearly."""
    gate_constant: float = setting(0.02, 0, 1e3, "m")
    """Residuals above this are outliers in the last matching; `gate_sigmas` adds to it."""
    gate_sigmas: float = setting(4.0, 0, 1e3)
    """Standard deviations sigma(z) added to `gate_constant`."""
    edge_weight: float = setting(1.0, 0, 1e3)
    """Of an edge's residual against a plane's, when both are weighed by their noise."""
    overlap_constant: float = setting(0.01, 0, 1e3, "m")
    """A match is an inlier if its point-to-plane distance is below this; `overlap_sigmas` adds to it."""
    overlap_sigmas: float = setting(2.0, 0, 1e3)
    """Standard deviations sigma(z) added to `overlap_constant`."""
    min_matches: int = setting(60, 6, 10**6)
    """Features that need a match."""
    convincing_overlap: float = setting(0.6, 0, 1)
    """Under this overlap a pose is not believed."""
    degenerate_below: float = setting(0.01, 0, 1)
    """Geometry is degenerate if some direction of motion is seen by less than this share of the features."""


@settings_class(frozen=True)
class FeatureUpdateSettings:
    """When a located scan goes into the local map."""

    translation: float = setting(0.05, 0, 1e6)
    """After a motion of this many times the features' median distance since the last one."""
    rotation_deg: float = setting(4.0, 0, 360, "deg")
    """After a turn by this since the last one."""
    overlap: float = setting(0.85, 0, 1)
    """Or when less of the scan than this matches the map."""
    urgent_overlap: float = setting(0.7, 0, 1)
    """When less than this matches, the budget does not count: the map must not run dry."""


@settings_class(frozen=True)
class FeatureTrackerSettings:
    """Everything the edge/plane front-end needs to know."""

    gicp_fallback: bool = True
    """Where edges and planes do not convince, or leave a direction of motion open, G-ICP (`GicpTracker`) locates
    the frame if it has a target. That takes its own time, beyond the budget."""

    device: str = "cpu"
    """Torch device that features, map and alignment live on."""
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
