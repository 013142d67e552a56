# SPDX-License-Identifier: Apache-2.0
"""What a page asks to be done to a run: edits, selections, pictures, files."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import cv2
import numpy as np

from ggslam.errors import ConfigError
from ggslam.jobs.edit.edit import Edit
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.objects.selection import Selection, read_selection
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.viewer.page_source import Download


class PageActionTuning(Tuning):
    """What pages may ask for."""

    digits = 5
    """Decimals of a shift in metres and a rotation in degrees, as shown and as saved."""
    max_picture = 4096
    """Longest side of a picture that is rendered, in pixels."""


class PageActions:
    """Does what a page asks for.

    Args:
        model: the run.
    """

    def __init__(self, model: ViewedRun) -> None:
        self._model = model

    def answer(self, action: str, values: dict[str, Any]) -> dict[str, Any] | Download | None:
        """What comes of it; None: there is no such action.

        Raises:
            ConfigError: it cannot be done.
        """
        if action == "select":
            return self._select(values)
        if action == "save":
            return {"text": self._model.save(_text(values, "target"), values.get("inpaint") is True)}
        if action == "picture":
            return self._picture(values)
        if action == "export":
            name, content = self._model.export(_whole(values, "object"))
            return Download(name, "application/octet-stream", content)
        return None

    def edit(self, values: dict[str, Any]) -> str:
        """Does an edit: {"kind": "rename", "object", "name"}, {"kind": "merge", "object", "other"}, or of a selection
        (see `objects.selection`) {"kind": "remove" | "keep"}, {"kind": "move", "T": [16] by rows}, {"kind": "recolor",
        "color": "#rrggbb"}, {"kind": "assign", "object": id | "none" | "new", "name"}; returns a sentence about it.

        Raises:
            ConfigError: it cannot be done.
        """
        kind = values.get("kind")
        if kind == "rename":
            return self._model.edit(Edit("rename", str(_whole(values, "object")), _text(values, "name")))
        if kind == "merge":
            return self._model.edit(Edit("merge", str(_whole(values, "object")), str(_whole(values, "other"))))
        steps = values.get("selection")
        selection, text = read_selection(steps), json.dumps(steps)
        if kind == "move":
            return self._model.edit(self._move(selection, text, values))
        if kind == "recolor":
            return self._model.edit(_edit_of(selection, text, "recolor", _text(values, "color")))
        if kind == "remove":
            return self._model.edit(_edit_of(selection, text, "remove"))
        if kind == "keep":
            return self._model.edit(_edit_of(selection, text, "keep"))
        if kind == "assign":
            target = values.get("object")
            words = target if target in ("new", "none") else str(_whole(values, "object"))
            return self._model.edit(Edit("assign", words, _text(values, "name", ""), selection=text))
        raise ConfigError("edit: expected rename, merge, remove, keep, move, recolor or assign")

    def _move(self, selection: Selection, text: str, values: dict[str, Any]) -> Edit:
        """A rigid motion as people write it: how far the middle goes, and how it turns about it."""
        T = _matrix(values, "T")
        rows = self._model.rows_of(text)
        if not rows.any():
            raise ConfigError("nothing is selected")
        ids = selection.objects()
        whole = bool(ids) and 0 not in (ids or ())  # whole objects turn about their own middle and leave holes
        center = self._model.centroid_of(ids or ()) if whole else self._model.centroid_of_rows(rows)
        shift = T[:3, :3] @ center + T[:3, 3] - center
        turn = _turns(T[:3, :3])
        rotation = _numbers(turn) if np.abs(turn).max() > 10.0**-PageActionTuning.digits else ""
        if whole:
            return Edit("move", ",".join(map(str, ids or ())), _numbers(shift), rotation)
        return Edit("move", "", _numbers(shift), rotation, text)

    def _select(self, values: dict[str, Any]) -> dict[str, Any]:
        """Which Gaussians a selection holds: of those that are shown as bits, and how many of all."""
        steps = values.get("selection")
        read_selection(steps)
        rows = self._model.rows_of(json.dumps(steps))
        shown = rows[self._model.shown_rows()]
        bits = np.packbits(shown, bitorder="little").tobytes()
        return {"count": int(rows.sum()), "shown": int(shown.sum()), "bits": base64.b64encode(bits).decode("ascii")}

    def _picture(self, values: dict[str, Any]) -> Download:
        """A PNG by ggslam's own renderer: width, height, fov along the shorter side, T_world_camera, hidden ids."""
        width, height = _whole(values, "width"), _whole(values, "height")
        if not 16 <= min(width, height) <= max(width, height) <= PageActionTuning.max_picture:
            raise ConfigError(f"picture: expected sides of 16 to {PageActionTuning.max_picture} pixels")
        focal: Any = values.get("focal")
        if type(focal) not in (int, float) or not 1 <= focal <= 1e5:
            raise ConfigError("picture: focal: expected a number of pixels")
        hidden = values.get("hidden", [])
        if not isinstance(hidden, list) or not all(type(i) is int for i in hidden):
            raise ConfigError("picture: hidden: expected object ids")
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        picture = self._model.picture(camera, _matrix(values, "T_world_camera"), set(hidden))
        return Download("map.png", "image/png", cv2.imencode(".png", picture[..., ::-1])[1].tobytes())


def _edit_of(selection: Selection, text: str, kind: Any, value: str = "") -> Edit:
    """An edit of whole objects, where that is what is selected: they take their floaters along."""
    ids = selection.objects()
    if ids and 0 not in ids:
        return Edit(kind, ",".join(map(str, ids)), value)
    return Edit(kind, "", value, selection=text)


def _matrix(values: dict[str, Any], name: str) -> np.ndarray:
    found = values.get(name)
    good = isinstance(found, list) and len(found) == 16 and all(type(v) in (int, float) for v in found)
    good = good and all(abs(v) <= 1e6 for v in found or ())  # of whole numbers, too, that no float holds
    T = np.array(found, np.float64).reshape(4, 4) if good else np.full((4, 4), math.nan)
    rigid = np.isfinite(T).all() and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3)
    if not rigid or np.linalg.det(T[:3, :3]) < 0:
        raise ConfigError(f"{name}: expected a rigid transform, 16 numbers by rows")
    u, _, v = np.linalg.svd(T[:3, :3])
    T[:3, :3], T[3] = u @ v, (0, 0, 0, 1)
    return T


def _turns(R: np.ndarray) -> np.ndarray:
    """Degrees about the world's x, then y, then z axis that make a rotation; of those that are as good, without z."""
    about_y = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:  # x and z turn about the same line
        return np.degrees([math.atan2(-R[1, 2], R[1, 1]), about_y, 0.0])
    return np.degrees([math.atan2(R[2, 1], R[2, 2]), about_y, math.atan2(R[1, 0], R[0, 0])])


def _whole(values: dict[str, Any], name: str) -> int:
    found = values.get(name)
    if type(found) is not int or not 0 <= found < 1 << 31:
        raise ConfigError(f"{name}: expected a whole number")
    return found


def _text(values: dict[str, Any], name: str, default: str | None = None) -> str:
    found = values.get(name, default)
    if not isinstance(found, str) or len(found) > 2000:
        raise ConfigError(f"{name}: expected a text")
    return found


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.{PageActionTuning.digits}f}" for value in values)
