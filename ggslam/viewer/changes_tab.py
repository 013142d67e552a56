# SPDX-License-Identifier: Apache-2.0
"""Stepping through what changed between two visits: words, picture, boxes in space."""

from __future__ import annotations

from typing import Any

from ggslam.viewer.safe_text import plain
from ggslam.viewer.stage import Stage

NOTHING = "(none)"


class ChangesTab:
    """The list, one change at a time; all pages show the same one."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        gui: Any = stage.server.gui
        self._labels = [f"{number}. {change.text}" for number, change in enumerate(stage.changes, start=1)]
        self.choice = gui.add_dropdown("Change", [NOTHING, *self._labels], hint="Red: where it was; green: where it is")
        self._step = gui.add_button_group("Step", ["Back", "Next"])
        self._text = gui.add_markdown("")
        first = next((change.picture for change in stage.changes if change.picture is not None), None)
        self._image = None if first is None else gui.add_image(first, format="jpeg", jpeg_quality=85, visible=False)

        @self.choice.on_update
        @stage.guard
        def _on_choice(event: Any) -> None:
            if event.client is not None:
                self.show(self.number, event.client)

        @self._step.on_click
        @stage.guard
        def _on_step(event: Any) -> None:
            self.step(self._step.value == "Next", event.client)

    @property
    def number(self) -> int | None:
        """Of the change that is shown, from 0; None: none is."""
        return None if self.choice.value == NOTHING else self._labels.index(self.choice.value)

    def step(self, forward: bool, client: Any) -> None:
        """Shows the next change or the one before; after the last comes the first."""
        count, now = len(self._labels), self.number
        if now is None:
            now = -1 if forward else count
        self.show((now + (1 if forward else -1)) % count, client)

    def show(self, number: int | None, client: Any) -> None:
        """Draws a change, or none, and takes the page that asked for it there, if one did."""
        change = None if number is None else self._stage.changes[number]
        self.choice.value = NOTHING if number is None else self._labels[number]
        self._stage.nodes.set_change(change)
        self._text.content = "" if change is None else f"**{plain(change.text)}**"
        if self._image is not None:
            picture = None if change is None else change.picture
            self._image.visible = picture is not None
            if picture is not None:
                self._image.image = picture
        if change is not None and client is not None and change.boxes():
            self._stage.go(client, self._stage.view_of_boxes(change.boxes()))
