# SPDX-License-Identifier: Apache-2.0
"""What a page shows in space: splats in one group per object, the camera's path, keyframes, a selected object's box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import box_lines, frustum_lines, vertical_fov
from ggslam.viewer.model import ShownChange, ShownMover
from ggslam.viewer.splats import Splats

if TYPE_CHECKING:
    import viser


class SceneTuning(Tuning):
    """How a map is drawn in space."""

    unit_m = 0.01
    """Unit that splats are sent in, in metres: covariances travel in half precision, which would round those of a
    millimetre to nothing in square metres."""
    label_gap_m = 0.01
    """Distance of a label above its object, in metres."""
    path_color = (255, 176, 32)
    """RGB of the camera's path."""
    keyframe_color = (110, 190, 255)
    """RGB of keyframes."""
    selected_color = (255, 235, 60)
    """RGB of the selected object's box."""
    old_color = (220, 30, 30)
    """RGB of boxes where something was, as in the pictures of changes."""
    new_color = (20, 160, 60)
    """RGB of boxes where something is now."""


class SceneNodes:
    """Keeps the nodes of a viser scene.

    Args:
        server: whose scene it is; all its pages show the same.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._groups: dict[int, viser.GaussianSplatHandle] = {}
        self._marks: dict[str, viser.SceneNodeHandle] = {}
        self._hidden: set[str] = set()

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
            splats.centers / np.float32(SceneTuning.unit_m), splats.covariances / np.float32(SceneTuning.unit_m**2),
            splats.colors, splats.opacities[:, None],
        )  # fmt: skip
        group = self._groups.get(object_id)
        if group is None:
            name = f"/map/{object_id}"
            self._groups[object_id] = self._server.scene.add_gaussian_splats(name, *values, scale=SceneTuning.unit_m)
        else:
            group.set_gaussians(*values)
            group.position, group.wxyz = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)

    def set_visible(self, object_id: int, visible: bool) -> None:
        """Hides an object or shows it again."""
        if object_id in self._groups:
            self._groups[object_id].visible = visible

    def displace(self, object_id: int, T: np.ndarray) -> None:
        """Draws the selected object, its box and its label moved by T [4, 4] from where they belong."""
        moved = [self._groups.get(object_id), self._marks.get("/selected/box")]
        with self._server.atomic():
            for node in moved:
                if node is not None:
                    node.wxyz, node.position = matrix_to_quaternion(T[:3, :3]), T[:3, 3]
            if "/selected/label" in self._marks:
                self._marks["/selected/label"].position = T[:3, :3] @ self._label_at + T[:3, 3]

    # --- lines -------------------------------------------------------------------------------------------------------

    def set_path(self, walks: list[np.ndarray]) -> None:
        """The ways of the cameras, [K, 3] each."""
        lines = np.concatenate([np.stack([walk[:-1], walk[1:]], axis=1) for walk in walks])
        self._lines("/camera/path", lines, SceneTuning.path_color, 3.0)

    def set_keyframes(self, T_world_camera: np.ndarray, camera: Camera, depth: float) -> None:
        """Pyramids at the keyframes, [K, 4, 4]."""
        self._lines("/camera/keyframes", frustum_lines(T_world_camera, camera, depth), SceneTuning.keyframe_color, 1.0)

    def set_movers(self, movers: Sequence[ShownMover], frame: int) -> None:
        """The ways of what moved, and the boxes of what moves in a frame."""
        lines, colors = [np.zeros((0, 2, 3), np.float32)], [np.zeros((0, 2, 3), np.uint8)]
        for mover in movers:
            own = [np.stack([mover.way[:-1], mover.way[1:]], axis=1)]
            own += [box_lines(*mover.boxes[frame])] if frame in mover.boxes else []
            lines += own
            colors += [np.broadcast_to(np.array(mover.color, np.uint8), part.shape) for part in own]
        self._lines("/camera/movers", np.concatenate(lines), np.concatenate(colors), 2.5)

    def set_change(self, change: ShownChange | None) -> None:
        """Boxes of what changed, and from middle to middle of what moved; None: nothing."""
        lines, colors = [np.zeros((0, 2, 3), np.float32)], [np.zeros((0, 2, 3), np.uint8)]
        if change is not None:
            for box, color in ((change.old, SceneTuning.old_color), (change.new, SceneTuning.new_color)):
                lines += [] if box is None else [box_lines(*box)]
                colors += [] if box is None else [np.broadcast_to(np.array(color, np.uint8), (12, 2, 3))]
            if change.old is not None and change.new is not None:
                lines.append(np.array([[change.old[0], change.new[0]]], np.float32))
                colors.append(np.array([[SceneTuning.old_color, SceneTuning.new_color]], np.uint8))
        self._lines("/camera/change", np.concatenate(lines), np.concatenate(colors), 3.0)

    def set_box(self, center: np.ndarray, axes: np.ndarray, size: np.ndarray, up: np.ndarray, text: str) -> None:
        """Frames the selected object and writes a label above it."""
        self._lines("/selected/box", box_lines(center, axes, size), SceneTuning.selected_color, 2.0)
        self._label_at = center + up * (np.abs(axes @ up) @ size / 2 + SceneTuning.label_gap_m)
        self._drop("/selected/label")
        self._marks["/selected/label"] = self._server.scene.add_label(
            "/selected/label", text, position=self._label_at, anchor="bottom-center"
        )

    def drop_box(self) -> None:
        """Nothing is selected any more."""
        for name in ("/selected/box", "/selected/label"):
            self._drop(name)

    def set_frame(self, T_world_camera: np.ndarray, camera: Camera, depth: float, picture: np.ndarray) -> None:
        """The camera of one frame with its picture, uint8 [H, W, 3], `depth` metres before it."""
        fov, aspect = vertical_fov(camera), camera.width / camera.height
        # viser's `scale` is that of the volume: the cube root of a third of height by width by depth.
        scale = depth * float(np.cbrt(np.tan(fov / 2) ** 2 * aspect / 3))
        name = "/camera/now"
        self._marks[name] = self._server.scene.add_camera_frustum(
            name, fov=fov, aspect=aspect, scale=scale, color=SceneTuning.path_color, image=picture,
            thickness=2.5, thickness_units="screen", wxyz=matrix_to_quaternion(T_world_camera[:3, :3]),
            position=T_world_camera[:3, 3], visible=name not in self._hidden,
        )  # fmt: skip

    def show_lines(self, name: str, visible: bool) -> None:
        """Shows or hides "path", "keyframes", "now" or "movers", also those that come later."""
        node = f"/camera/{name}"
        (self._hidden.discard if visible else self._hidden.add)(node)
        if node in self._marks:
            self._marks[node].visible = visible

    def _lines(self, name: str, segments: np.ndarray, color: tuple[int, int, int] | np.ndarray, width: float) -> None:
        self._drop(name)
        if len(segments):
            self._marks[name] = self._server.scene.add_line_segments(
                name, segments.astype(np.float32), color, thickness=width, thickness_units="screen",
                visible=name not in self._hidden,
            )  # fmt: skip

    def _drop(self, name: str) -> None:
        if name in self._marks:
            self._marks.pop(name).remove()
