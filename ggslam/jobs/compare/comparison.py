# SPDX-License-Identifier: Apache-2.0
"""Two runs side by side, or a run against a cloud or mesh: what `ggslam compare` prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.evaluation.geometry import CloudScores, GeometryScoreTuning, score_cloud
from ggslam.evaluation.trajectory import TrajectoryScores, score_trajectory
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.formats.splat_formats import splat_format
from ggslam.formats.trajectory import read_tum
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.geometry.clouds import Cloud, Overlap, overlap
from ggslam.geometry.coarse_to_fine import TargetSurface, register_coarse_to_fine
from ggslam.geometry.icp import CloudRegistration
from ggslam.geometry.surface_distances import SurfaceDistances, summary_of, surface_distances
from ggslam.jobs.compare.alignment import (
    Alignment,
    Side,
    best_of_truth_and_none,
    by_trajectory,
    by_truth,
    check_registration,
    common_poses,
)
from ggslam.runs.folder import MARKER, RunFolder
from ggslam.runs.map_container import is_container
from ggslam.runs.map_file import open_map
from ggslam.runs.opened_points import opened_points
from ggslam.runs.writing import TRUTH_FILE
from ggslam.scene.poses import inverse
from ggslam.system.json_files import json_ready
from ggslam.system.tuning import Tuning


class MeshSamplingTuning(Tuning):
    """How a mesh is sampled."""

    spacing_m = 0.01
    """One point is sampled for each square of this side, in metres."""
    max_points = 2_000_000
    """Most points that are sampled."""


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        a, b: the two sides.
        align: how A was brought into the frame of B.
        T_b_a: float64 [4, 4], what that moved A by.
        trajectory: the poses of A against those of B at the same times; None unless both are runs with common times.
        common_poses: their number.
        a_on_b, b_on_a: overlap of the clouds as aligned.
        icp: registration of the aligned A upon B; None if too little of it lies near B to begin with.
        b_on_a_after_icp: the overlap the other way after that.
        scores: of A with B as the reference, as aligned.
        surface: distances of all of A to the surface of B, as aligned, and of B to that of A.
        surface_after_icp: the same after ICP.
        pair_distance_m: how far partners must be apart to reach across the gaps between the points of B.
    """

    a: Side
    b: Side
    align: Alignment
    T_b_a: np.ndarray
    trajectory: TrajectoryScores | None
    common_poses: int
    a_on_b: Overlap
    b_on_a: Overlap
    icp: CloudRegistration | None
    b_on_a_after_icp: Overlap | None
    scores: CloudScores
    surface: tuple[SurfaceDistances, SurfaceDistances]
    surface_after_icp: tuple[SurfaceDistances, SurfaceDistances] | None
    pair_distance_m: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        sides = {
            name: {
                "path": str(side.path), "points": len(side.points),
                "metrics": None if side.metrics is None else side.metrics.values(),
                "verdict": None if side.verdict is None else side.verdict.values(),
            }
            for name, side in (("a", self.a), ("b", self.b))
        }  # fmt: skip
        icp = None
        if self.icp is not None and self.b_on_a_after_icp is not None:
            icp = {**asdict(self.icp), "a_on_b": asdict(self.icp.overlap), "b_on_a": asdict(self.b_on_a_after_icp)}
            icp["surface"] = _both_ways(self.surface_after_icp)
            del icp["overlap"]
        return json_ready({
            **sides, "align": self.align, "T_b_a": self.T_b_a,
            "trajectory": None if self.trajectory is None else self.trajectory.to_dict(),
            "common_poses": self.common_poses,
            "overlap": {"a_on_b": asdict(self.a_on_b), "b_on_a": asdict(self.b_on_a)}, "icp": icp,
            "surface": _both_ways(self.surface), "pair_distance_m": self.pair_distance_m,
            "geometry": asdict(self.scores),
        })  # fmt: skip


def compare_maps(
    a: str | Path, b: str | Path, align: Alignment = "auto", max_distance: float = 0.05,
    thresholds: Sequence[float] = GeometryScoreTuning.thresholds_m, seed: int = 0,
) -> Comparison:  # fmt: skip
    """Compares A with B, B being the reference. Each is the folder of a run, or a PLY or PCD file with a cloud or mesh.

    Args:
        a, b: what to compare.
        align: "none": both are in one frame already, as runs of one recording are (the first camera's); "truth": by
            the true poses that a run kept, files lying in their world; "icp": A is registered upon B; "trajectory": the
            positions at common times are aligned (Umeyama, without scale); "auto": "truth" where that
            clearly brings them nearer than "none".
        max_distance: metres up to which points are partners, for fitness and inlier RMSE; ICP ends at closer pairs
            where the clouds are dense (`geometry.coarse_to_fine`).
        thresholds: metres, for precision, recall and F1.
        seed: of the samples of meshes and of ICP.

    Raises:
        ConfigError: a distance that is none, an alignment that the two do not allow, or one that is nonsense.
        RunFolderError, FormatError: a side cannot be read or has no points.
    """
    if not all(0 < d < np.inf for d in (max_distance, *thresholds)):
        raise ConfigError(f"expected positive distances in metres, found {max_distance} and {list(thresholds)}")
    one, other = read_side(Path(a), seed), read_side(Path(b), seed)
    pairs, cloud_a, cloud_b = common_poses(one, other), Cloud(one.points), Cloud(other.points)
    T_b_a = np.eye(4)
    if align == "trajectory":
        T_b_a = by_trajectory(one, other, pairs)
    elif align == "truth":
        T_b_a = by_truth(one, other)
    elif align == "auto":
        align, T_b_a = best_of_truth_and_none(one, other, cloud_b, max_distance, seed)
    icp = None
    try:
        icp = register_coarse_to_fine(cloud_a, cloud_b, max_distance, T_b_a, seed)
    except ValueError as error:
        if align == "icp":
            raise ConfigError(f"{a} cannot be registered upon {b} by ICP: {error}") from None
    after, ways = None, (TargetSurface.of(cloud_b, max_distance), TargetSurface.of(cloud_a, max_distance))

    def surfaces(T: np.ndarray) -> tuple[SurfaceDistances, SurfaceDistances]:
        found = []
        for cloud, surface, T_target_source in zip((cloud_a, cloud_b), ways, (T, inverse(T)), strict=True):
            reach = max(surface.pair_distance, max_distance)
            found.append(summary_of(surface_distances(
                cloud, surface.cloud, max_distance, reach, T_target_source, seed, surface.normals
            )))  # fmt: skip
        return found[0], found[1]

    if icp is not None:
        after = overlap(cloud_b, cloud_a, max_distance, inverse(icp.T_target_source), seed)
        if align == "icp":
            check_registration(one, other, icp, after.fitness)
            T_b_a = icp.T_target_source
    return Comparison(
        a=one, b=other, align=align, T_b_a=T_b_a, trajectory=_trajectory_scores(one, other, pairs),
        common_poses=len(pairs), a_on_b=overlap(cloud_a, cloud_b, max_distance, T_b_a, seed),
        b_on_a=overlap(cloud_b, cloud_a, max_distance, inverse(T_b_a), seed), icp=icp, b_on_a_after_icp=after,
        scores=score_cloud(cloud_a, cloud_b, thresholds, T_b_a, seed=seed), surface=surfaces(T_b_a),
        surface_after_icp=None if icp is None else surfaces(icp.T_target_source), pair_distance_m=ways[0].pair_distance,
    )  # fmt: skip


def _both_ways(surface: tuple[SurfaceDistances, SurfaceDistances] | None) -> dict[str, Any] | None:
    return None if surface is None else {"a_to_b": asdict(surface[0]), "b_to_a": asdict(surface[1])}


def read_side(path: Path, seed: int = 0) -> Side:
    """Reads a run's folder, a PLY or PCD file, or points of a file of Gaussians, as a run's points are sampled.

    Raises:
        RunFolderError: a folder that is no run, or whose map has no points.
        FormatError: a file that cannot be read or has no points.
    """
    if (path / MARKER).is_file():
        return _read_run(path)
    if splat_format(path) is not None or is_container(path):
        cloud = join_clouds(opened_points(open_map(path)))
        if not len(cloud):
            raise FormatError(f"{path}: its Gaussians are too faint for points to compare")
        return Side(path, cloud.points)
    if path.is_dir():
        return _read_run(path)
    try:
        mesh = read_mesh(path) if path.suffix.lower() == ".ply" else None
        if mesh is None:
            return Side(path, read_point_cloud(path).points)
        count = int(np.clip(mesh.area() / MeshSamplingTuning.spacing_m**2, 1000, MeshSamplingTuning.max_points))
        return Side(path, mesh.sample(count, seed)[0])
    except ValueError as error:
        raise FormatError(f"{path}: {error}") from None


def _read_run(path: Path) -> Side:
    folder = RunFolder.open(path)
    cloud = path / "points.ply"
    points = read_point_cloud(cloud).points if cloud.is_file() else join_clouds(opened_points(folder)).points
    if not len(points):
        raise RunFolderError(f"{path}: the map has no points to compare")
    truth = read_tum(path / TRUTH_FILE) if (path / TRUTH_FILE).is_file() else None
    return Side(path, np.asarray(points, np.float64), folder.trajectory(), folder.metrics(), truth,
                folder.verdict())  # fmt: skip


def _trajectory_scores(a: Side, b: Side, pairs: np.ndarray) -> TrajectoryScores | None:
    if a.trajectory is None or b.trajectory is None:
        return None
    return score_trajectory(a.trajectory.T_world_camera[pairs[:, 0]], b.trajectory.T_world_camera[pairs[:, 1]])
