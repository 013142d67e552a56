# SPDX-License-Identifier: Apache-2.0
"""Writes a run in every form there is; docs/formats.md says what each is for.

python examples/export_everything.py demo/run demo/exports
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from ggslam.errors import MissingDependency
from ggslam.jobs.export.map_files import (
    export_objects,
    export_points,
    export_segmented,
    export_splats,
    export_trajectory,
)
from ggslam.jobs.export.meshes import MeshRequest, export_mesh
from ggslam.jobs.export.splats import export_packed, export_pcd
from ggslam.jobs.export.views import export_colmap, export_nerfstudio
from ggslam.runs.folder import RunFolder


def main(run: str, out: str) -> None:
    """`out`: a new folder."""
    folder, to = RunFolder.open(run), Path(out)
    jobs: list[Callable[[], str]] = [
        lambda: export_splats(folder, to / "map.ply"),
        lambda: export_packed(folder, to / "map.splat", "splat"),
        lambda: export_packed(folder, to / "map.compressed.ply", "compressed-ply"),  # extra [splats]
        lambda: export_packed(folder, to / "map.spz", "spz"),  # extra [splats]
        lambda: export_points(folder, to / "points", 0.02),
        lambda: export_pcd(folder, to / "map.pcd", 0.02),
        lambda: export_trajectory(folder, to / "trajectory.txt"),
        lambda: export_mesh(folder, to / "mesh.ply", MeshRequest(voxel=0.04)),
        lambda: export_mesh(folder, to / "mesh.glb", MeshRequest(voxel=0.04)),  # extra [mesh]
        lambda: export_colmap(folder, to / "colmap", 0.03),
        lambda: export_nerfstudio(folder, to / "nerfstudio", 0.03),
    ]
    if folder.has_objects():
        jobs += [
            lambda: export_segmented(folder, to / "segmented.ply"),
            lambda: export_objects(folder, to / "objects", "all"),
            lambda: export_mesh(folder, to / "object_meshes", MeshRequest(voxel=0.04, objects="all")),
        ]
    for job in jobs:
        try:
            print(job())
        except MissingDependency as missing:
            print(f"left out: {missing}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
