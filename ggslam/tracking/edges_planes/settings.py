# SPDX-License-Identifier: Apache-2.0
"""Every number of the edge/plane front-end, documented.

The defaults are for depth cameras indoors; `LIDAR` are those for a spinning LiDAR outdoors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ggslam.errors import ConfigError, check_ranges


@dataclass(frozen=True)
class ExtractionSettings:
    """How edges and planes are taken from scan lines (rows and columns of a depth image, rings of a LiDAR)."""

    row_step: int = 8
    """Every so many rows of a 320-pixel-wide image are scanned, for edges and planes."""
    column_step: int = 10
    """Likewise columns, for edges only: a row does not see an edge along itself. 0: none."""
    segments: int = 8
    """Parts of a line that features are chosen from separately, so that they are spread out."""
    edges_per_segment: int = 2
    planes_per_segment: int = 7
    """Most features of a segment; a feature is the most curved (edge) or flattest (plane) of its 11 neighbours."""
    roughness: float = 0.001
    """Share of the distance added to the depth noise as standard deviation: how even real surfaces are."""
    edge_sigmas: float = 6.0
    """An edge's curvature is above this many standard deviations of what noise makes of a straight line."""
    plane_sigmas: float = 6.0
    """A plane's is below this many."""
    edge_angle_deg: float = 35.0
    """At an edge the line turns by at least this angle (equation 2), degrees."""
    gap: float = 0.03
    """Neighbours whose distances differ by more than this share, and by more than noise allows, are not on one
    surface: an occlusion border."""
    occluding_edges: bool = True
    """Whether the near side of an occlusion border is an edge. The far side never is."""
    patch_step: int = 2
    """In depth images the surface about a plane feature is fitted to 5 x 5 pixels this far apart (of a 320-pixel-wide
    image)."""
    min_cosine: float = 0.15
    """Planes seen at a flatter angle (cosine between normal and ray) are left out."""
    min_depth: float = 0.1
    max_depth: float = 8.0
    """Depth range of depth images in metres."""

    def __post_init__(self) -> None:
        ranges = {
            "row_step": (1, 100), "column_step": (0, 100), "segments": (1, 1000), "edges_per_segment": (0, 100),
            "planes_per_segment": (1, 100), "roughness": (0, 1), "edge_sigmas": (0, 1e3), "plane_sigmas": (0, 1e3),
            "edge_angle_deg": (0, 180), "gap": (0, 1), "patch_step": (1, 20), "min_cosine": (0, 1),
            "min_depth": (0, 1e4), "max_depth": (0, 1e4),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class FeatureMapSettings:
    """The local map: voxels of planes and of edges in a table of fixed size."""

    plane_voxel: float = 0.08
    edge_voxel: float = 0.1
    """Edges of the voxels in metres."""
    slots: int = 1 << 17
    """Places for voxels, a power of two. Of two voxels with the same place the newer one stays."""
    match_voxels: float = 1.7
    """A point is matched to a voxel whose mean is nearer than this many voxels."""
    min_normal_dot: float = 0.5
    """The normals of a plane and its match agree to this cosine, where both are known."""
    max_weight: float = 200.0
    """A voxel's weight grows no further than this, in measurements: later ones keep some influence."""
    min_plane_points: float = 5.0
    """A voxel is a plane from this many measurements without a fitted patch; one patch is enough."""
    min_edge_points: float = 4.0
    """A voxel is an edge from this many measurements."""
    plane_ratio: float = 8.0
    """A plane's second variance is at least this many times its smallest."""
    edge_ratio: float = 6.0
    """An edge's largest variance is at least this many times its second."""

    def __post_init__(self) -> None:
        ranges = {
            "plane_voxel": (1e-3, 100), "edge_voxel": (1e-3, 100), "slots": (2, 1 << 28), "match_voxels": (0.1, 2),
            "min_normal_dot": (-1, 1), "max_weight": (1, 1e9), "min_plane_points": (1, 1e6),
            "min_edge_points": (2, 1e6), "plane_ratio": (1, 1e6), "edge_ratio": (1, 1e6),
        }  # fmt: skip
        check_ranges(self, ranges)
        if self.slots & (self.slots - 1):
            raise ConfigError(f"FeatureMapSettings.slots: expected a power of two, found {self.slots}")


@dataclass(frozen=True)
class FeatureAlignSettings:
    """How a scan's features are aligned to the local map."""

    planes: int = 2500
    edges: int = 1000
    """Features aligned at most, evenly chosen; all go into the map."""
    outer_iterations: int = 2
    """Times that features are matched anew."""
    inner_iterations: int = 2
    """Levenberg-Marquardt steps per matching at most."""
    rematch_share: float = 0.05
    """A matching that moved the features by less than this share of a plane voxel is the last one."""
    budget_ms: float = 10.0
    """Wall-clock time for a frame, from the image to the pose and the map; 0: no limit. It is looked at between steps:
    one that usually takes longer than what is left is not begun (the first matching always is). A frame that would
    be lost may take longer."""
    translation_tolerance: float = 1e-4
    rotation_tolerance: float = 5e-5
    """The iteration stops at a step below both (metres, radians)."""
    huber_sigmas: float = 1.5
    """From this many standard deviations on a residual counts linearly."""
    gate_constant: float = 0.02
    gate_sigmas: float = 4.0
    """In the last matching, residuals above constant + sigmas sigma(z) metres are outliers."""
    edge_weight: float = 1.0
    """Of an edge's residual against a plane's, when both are weighed by their noise."""
    overlap_constant: float = 0.01
    overlap_sigmas: float = 2.0
    """A match is an inlier if its point-to-plane distance is below constant + sigmas sigma(z), metres."""
    min_matches: int = 60
    """Features that need a match."""
    convincing_overlap: float = 0.6
    """Under this overlap a pose is not believed."""
    degenerate_below: float = 0.01
    """Geometry is degenerate if some direction of motion is seen by less than this share of the features."""

    def __post_init__(self) -> None:
        ranges = {
            "planes": (6, 10**7), "edges": (0, 10**7), "outer_iterations": (1, 1000), "rematch_share": (0, 1),
            "inner_iterations": (1, 1000), "budget_ms": (0, 1e6), "translation_tolerance": (0, 1),
            "rotation_tolerance": (0, 1), "huber_sigmas": (0.01, 1e3), "gate_constant": (0, 1e3),
            "gate_sigmas": (0, 1e3), "edge_weight": (0, 1e3), "overlap_constant": (0, 1e3), "overlap_sigmas": (0, 1e3),
            "min_matches": (6, 10**6), "convincing_overlap": (0, 1), "degenerate_below": (0, 1),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class FeatureUpdateSettings:
    """When a located scan goes into the local map."""

    translation: float = 0.05
    """After a motion of this many times the features' median distance since the last one."""
    rotation_deg: float = 4.0
    """Likewise, degrees."""
    overlap: float = 0.85
    """Or when less of the scan than this matches the map."""
    urgent_overlap: float = 0.7
    """When less than this matches, the budget does not count: the map must not run dry."""

    def __post_init__(self) -> None:
        ranges = {"translation": (0, 1e6), "rotation_deg": (0, 360), "overlap": (0, 1), "urgent_overlap": (0, 1)}
        check_ranges(self, ranges)


@dataclass(frozen=True)
class FeatureTrackerSettings:
    """Everything the edge/plane front-end needs to know."""

    gicp_fallback: bool = True
    """Where edges and planes do not convince, or leave a direction of motion open, G-ICP (`tracker.Tracker`) locates
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
