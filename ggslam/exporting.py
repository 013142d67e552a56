# SPDX-License-Identifier: Apache-2.0
"""A run's map in other forms."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.atomic import make_folder
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.point_ply import write_points
from ggslam.formats.point_sampling import sample_points
from ggslam.formats.trajectory import write_tum
from ggslam.run_folder import RunFolder


def export_splats(folder: RunFolder, path: Path, min_opacity: float = 0.0) -> str:
    """Writes the Gaussians that are at least this opaque as a 3DGS PLY; returns a line that says so."""
    gaussians = folder.gaussians()
    if min_opacity > 0:
        gaussians.keep(gaussians.opacities >= min_opacity)
    if not len(gaussians):
        raise RunFolderError(f"{folder.path}: no Gaussian is at least {min_opacity} opaque; nothing to export")
    make_folder(path.parent)
    write_gaussian_ply(path, gaussians)
    return f"wrote {path}: {len(gaussians)} Gaussians"


def export_points(folder: RunFolder, path: Path, voxel_size: float, min_opacity: float = 0.0) -> str:
    """Writes points.ply (metres) and points_grid.ply (integer cells) into the folder `path`."""
    try:
        cloud = sample_points(folder.gaussians(), voxel_size, min_opacity if min_opacity > 0 else 0.3)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not len(cloud):
        raise RunFolderError(f"{folder.path}: the map has no points to export")
    make_folder(path)
    write_points(path, cloud)
    return f"wrote {path}/points.ply and points_grid.ply: {len(cloud)} points on a {voxel_size} m grid"


def export_trajectory(folder: RunFolder, path: Path) -> str:
    """Writes the camera poses as a TUM trajectory."""
    trajectory = folder.trajectory()
    make_folder(path.parent)
    written = write_tum(path, trajectory.timestamps, trajectory.T_world_camera)
    return f"wrote {path}: {written} poses"
