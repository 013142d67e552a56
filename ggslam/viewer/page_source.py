# SPDX-License-Identifier: Apache-2.0
"""What a page asks the program that serves it."""

from __future__ import annotations

from typing import Any, Protocol

from ggslam.errors import ConfigError


class PageSource(Protocol):
    """A map to be looked at. Methods may be called from any thread; errors tell the page what cannot be done."""

    def scene(self) -> dict[str, Any]:
        """What is in it, for JSON; see `scene_values`."""

    def splats(self, chunk: str, level: int) -> bytes:
        """A part of its splats, see `packed_chunk`; level 0: all of them, 1: the most visible quarter, and so on."""

    def frame_picture(self, frame: int) -> bytes:
        """JPEG: recorded and rendered images of a frame."""

    def answer(self, action: str, values: Any) -> dict[str, Any] | Download:
        """Does what a page asks for: an edit, a selection, a picture; see `jobs.view.page_actions`."""


class Download:
    """A file that a page gets.

    Args:
        name: of the file.
        kind: its media type.
        content: its bytes.
    """

    def __init__(self, name: str, kind: str, content: bytes) -> None:
        self.name, self.kind, self.content = name, kind, content


class NothingYet:
    """A page that waits for its map.

    Args:
        title: of the page.
        text: that it shows.
    """

    def __init__(self, title: str, text: str) -> None:
        self._title, self._text = title, text

    def scene(self) -> dict[str, Any]:
        """See `PageSource`."""
        return {"title": self._title, "about": self._text, "waiting": True, "served": True}

    def splats(self, chunk: str, level: int) -> bytes:
        """See `PageSource`."""
        raise ConfigError("there is no map yet")

    def frame_picture(self, frame: int) -> bytes:
        """See `PageSource`."""
        raise ConfigError("there is no frame yet")

    def answer(self, action: str, values: Any) -> dict[str, Any] | Download:
        """See `PageSource`."""
        raise ConfigError("there is no map yet")
