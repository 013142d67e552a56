# SPDX-License-Identifier: Apache-2.0
"""Writes a run in every form there is; docs/formats.md says what each is for.

python examples/export_everything.py demo/run demo/exports
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import ggslam

FORMS: list[tuple[str, str, dict[str, Any]]] = [
    ("map.ply", "ply", {}),
    ("map.splat", "splat", {}),
    ("map.compressed.ply", "compressed-ply", {}),
    ("map.glb", "gltf", {}),
    ("map.spz", "spz", {}),  # extra [splats]
    ("map.sog", "sog", {}),
    ("map_web", "streamed-sog", {}),
    ("map.usdz", "usd", {}),  # extra [usd]
    ("points", "points", {"voxel": 0.02}),
    ("map.pcd", "pcd", {"voxel": 0.02}),
    ("trajectory.txt", "trajectory", {}),
    ("mesh.ply", "mesh", {"voxel": 0.04}),
    ("mesh.glb", "mesh", {"voxel": 0.04}),  # extra [mesh]
    ("colmap", "colmap", {"voxel": 0.03}),
    ("nerfstudio", "nerfstudio", {"voxel": 0.03}),
]
WITH_OBJECTS: list[tuple[str, str, dict[str, Any]]] = [
    ("segmented.ply", "segmented", {}),
    ("objects", "ply", {"objects": "all"}),
    ("object_meshes", "mesh", {"objects": "all", "voxel": 0.04}),
]


def main(run: str, out: str) -> None:
    """`out`: a new folder."""
    folder = ggslam.RunFolder.open(Path(run))
    for name, form, options in [*FORMS, *(WITH_OBJECTS if folder.has_objects() else [])]:
        try:
            print(ggslam.export_run(folder, Path(out) / name, form, **options))
        except ggslam.MissingDependency as missing:
            print(f"left out: {missing}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
