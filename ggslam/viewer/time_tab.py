# SPDX-License-Identifier: Apache-2.0
"""Going through the recording: what a frame recorded beside what the map renders from its pose."""

from __future__ import annotations

import threading
import time
from typing import Any

from ggslam.system.tuning import Tuning
from ggslam.viewer.stage import Stage


class PlaybackTuning(Tuning):
    """How a recording is played."""

    frames_per_s = 8.0
    """Frames per second."""


class TimeTab:
    """Slider, playing, following with the page's camera, pictures."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        gui: Any = stage.server.gui
        self._frames = list(stage.model.frame_poses)
        last = max(1, len(self._frames) - 1)
        self.slider = gui.add_slider("Frame", 0, last, 1, 0, hint="Frames of the recording that were located")
        self._play = gui.add_checkbox("Play", False)
        self._follow = gui.add_checkbox("Camera follows", False, hint="Look from where the frame was taken")
        self._text = gui.add_markdown("")
        picture, _ = stage.model.frame_picture(self._frames[0])
        self._image = gui.add_image(picture, format="jpeg", jpeg_quality=85)
        self._wanted = threading.Event()
        self._text.content = f"Frame {self._frames[0]}"
        threading.Thread(target=self._follow_slider, name="viewer-frames", daemon=True).start()

        @self.slider.on_update
        @stage.guard
        def _on_move(event: Any) -> None:
            self._wanted.set()

        @self._follow.on_update
        @stage.guard
        def _on_follow(event: Any) -> None:
            self._look()

        @self._play.on_update
        @stage.guard
        def _on_play(event: Any) -> None:
            if self._play.value:
                threading.Thread(target=self._run, name="viewer-play", daemon=True).start()

    def redraw(self) -> None:
        """The map has changed."""
        self._wanted.set()

    def _follow_slider(self) -> None:
        """Renders for the newest place of the slider; places passed meanwhile are skipped."""
        while True:
            self._wanted.wait()
            self._wanted.clear()
            frame = self._frames[min(int(self.slider.value), len(self._frames) - 1)]
            self._stage.frame = frame
            self._draw(frame, *self._stage.model.frame_picture(frame))
            self._look()
            if self._stage.coloring == "depth":
                self._stage.draw_map()

    def _draw(self, frame: int, picture: Any, recorded: Any) -> None:
        self._text.content = f"Frame {frame}"
        self._image.image = picture
        stage = self._stage
        stage.nodes.set_frame(stage.model.frame_poses[frame], stage.model.camera, 2 * stage.depth, recorded)
        if stage.movers:
            stage.nodes.set_movers(stage.movers, frame)

    def _look(self) -> None:
        if self._follow.value:
            for client in self._stage.server.get_clients().values():
                self._stage.go(client, self._stage.frame_view())

    def _run(self) -> None:
        while self._play.value:
            began = time.monotonic()
            self.slider.value = (int(self.slider.value) + 1) % len(self._frames)
            self._wanted.set()
            time.sleep(max(0.01, 1 / PlaybackTuning.frames_per_s - (time.monotonic() - began)))
