# SPDX-License-Identifier: Apache-2.0
"""Edits of selections, as people write them."""

from __future__ import annotations

import json

import numpy as np

from ggslam.errors import ConfigError
from ggslam.jobs.edit.edit import OF_SELECTIONS, Edit
from ggslam.jobs.edit.vectors import read_vector
from ggslam.objects.editing import Change
from ggslam.objects.recoloring import parse_color
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import copies_of
from ggslam.objects.selection import ScreenShape, parse_selection
from ggslam.objects.splat_editing import (
    assign_gaussians,
    keep_gaussians,
    move_gaussians,
    recolor_gaussians,
    remove_gaussians,
)
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians
from ggslam.scene.camera import Camera


def selected_rows(scene: SegmentedMap, selection: str) -> np.ndarray:
    """The Gaussians of a selection, bool [N].

    Raises:
        ConfigError: it is no selection.
    """
    g = scene.gaussians
    owners = g.object_id.numpy()

    def depth_of(screen: ScreenShape) -> np.ndarray:
        shown = copies_of(g, ~np.isin(owners, list(screen.hidden))) if screen.hidden else g
        return depth_of_screen(shown, screen)

    return parse_selection(selection).rows(g.means.numpy(), owners, depth_of)


def depth_of_screen(gaussians: Gaussians, screen: ScreenShape) -> np.ndarray:
    """Depth of the surfaces that a screen shows, float32 [h, w] of its mask's size, metres; 0 where more than half of
    the light passes."""
    h, w = screen.mask.shape
    fx, fy = screen.focal * w / screen.width, screen.focal * h / screen.height
    camera = Camera(w, h, fx, fy, (w - 1) / 2, (h - 1) / 2)
    view = CpuRasterizer().forward(gaussians, camera, screen.T_camera_world, features=False)
    return np.where(view.alpha.numpy() > 0.5, view.expected_depth.numpy(), 0.0).astype(np.float32)


def apply_to_selection(scene: SegmentedMap, edit: Edit) -> Change:
    """Does one edit of a selection to a map.

    Raises:
        ConfigError: nothing is selected, unknown objects, or values that cannot be read.
    """
    if edit.kind not in OF_SELECTIONS:
        raise ConfigError(f"`{edit.kind}`: is for objects; selections can be edited by {', '.join(OF_SELECTIONS)}")
    rows = selected_rows(scene, edit.selection)
    if edit.kind == "remove":
        return remove_gaussians(scene, rows)
    if edit.kind == "keep":
        return keep_gaussians(scene, rows)
    if edit.kind == "move":
        turn = read_vector("rotation", edit.rotation) if edit.rotation else (0.0, 0.0, 0.0)
        return move_gaussians(scene, rows, read_vector("move", edit.value), turn)
    if edit.kind == "recolor":
        return recolor_gaussians(scene, rows, parse_color(edit.value))
    return assign_gaussians(scene, rows, _object_of(scene, edit.objects), edit.value)


def _object_of(scene: SegmentedMap, words: str) -> int | None:
    """An id; 0: none; None: a new one."""
    if words.strip().casefold() in ("new", "none"):
        return None if words.strip().casefold() == "new" else 0
    ids = scene.table.select(words)
    if len(ids) != 1:
        raise ConfigError(f"`assign`: expected one object, found {len(ids)}")
    return ids[0]


def box_selection(text: str) -> str:
    """The selection of a box along the world's axes, from a text like "x y z sx sy sz": middle and size in metres.

    Raises:
        ConfigError: expected six numbers, the last three positive.
    """
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not np.isfinite(numbers).all() or min(numbers[3:]) <= 0:
        raise ConfigError(f'`crop`: expected middle and size of a box like "0 0 2 1 1 1", found {text!r}')
    shape = {"kind": "box", "center": numbers[:3], "axes": np.eye(3).tolist(), "size": numbers[3:]}
    return json.dumps([{"mode": "set", "shape": shape}])
