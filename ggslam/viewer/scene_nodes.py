# SPDX-License-Identifier: Apache-2.0
"""What a page shows in space: splats in one group per object, the camera's path, keyframes, a selected object's box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion
from ggslam.viewer.cameras import box_lines, frustum_lines
from ggslam.viewer.splats import Splats

if TYPE_CHECKING:
    import viser

UNIT_M = 0.01
"""Splats are sent in centimetres and drawn at this scale: covariances travel in half precision, which in square metres
would round splats of a millimetre to nothing."""
_PATH, _KEYFRAMES, _SELECTED = (255, 176, 32), (110, 190, 255), (255, 235, 60)


class SceneNodes:
    """Keeps the nodes of a viser scene.

    Args:
        server: whose scene it is; all its pages show the same.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._groups: dict[int, viser.GaussianSplatHandle] = {}
        self._marks: dict[str, viser.SceneNodeHandle] = {}

    # --- splats ------------------------------------------------------------------------------------------------------

    def set_splats(self, groups: Mapping[int, Splats]) -> None:
        """Shows these splats, by object id (0: no object's), and none else."""
        with self._server.atomic():
            for object_id in set(self._groups) - {i for i, splats in groups.items() if len(splats)}:
                self._groups.pop(object_id).remove()
            for object_id, splats in groups.items():
                if len(splats):
                    self.set_group(object_id, splats)

    def set_group(self, object_id: int, splats: Splats) -> None:
        """Shows or replaces the splats of one object, where they belong."""
        values = (
            splats.centers / np.float32(UNIT_M), splats.covariances / np.float32(UNIT_M**2),
            splats.colors, splats.opacities[:, None],
        )  # fmt: skip
        group = self._groups.get(object_id)
        if group is None:
            name = f"/map/{object_id}"
            self._groups[object_id] = self._server.scene.add_gaussian_splats(name, *values, scale=UNIT_M)
        else:
            group.set_gaussians(*values)
            group.position, group.wxyz = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)

    def set_visible(self, object_id: int, visible: bool) -> None:
        """Hides an object or shows it again."""
        if object_id in self._groups:
            self._groups[object_id].visible = visible

    def displace(self, object_id: int, T: np.ndarray) -> None:
        """Draws an object moved by T [4, 4] from where its splats are."""
        if object_id in self._groups:
            group = self._groups[object_id]
            group.wxyz, group.position = matrix_to_quaternion(T[:3, :3]), T[:3, 3]

    # --- lines -------------------------------------------------------------------------------------------------------

    def set_path(self, positions: np.ndarray) -> None:
        """The way of the camera, [K, 3]."""
        self._lines("/camera/path", np.stack([positions[:-1], positions[1:]], axis=1), _PATH, 3.0)

    def set_keyframes(self, T_world_camera: np.ndarray, camera: Camera, depth: float) -> None:
        """Pyramids at the keyframes, [K, 4, 4]."""
        self._lines("/camera/keyframes", frustum_lines(T_world_camera, camera, depth), _KEYFRAMES, 1.0)

    def set_box(self, center: np.ndarray, axes: np.ndarray, size: np.ndarray, text: str) -> None:
        """Frames the selected object and labels it."""
        lines = box_lines(center, axes, size)
        self._lines("/selected/box", lines, _SELECTED, 2.0)
        self._drop("/selected/label")
        self._marks["/selected/label"] = self._server.scene.add_label("/selected/label", text, position=center)

    def drop_box(self) -> None:
        """Nothing is selected any more."""
        for name in ("/selected/box", "/selected/label"):
            self._drop(name)

    def set_frame(self, T_world_camera: np.ndarray, camera: Camera, depth: float, picture: np.ndarray) -> None:
        """The camera of one frame with its picture, uint8 [H, W, 3]."""
        fov = 2 * float(np.arctan(camera.height / 2 / camera.fy))
        self._marks["/camera/now"] = self._server.scene.add_camera_frustum(
            "/camera/now", fov=fov, aspect=camera.width / camera.height, scale=depth, color=_PATH, image=picture,
            thickness=2.5, thickness_units="screen", wxyz=matrix_to_quaternion(T_world_camera[:3, :3]),
            position=T_world_camera[:3, 3],
        )  # fmt: skip

    def show_lines(self, name: str, visible: bool) -> None:
        """Shows or hides "path", "keyframes" or "now"."""
        if f"/camera/{name}" in self._marks:
            self._marks[f"/camera/{name}"].visible = visible

    def _lines(self, name: str, segments: np.ndarray, color: tuple[int, int, int], width: float) -> None:
        visible = name not in self._marks or self._marks[name].visible
        self._drop(name)
        if len(segments):
            self._marks[name] = self._server.scene.add_line_segments(
                name, segments.astype(np.float32), color, thickness=width, thickness_units="screen", visible=visible
            )

    def _drop(self, name: str) -> None:
        if name in self._marks:
            self._marks.pop(name).remove()
