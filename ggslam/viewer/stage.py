# SPDX-License-Identifier: Apache-2.0
"""The state of a page that its tabs share: what it shows, and from where."""

from __future__ import annotations

import functools
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ggslam.errors import GgslamError
from ggslam.viewer.cameras import CameraTuning, Viewpoint, best_view, top_view, view_of_pose
from ggslam.viewer.model import Box, Coloring, ViewedMap
from ggslam.viewer.safe_text import plain
from ggslam.viewer.scene_nodes import SceneNodes

if TYPE_CHECKING:
    import viser



class Stage:
    """A map on all pages of a server; they share what is selected, hidden and looked at.

    Args:
        server: with an empty page.
        model: the map.
        title: above everything.

    Attributes:
        edited: called after an edit changed what pictures show.
    """

    def __init__(self, server: viser.ViserServer, model: ViewedMap, title: str) -> None:
        self.server, self.model, self.title = server, model, title
        self.nodes = SceneNodes(server)
        self.hidden: set[int] = set()
        self.coloring: Coloring = "colour"
        self.frame = next(iter(model.frame_poses))
        self.edited: Callable[[], None] = lambda: None
        self._drawing = threading.RLock()
        self.centers, self.movers = np.zeros((0, 3), np.float32), model.movers()
        self.changes = model.changes()
        self.draw_map()
        self._draw_camera()
        self.summary = server.gui.add_markdown("")

    # --- space -------------------------------------------------------------------------------------------------------

    def draw_map(self) -> None:
        """Sends all splats anew."""
        with self._drawing:
            groups = self.model.splats(self.coloring, self.frame)
            self.centers = np.concatenate([splats.centers for splats in groups.values()] or [self.centers[:0]])
            self.nodes.set_splats(groups)
            for object_id in groups:
                self.nodes.set_visible(object_id, object_id not in self.hidden)

    def _draw_camera(self) -> None:
        extent = np.ptp(self.centers, axis=0) if len(self.centers) else np.zeros(3)  # all objects may have been removed
        self.depth = float(np.clip(0.01 * np.linalg.norm(extent), 0.02, 0.06))
        self.nodes.set_path(self.model.walks)
        self.nodes.set_keyframes(self.model.keyframe_poses, self.model.camera, self.depth)
        self.nodes.set_movers(self.movers, self.frame)

    def describe(self) -> None:
        """Says what is shown."""
        self.summary.content = f"**{plain(self.title)}**  \n{self.model.describe()}"

    # --- cameras -----------------------------------------------------------------------------------------------------

    def start_view(self) -> Viewpoint:
        """As the first frame saw it."""
        return self._view_of(next(iter(self.model.frame_poses.values())))

    def top_view(self, fov: float) -> Viewpoint:
        """From above; `fov` of the window along its shorter side, radians."""
        poses = np.stack(list(self.model.frame_poses.values()))
        return top_view(self.centers, poses[:, :3, 3], poses[0, :3, 2], self.model.up, fov)

    def frame_view(self) -> Viewpoint:
        """What the frame that is looked at saw."""
        return self._view_of(self.model.frame_poses[self.frame])

    def view_of_boxes(self, boxes: Sequence[Box]) -> Viewpoint:
        """From the frame that shows boxes best, looking at them."""
        return best_view(boxes, list(self.model.frame_poses.values()), self.model.camera, 2.5 * self.depth)

    def _view_of(self, T_world_camera: np.ndarray) -> Viewpoint:
        """From a recorded camera, without the lines and the picture that are drawn right before it."""
        return replace(view_of_pose(T_world_camera, CameraTuning.look_ahead_m), near=2.5 * self.depth)

    def go(self, client: viser.ClientHandle, view: Viewpoint) -> None:
        """Takes a page's camera to a place."""
        with client.atomic():
            client.camera.up_direction = view.up
            client.camera.near = view.near
            client.camera.position = view.position
            client.camera.look_at = view.look_at

    # --- what goes wrong ---------------------------------------------------------------------------------------------

    def guard(self, action: Callable[[Any], str | None]) -> Callable[[Any], None]:
        """Makes a callback of an action: its sentence, or why it failed, is shown to who asked."""

        @functools.wraps(action)
        def callback(event: Any) -> None:
            try:
                text, failed = action(event), False
            except GgslamError as error:
                text, failed = str(error), True
            except Exception as error:  # a callback that fails must not go unnoticed
                traceback.print_exc()
                text, failed = f"{type(error).__name__}: {error}", True
            if text:
                self.tell(event.client, text, failed)

        return callback

    def tell(self, client: viser.ClientHandle | None, text: str, failed: bool = False) -> None:
        """Shows a sentence for some seconds."""
        clients = [client] if client is not None else list(self.server.get_clients().values())
        for one in clients:
            one.add_notification(
                "Not done" if failed else "Done", text, auto_close_seconds=12.0 if failed else 6.0,
                color="red" if failed else "teal",
            )  # fmt: skip
