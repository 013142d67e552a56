# SPDX-License-Identifier: Apache-2.0
"""A table with a cylinder on it before a wall, as a map, and what the same place looks like without the cylinder."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ggslam.mapping.cpu.insertion import find_unexplained, new_gaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.objects.hole_views import CameraView
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier
from ggslam.scene.poses import inverse
from ggslam.synthetic.palette import Palette
from ggslam.synthetic.raycast import RayCaster, RayImages
from ggslam.synthetic.scene import Scene, SceneBuilder

TABLE, WALL, CYLINDER = 1, 2, 3
CAMERA = Camera(128, 96, 110.0, 110.0, 63.5, 47.5)


@dataclass
class TableScene:
    """The map, its views, and the images with and without the cylinder, in the order of the views."""

    scene: SegmentedMap
    views: list[CameraView]
    images: list[RayImages]
    truth: list[RayImages]


def _scene() -> Scene:
    palette, builder = Palette(0), SceneBuilder()
    builder.instance("table").box((0, 0, -0.05), (2.4, 2.0, 0.1), palette.walnut)
    builder.instance("wall").box((0, 0.75, 0.5), (2.4, 0.1, 1.0), palette.wallpaper)
    builder.instance("cylinder").cylinder((0.05, 0.1, 0.1), 0.11, 0.2, palette.mustard)
    ring = [(0.3 * np.cos(a), -0.5 + 0.3 * np.sin(a), 2.0) for a in np.arange(4)]
    builder.light(np.array(ring), (2.5, 2.4, 2.2))
    return builder.scene


def _pose(x: float) -> np.ndarray:
    """A camera at (x, -1.1, 0.75) that looks at the cylinder."""
    position, target = np.array([x, -1.1, 0.75]), np.array([0.05, 0.15, 0.05])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = position
    return T


def build_table_scene() -> TableScene:
    poses = [_pose(x) for x in (-0.6, -0.3, 0.0, 0.3, 0.6)]
    scene = _scene()
    caster = RayCaster(scene)
    images = [caster.render(CAMERA, pose) for pose in poses]
    # Moved out of sight rather than left out: textures are laid by the number of the shape.
    away = np.eye(4)
    away[2, 3] = -50
    scene.shapes = [
        replace(shape, T_world_shape=away @ shape.T_world_shape) if shape.instance == CYLINDER else shape
        for shape in scene.shapes
    ]
    caster = RayCaster(scene)
    truth = [caster.render(CAMERA, pose) for pose in poses]
    directions = np.eye(3, IDENTITY_CHANNELS, dtype=np.float32)
    ids = np.array([TABLE, WALL, CYLINDER], np.uint16)
    classifier = IdentityClassifier(ids, 6 * directions, np.zeros(3, np.float32))
    gaussians, rasterizer = GaussianMap(feature_channels=IDENTITY_CHANNELS, with_moments=False), CpuRasterizer()
    for view, pose in zip(images, poses, strict=True):
        settings = InsertionSettings(scale_pixels=0.6, flatness=0.3)
        where = np.ones(view.depth.shape, bool)
        if len(gaussians):
            out = rasterizer.forward(gaussians, CAMERA, inverse(pose), features=False)
            where = find_unexplained(view.depth, out.alpha.numpy(), out.expected_depth.numpy(), settings)
        new = new_gaussians(view.color, view.depth, CAMERA, pose, where, settings)
        labels = view.mask.reshape(-1)[new.pixels].astype(np.int64)
        gaussians.insert(
            torch.from_numpy(new.means), torch.from_numpy(new.quaternions), torch.from_numpy(new.log_scales),
            torch.full((len(labels),), 3.0), torch.from_numpy(new.rgb), torch.from_numpy(directions[labels - 1]),
            object_id=torch.from_numpy(labels.astype(np.int32)),
        )  # fmt: skip
    names = {TABLE: "table", WALL: "wall", CYLINDER: "cylinder"}
    voted = np.zeros((len(gaussians), 4), np.uint16)
    voted[:, 0] = gaussians.object_id.numpy()
    votes = ObjectVotes(voted, (voted > 0).astype(np.float32))
    table = ObjectTable.build(gaussians, classifier, "masks", names)
    views = [CameraView(CAMERA, inverse(pose), number) for number, pose in enumerate(poses)]
    return TableScene(SegmentedMap(gaussians, classifier, table, votes), views, images, truth)
