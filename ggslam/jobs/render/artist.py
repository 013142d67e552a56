# SPDX-License-Identifier: Apache-2.0
"""Draws a map: its colours, depths and objects, by any camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.rendered_ids import object_ids
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import RenderBuffers, low_pass_for
from ggslam.reporting.pictures import color_of_depth, color_of_ids, color_to_uint8, depth_range, identity_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse

KINDS = ("color", "depth", "alpha", "ids", "pca")
OBJECT_KINDS = ("ids", "pca")
"""Pictures of a run with objects only: each object in its colour; identity vectors by principal components."""
Painter = Callable[[RenderBuffers, GaussianMap], np.ndarray]


class Artist:
    """Draws the map of a run, of which only what a view needs is read.

    Args:
        folder: of the run.
        kinds: some of `KINDS`.

    Attributes:
        kinds: what is drawn.
        objects: the run's, if they are drawn.
        depth_limits: (near, far) in metres, which the colours of depth span; None: those of each picture.

    Raises:
        ConfigError: `kinds` names something else.
        RunFolderError: objects are asked of a run that has none.
    """

    def __init__(self, folder: RunFolder, kinds: Sequence[str]) -> None:
        unknown = [kind for kind in kinds if kind not in KINDS]
        if unknown or not kinds:
            raise ConfigError(f"`what`: expected some of {','.join(KINDS)}, found {(unknown or [''])[0]!r}")
        self.kinds = list(kinds)
        self.objects = ObjectsInParts.of(folder) if set(kinds) & set(OBJECT_KINDS) else None
        self._parts = folder.map_in_parts() if self.objects is None else self.objects.map
        self.depth_limits: tuple[float, float] | None = None
        self._trained = folder.sequence().cameras() if folder.has_poses else []
        self._rasterizer = CpuRasterizer()
        self._painters: dict[str, Painter] = {
            "color": lambda view, _: color_to_uint8(view.image.numpy()),
            "depth": lambda view, _: self.color_depth(_surface_depth(view)),
            "alpha": lambda view, _: (255 * np.clip(view.alpha.numpy(), 0, 1) + 0.5).astype(np.uint8),
        }
        if self.objects is not None:
            self._painters |= self._object_painters(self.objects)

    def pictures(self, camera: Camera, T_world_camera: np.ndarray) -> dict[str, np.ndarray]:
        """uint8 [H, W, 3], of alpha [H, W], by kind."""
        view, gaussians = self._view(camera, T_world_camera)
        return {kind: self._painters[kind](view, gaussians) for kind in self.kinds}

    def depth(self, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
        """Depth of the surface, float32 [H, W] in metres, 0 where there is none."""
        return _surface_depth(self._view(camera, T_world_camera)[0])

    def color_depth(self, depth: np.ndarray) -> np.ndarray:
        """Depth [H, W] in metres as colours, uint8 [H, W, 3]."""
        return color_of_depth(depth, *(self.depth_limits or depth_range(depth)))

    def _view(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[RenderBuffers, GaussianMap]:
        T_camera_world = inverse(T_world_camera)
        gaussians = self._parts.in_view(camera, T_camera_world)
        view = self._rasterizer.forward(
            gaussians, camera, T_camera_world, features=self.objects is not None,
            low_pass=low_pass_for(camera, self._trained),
        )
        return view, gaussians

    def _object_painters(self, objects: ObjectsInParts) -> dict[str, Painter]:
        palette = objects.table.palette()

        def ids(view: RenderBuffers, gaussians: GaussianMap) -> np.ndarray:
            return color_of_ids(object_ids(self._rasterizer, view, objects.around(gaussians)), palette, outlines=True)

        if "pca" not in self.kinds:
            return {"ids": ids}
        colors = objects.identity_colors()
        return {"ids": ids, "pca": lambda view, _: identity_picture(view, colors)}


def _surface_depth(view: RenderBuffers) -> np.ndarray:
    return np.where(view.alpha.numpy() > 0.5, view.expected_depth.numpy(), 0)
