# SPDX-License-Identifier: Apache-2.0
"""A drawer that opens: where one is painted on the front of a chest, it comes out."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import translation
from ggslam.synthetic.changes import fill, outline
from ggslam.synthetic.motion import Mover, Setting, sample_window
from ggslam.synthetic.scene import Kind, Shape
from ggslam.system.tuning import Tuning

_CHESTS = {"sideboard": (3, 2), "television stand": (3, 2), "desk": (1, 3)}
"""Columns and rows of the drawers on their fronts."""
_FRONT: Final = 2
"""Number of a box's face -y."""


class DrawerTuning(Tuning):
    """What a drawer looks like, and when it opens."""

    margin_m = 0.01
    """Distance between the outlines of a drawer and of its painted field, in metres."""
    board_m = 0.012
    """Thickness of its boards, in metres."""
    windows = 8
    """Times of opening that are tried."""


_AWAY = np.array([0.0, 0.0, -60.0])


def opened_drawer(setting: Setting) -> Mover:
    """The drawer that the camera sees best of those with room before them.

    Closed it is the painted front itself, so that a recording without movers looks the same.

    Raises:
        SequenceError: the camera sees none that can open.
    """
    rng = np.random.default_rng([setting.seed, 11, 2])
    windows = [sample_window(rng, setting.frames) for _ in range(DrawerTuning.windows)]
    opening = rng.uniform(0.22, 0.32)
    names = setting.scene.instance_names
    best, most, progress = None, 0.0, windows[0]
    for chest in setting.scene.shapes:
        grid = _CHESTS.get(names.get(chest.instance, ""))
        if grid is None or _FRONT not in chest.faces:
            continue
        for cell in range(grid[0] * grid[1]):
            panel = _panel(chest, grid, cell)
            if not _has_room(setting, chest, panel, opening):
                continue
            for window in windows:
                seen = _share_seen(setting, panel, window, opening)
                if seen > most:
                    best, most, progress = (chest, panel), seen, window
    if best is None:
        raise SequenceError("movers: the camera sees no drawer that can open")
    chest, panel = best
    number = setting.new_instance(f"{names[chest.instance]} drawer")
    parts = [replace(shape, instance=number) for shape in _boards(chest, panel)]
    outward = chest.T_world_shape[:3, 1] * -1.0
    motion = translation((progress * opening)[:, None] * outward)
    closed = np.array([shape.T_world_shape for shape in parts])
    tracks = motion[:, None] @ closed
    tracks[progress == 0] = translation(_AWAY) @ closed  # its front is the painted one
    lit = [replace(shape, T_world_shape=motion[-1] @ shape.T_world_shape) for shape in parts]
    numbers = setting.add_shapes(lit)
    what = f"a drawer of the {names[chest.instance]}, opened by nothing visible"
    own = motion @ panel.T_world_shape
    return Mover(names[number], what, number, True, own, numbers, tracks, {}, panel, progress == 0)


def _panel(chest: Shape, grid: tuple[int, int], cell: int) -> Shape:
    """Front board of one of the drawers, flush with the front of its chest, with its part of the picture."""
    (columns, rows), (x, y, z) = grid, chest.half
    column, row = cell % columns, cell // columns
    half = (x / columns - DrawerTuning.margin_m, DrawerTuning.board_m, z / rows - DrawerTuning.margin_m)
    middle = np.array([x * ((2 * column + 1) / columns - 1), -y + DrawerTuning.board_m, z * (1 - (2 * row + 1) / rows)])
    front = chest.faces[_FRONT]
    height, width = front.image.shape[:2]
    left, right = (round((s * h + middle[0] + x) / (2 * x) * width) for s, h in ((-1, half[0]), (1, half[0])))
    top, bottom = (round((z - middle[2] + s * h) / (2 * z) * height) for s, h in ((-1, half[2]), (1, half[2])))
    crop = replace(front, image=np.ascontiguousarray(front.image[top:bottom, left:right]))
    pose = chest.T_world_shape @ translation(middle)
    return Shape(Kind.BOX, half, pose, chest.material, chest.instance, {_FRONT: crop}, casts_shadow=False)


def _boards(chest: Shape, panel: Shape) -> list[Shape]:
    """A drawer: its front, two sides, and what lies in it."""
    (x, _, z), depth, wood = panel.half, chest.half[1] * 0.9, chest.material
    back = 2 * depth - DrawerTuning.board_m
    boards = [((-x + 2 * DrawerTuning.board_m, depth, -0.1 * z), (DrawerTuning.board_m, depth, 0.9 * z)),
              ((x - 2 * DrawerTuning.board_m, depth, -0.1 * z), (DrawerTuning.board_m, depth, 0.9 * z))]  # fmt: skip
    inside = ((0.0, back / 2, -0.3 * z), (x - 3 * DrawerTuning.board_m, back / 2, 0.6 * z))
    made = [panel]
    for middle, half in (*boards, inside):
        pose = panel.T_world_shape @ translation(np.array(middle))
        made.append(Shape(Kind.BOX, half, pose, wood, chest.instance, casts_shadow=False))
    return made


def _share_seen(setting: Setting, panel: Shape, progress: np.ndarray, opening: float) -> float:
    """Of nine points of a front that comes out, the share that the camera sees."""
    x, y, z = panel.half
    grid = np.stack(np.meshgrid([-0.8 * x, 0, 0.8 * x], [-y], [-0.8 * z, 0, 0.8 * z]), -1).reshape(-1, 3)
    points = grid @ panel.T_world_shape[:3, :3].T + panel.T_world_shape[:3, 3]
    outward = -panel.T_world_shape[:3, 1]
    return setting.views.share_seen(points + (progress * opening)[:, None, None] * outward, progress)


def _has_room(setting: Setting, chest: Shape, panel: Shape, opening: float) -> bool:
    outward = -chest.T_world_shape[:3, 1]
    closed = outline(panel)
    swept = fill(np.concatenate([closed + 0.03 * outward, closed + (opening + 0.05) * outward]))
    others = (s for s in setting.scene.shapes if s.instance != chest.instance)
    return all((shape.distance(swept) > 0).all() for shape in others)
