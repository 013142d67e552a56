# SPDX-License-Identifier: Apache-2.0
"""Volumes of a run or a recording, in one call."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ggslam.jobs.progress import Observer
from ggslam.jobs.volumes.fuse import VolumesOutcome, VolumesRequest, make_volumes
from ggslam.runs.recordings import SequenceRequest


def fuse_volumes(
    source: str | Path,
    out: str | Path | None = None,
    *,
    voxel: float | None = None,
    esdf: bool = False,
    occupancy: float | None = None,
    mesh: str | Path | None = None,
    object_meshes: bool = False,
    objects: bool = True,
    frame: str = "map",
    band: tuple[float, float] = (0.1, 1.5),
    slice_height: float | None = None,
    robots: Iterable[str] = (),
    inflation: str = "0.55,10",
    config: str | None = None,
    overrides: Iterable[str] = (),
    observer: Observer | None = None,
    **selection: Any,
) -> VolumesOutcome:
    """Fuses the depth of a run or a recording into a TSDF and what is made of it, as `ggslam volumes` does.

    Args:
        source: folder of a run, or a recording with poses.
        out: folder of the results; None: `volumes` in the run, or volumes/ and the recording's name.
        voxel: of the TSDF, metres; None: goes with the size of the scene.
        esdf: whether a distance field is made, with slices and a ROS map.
        occupancy: voxel of an occupancy map in metres; None: none.
        mesh: file of the mesh; None: mesh.ply in `out`.
        object_meshes: whether each object gets a mesh of its own.
        objects: whether object ids are voted for.
        frame: of meshes and occupancy: "map", or "floor" (z up, 0 on the floor).
        band: lowest and highest obstacle of the ROS map, metres above the floor.
        slice_height: metres above the floor of the slice through the distance field; None: as high as the camera was.
        robots: such as "0.4,0.18" or "tall:1.2,0.3", height and radius in metres: each gets a map of what it meets
            and a costmap; needs `esdf`.
        inflation: `inflation_radius` and `cost_scaling_factor` of the costmaps, as nav2 has them.
        config: a preset's name, or a YAML file; None: the defaults.
        overrides: settings as "name.of.setting=value".
        observer: receives progress updates.
        selection: start, stop, stride and the other arguments of `open_sequence`, of a recording.

    Returns:
        Files and times. If fusing stopped early, what was fused is written all the same.

    Raises:
        GgslamError: nothing could be done, or fusing stopped early.
    """
    request = VolumesRequest(
        Path(source), SequenceRequest.of(source, selection, "fuse_volumes"), out=None if out is None else Path(out),
        voxel=voxel, esdf=esdf, occupancy=occupancy, mesh=None if mesh is None else Path(mesh),
        object_meshes=object_meshes, objects=objects, slice_height=slice_height, band=band, frame=frame,
        robots=tuple(robots), inflation=inflation,
        config=config, overrides=list(overrides),
    )  # fmt: skip
    outcome = make_volumes(request, observer)
    if outcome.error is not None:
        raise outcome.error
    return outcome
