# SPDX-License-Identifier: Apache-2.0
"""Pictures of triangle meshes, drawn by the compiled core."""

from __future__ import annotations

import ctypes

import numpy as np

from ggslam.abi.core import MeshPictureInput
from ggslam.native.loader import NativeContext, load_library
from ggslam.reporting.cloud_pictures import CloudView
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class MeshDrawingTuning(Tuning):
    """How meshes are drawn."""

    background = 255
    """Grey of the background."""
    ambient = 0.35
    """Share of its colour that a surface has which the camera's light meets from the side."""


class MeshDrawing:
    """A picture that meshes are drawn into one after the other; what is nearer hides what is farther away.

    Args:
        view: where from.
        cull: leave out triangles that are seen from behind, so that one looks into a room through its walls.
        near: nothing nearer to the camera is drawn, nor triangles that reach there; in units of the positions.
        context: threads to work on.

    Attributes:
        picture: uint8 [H, W, 3]; white where nothing was drawn.
    """

    def __init__(
        self, view: CloudView, cull: bool = True, near: float = 0.05, context: NativeContext | None = None
    ) -> None:
        self._view, self._cull, self._near, self._context = view, cull, near, context or NativeContext()
        shape = view.camera.height, view.camera.width
        self.picture = np.full((*shape, 3), MeshDrawingTuning.background, np.uint8)
        self._inverse_depth = np.zeros(shape, np.float32)

    def add(self, vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, colors: np.ndarray) -> None:
        """Draws a mesh lit from the camera; arguments and errors as of `draw_mesh`."""
        if not len(vertices) == len(normals) == len(colors):
            raise ValueError(f"found {len(vertices)} vertices, {len(normals)} normals and {len(colors)} colors")
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise ValueError(f"triangles name vertices {triangles.min()} to {triangles.max()} of {len(vertices)}")
        T = inverse(self._view.T_world_camera).astype(np.float32)
        position = np.ascontiguousarray(vertices @ T[:3, :3].T + T[:3, 3], np.float32)
        away = np.maximum(np.linalg.norm(position, axis=1), 1e-9)
        facing = np.abs(((normals @ T[:3, :3].T) * position).sum(1)) / away
        shade = MeshDrawingTuning.ambient + (1 - MeshDrawingTuning.ambient) * np.minimum(facing, 1)
        shaded = np.ascontiguousarray(np.rint(colors * shade[:, None]), np.uint8)
        corners, camera = np.ascontiguousarray(triangles, np.int32), self._view.camera
        mesh = MeshPictureInput(
            position.ctypes.data, shaded.ctypes.data, corners.ctypes.data, len(position), len(corners),
            camera.fx, camera.fy, camera.cx, camera.cy, self._near, camera.width, camera.height, int(self._cull),
        )  # fmt: skip
        load_library().ggslam_draw_mesh(
            self._context.handle, ctypes.byref(mesh), self._inverse_depth.ctypes.data, self.picture.ctypes.data
        )


def draw_mesh(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, colors: np.ndarray, view: CloudView,
    cull: bool = True, near: float = 0.05, context: NativeContext | None = None,
) -> np.ndarray:  # fmt: skip
    """A picture, uint8 [H, W, 3], of a mesh lit from the camera; white where there is none.

    Args:
        vertices: float [V, 3].
        triangles: int [F, 3], rows of vertices, counter-clockwise seen from their front.
        normals: float [V, 3], unit.
        colors: uint8 [V, 3], of the surface, or of the objects (a row of a palette for each vertex' label).
        view, cull, near, context: as of `MeshDrawing`.

    Raises:
        ValueError: arrays whose lengths do not agree, or a triangle of vertices that are not there.
    """
    drawing = MeshDrawing(view, cull, near, context)
    drawing.add(vertices, triangles, normals, colors)
    return drawing.picture
