# SPDX-License-Identifier: Apache-2.0
"""Scores of a run's points: how far they lie from the surface that its recording measured."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggslam.errors import FormatError, GgslamError
from ggslam.evaluation.surface import SurfaceScores, score_surface
from ggslam.formats.point_ply import METRIC_FILE, read_points
from ggslam.formats.point_sampling import PointSamplingTuning
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.runs.folder import RunFolder
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.surface_points import SurfacePointTuning, surface_settings
from ggslam.volumes.tsdf import TsdfMap


class RunSurfaceTuning(Tuning):
    """How much of a recording is scored."""

    max_blocks = 150_000
    """Blocks of fused depth after which no more is fused: 770 MB."""


class SurfaceScorer:
    """Fuses the depth of frames at a run's poses, and scores the run's points against it.

    Points that no frame measured the depth of, whether in front of them or behind, are left out: what a map shows where
    the sensor told nothing is neither right nor wrong by it.

    Args:
        folder: of the run.
        cloud: score this one instead of the run's.
    """

    def __init__(self, folder: RunFolder, cloud: VoxelCloud | None = None) -> None:
        self.reason = ""
        """Why there are no scores, or why they are of a part."""
        self._tsdf: TsdfMap | None = None
        cloud = self._cloud_of(folder) if cloud is None else cloud
        if cloud is None or not len(cloud):
            return
        self._points, self._voxel = cloud.points, cloud.voxel_size
        self._measured = np.zeros(len(self._points), bool)
        self._times = max(1.0, self._voxel / PointSamplingTuning.voxel_m)
        self._tsdf = TsdfMap(surface_settings(self._voxel, self._times), points=False)

    def _cloud_of(self, folder: RunFolder) -> VoxelCloud | None:
        """The points of a run; None, and a reason, where they are not scored."""
        path = folder.path / METRIC_FILE
        if not path.is_file():
            self.reason = f"there is no {METRIC_FILE}; its points are not scored"
            return None
        if folder.map_in_parts().in_cells:
            self.reason = f"memory was limited; {METRIC_FILE} is not scored"
            return None
        try:
            return read_points(path)
        except FormatError as error:
            self.reason = f"its points are not scored: {error}"
            return None

    def add(self, frame: Frame, T_world_camera: np.ndarray) -> None:
        """Counts a frame in."""
        if self._tsdf is None:
            return
        if self._tsdf.dense_blocks > RunSurfaceTuning.max_blocks:
            self.reason = f"{METRIC_FILE} is scored against the depth of the frames up to {frame.index}"
            return
        depth = frame.depth if frame.moving is None else np.where(frame.moving, np.float32(0), frame.depth)
        try:
            self._tsdf.integrate(depth, frame.camera, T_world_camera)
        except GgslamError as error:  # points of an older run may have smaller voxels than go with its depth
            self.reason, self._tsdf = f"its points are not scored: {error}", None
            return
        rest = np.flatnonzero(~self._measured)
        row, column, inside = frame.camera.project(transform_points(self._points[rest], inverse(T_world_camera)))
        self._measured[rest] = inside & (depth[row, column] > 0)

    def scores(self) -> dict[str, Any] | None:
        """For metrics.json; None if nothing was measured."""
        found = self.surface_scores()
        return None if found is None else _row(found, float(self._measured.mean()))

    def surface_scores(self) -> SurfaceScores | None:
        """Of the points whose depth was measured; None if that are none."""
        if self._tsdf is None or not self._measured.any():
            return None
        mesh = extract_mesh(self._tsdf, SurfacePointTuning.min_weight / self._times**2)
        if not len(mesh.vertices):
            return None
        return score_surface(self._points[self._measured], mesh.vertices, mesh.normals, self._voxel)


def _row(found: SurfaceScores, measured: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "points": found.points, "measured": measured, "median_m": found.median_m, "p95_m": found.p95_m,
    }  # fmt: skip
    for score in found.thresholds:
        at = f"{100 * score.threshold_m:.0f}cm"
        row |= {f"precision_{at}": score.precision, f"recall_{at}": score.recall, f"f1_{at}": score.f1}
    return row
