# SPDX-License-Identifier: Apache-2.0
"""Draws a cloud of points as a keyframe of a run sees it: the nearest point of each pixel, on white.

python scripts/tools/draw_points.py RUN points.ply picture.png --frame 30
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ggslam import RunFolder, read_point_cloud
from ggslam.reporting.pictures import write_picture
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points


def draw_points(points: np.ndarray, colors: np.ndarray, camera: Camera, T_camera_world: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] of points [n, 3] in metres with colours uint8 [n, 3]."""
    seen = transform_points(points, T_camera_world)
    row, column, inside = camera.project(seen, nearest=0.05)
    order = np.flatnonzero(inside)[np.argsort(-seen[inside, 2], kind="stable")]  # far ones first
    picture = np.full((camera.height, camera.width, 3), 255, np.uint8)
    picture[row[order], column[order]] = colors[order]
    return picture


def main() -> None:
    """Draws a file of points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("points", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frame", type=int, default=0)
    args = parser.parse_args()
    folder, cloud = RunFolder.open(args.run), read_point_cloud(args.points)
    pose, camera = folder.keyframes().poses()[args.frame], folder.sequence().camera_of(args.frame)
    write_picture(args.out, draw_points(cloud.points, cloud.colors, camera, inverse(pose)))
    print(f"wrote {args.out}: {len(cloud.points)} points")


if __name__ == "__main__":
    main()
