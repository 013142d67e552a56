# SPDX-License-Identifier: Apache-2.0
"""A run as the viewer's page asks for it: what is in it, its splats, and what the page does to it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pydantic

from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.view.packing import packed_rows
from ggslam.jobs.view.page_actions import PageActions
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.map_file import MapFile
from ggslam.runs.publishing import change_in_run
from ggslam.runs.records.annotations import AnnotationsRecord, CameraKeysRecord
from ggslam.runs.records.record import RecordFile
from ggslam.viewer.page_source import Download
from ggslam.viewer.scene_values import jpeg, packed_chunk, scene_values

CHUNK = "map"
"""Of a map that comes in one piece."""


class RunPage:
    """A `PageSource` of a run.

    Args:
        model: the run.
        title: of the page.
        caption: a line below the map.
        tell: told what changed, as `PageServer.tell`.
    """

    def __init__(
        self, model: ViewedRun, title: str, caption: str = "", tell: Callable[..., None] = lambda *what, **values: None
    ) -> None:
        self.model, self._title, self._caption, self._tell = model, title, caption, tell
        self._version = 0
        self._turn = threading.Lock()
        self._actions = PageActions(model)
        self._packed = lru_cache(maxsize=8)(self._pack)
        self._frame = lru_cache(maxsize=64)(self._draw_frame)

    def scene(self) -> dict[str, Any]:
        """See `PageSource`."""
        model = self.model
        with model.turn():
            low, high = _corners(model.centers())
            count = len(model.shown_rows())
            return {
                **scene_values(model, self._title, self._caption), **self._state(), "served": True, "live": False,
                "editable": True, "keeps": not isinstance(model.folder, MapFile),
                "target": model.default_target(), "folder": str(model.save_folder()),
                "chunks": [{"id": CHUNK, "count": count, "levels": [count], "low": low, "high": high}],
                "annotations": self._read(AnnotationsRecord).get("annotations", []),
                "camera_keys": self._read(CameraKeysRecord).get("keys", []),
            }  # fmt: skip

    def _state(self) -> dict[str, Any]:
        """What edits change."""
        model = self.model
        owners = model.gaussians().object_id.numpy()
        return {
            "version": self._version, "edits": model.edits(), "redo": model.undone(),
            "unlabelled": int((owners == 0).sum()), "about": model.describe(),
        }  # fmt: skip

    def splats(self, chunk: str, level: int) -> bytes:
        """See `PageSource`."""
        if chunk != CHUNK:
            raise ConfigError(f"there is no part {chunk[:40]!r} of this map")
        return self._packed(self._version)

    def _pack(self, version: int) -> bytes:
        header, content = packed_rows(self.model, self.model.shown_rows())
        return packed_chunk({**header, "version": version}, content)

    def frame_picture(self, frame: int) -> bytes:
        """See `PageSource`."""
        if frame not in self.model.frame_poses:
            raise ConfigError(f"there is no frame {frame}")
        return self._frame(self._version, frame)

    def _draw_frame(self, version: int, frame: int) -> bytes:
        return jpeg(self.model.frame_picture(frame)[0])

    def answer(self, action: str, values: Any) -> dict[str, Any] | Download:
        """See `PageSource`."""
        if not isinstance(values, dict):
            raise ConfigError(f"{action[:40]}: expected an object")
        if action == "annotations":
            return self._write(AnnotationsRecord, values)
        if action == "camera-keys":
            return self._write(CameraKeysRecord, values)
        if action in ("edit", "undo", "redo"):
            return self._change(action, values)
        result = self._actions.answer(action, values)
        if result is None:
            raise ConfigError(f"{action[:40]!r}: a page cannot ask for that")
        return result

    def _change(self, action: str, values: dict[str, Any]) -> dict[str, Any]:
        with self._turn:  # what one page does is done before another's
            own = {"undo": self.model.undo, "redo": self.model.redo}.get(action)
            text = self._actions.edit(values) if own is None else own()
            self._version += 1
            state = self._state()
        self._tell("scene", "splats", version=state["version"])
        return {"text": text, **state}

    # --- what is kept beside the run ----------------------------------------------------------------------------------

    def _read(self, kind: type[RecordFile]) -> dict[str, Any]:
        if isinstance(self.model.folder, MapFile):
            return {}
        try:
            record = kind.read_if_there(self.model.folder.path)
            return {} if record is None else record.values()
        except (GgslamError, RecursionError):  # the map is there
            return {}

    def _write(self, kind: type[RecordFile], values: dict[str, Any]) -> dict[str, Any]:
        if isinstance(self.model.folder, MapFile):
            raise ConfigError("notes are kept beside runs, and this is a file; the page can download them")
        try:
            record = kind.of(values)
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise ConfigError(f"{kind.FILE}: {place}: {first['msg']}") from None
        path = self.model.folder.path
        with self._turn, change_in_run(path / kind.FILE):
            record.write(path)
        self._tell("scene")
        return {"text": f"kept in {path / kind.FILE}"}


def _corners(centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (centers.min(0), centers.max(0)) if len(centers) else (np.zeros(3), np.zeros(3))
