# SPDX-License-Identifier: Apache-2.0
"""Controls of what is drawn and from where."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np

from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import canvas_camera, shorter_fov
from ggslam.viewer.model import COLORINGS
from ggslam.viewer.stage import Stage


class SavedPictureTuning(Tuning):
    """How a picture is saved."""

    size = 1920
    """Longer side, in pixels."""


_LINES = {"path": "Camera path", "keyframes": "Keyframes", "now": "Current frame"}


class ViewTab:
    """Colours, lines, camera presets, saving a picture."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        gui: Any = stage.server.gui
        names = {COLORINGS[c]: c for c in stage.model.colorings}
        coloring = gui.add_dropdown("Colour by", list(names), hint="What the splats are coloured by")
        places = gui.add_button_group("Camera", ["Start", "Frame", "Top"], hint="Where to look from")
        with gui.add_folder("Show"):
            for name, label in _LINES.items():
                self._line_box(name, label)
            if stage.movers:
                self._line_box("movers", "What moved")
        save = gui.add_button(
            "Save picture", icon="camera", hint=f"Rendered by ggslam, {SavedPictureTuning.size} pixels wide"
        )

        @coloring.on_update
        @stage.guard
        def _recolor(event: Any) -> None:
            stage.coloring = names[coloring.value]
            stage.draw_map()

        @places.on_click
        @stage.guard
        def _go(event: Any) -> None:
            seen = event.client.camera
            views = {"Start": stage.start_view, "Frame": stage.frame_view,
                     "Top": lambda: stage.top_view(shorter_fov(seen.fov, seen.aspect))}  # fmt: skip
            stage.go(event.client, views[places.value]())

        @save.on_click
        @stage.guard
        def _save(event: Any) -> str:
            return self._save(event.client)

    def _line_box(self, name: str, label: str) -> None:
        box = self._stage.server.gui.add_checkbox(label, True)

        @box.on_update
        @self._stage.guard
        def _show(event: Any) -> None:
            self._stage.nodes.show_lines(name, box.value)

    def _save(self, client: Any) -> str:
        camera = canvas_camera(
            client.camera.image_width, client.camera.image_height, client.camera.fov, SavedPictureTuning.size
        )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = quaternion_to_matrix(client.camera.wxyz), client.camera.position
        picture = self._stage.model.picture(camera, T, self._stage.hidden)
        client.send_file_download(f"{self._stage.title}.png", png(picture), save_immediately=True)
        return f"rendered {camera.width}x{camera.height} pixels from here"


def png(picture: np.ndarray) -> bytes:
    """uint8 [H, W, 3] as a PNG file."""
    buffer = io.BytesIO()
    buffer.write(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    return buffer.getvalue()
