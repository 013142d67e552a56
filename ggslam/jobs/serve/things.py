# SPDX-License-Identifier: Apache-2.0
"""Objects, movers and changes as boxes with names."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from ggslam.jobs.serve.channels import MAP
from ggslam.messages.contents import Thing, Things
from ggslam.movers.mover_table import MoverSight
from ggslam.objects.boxes import oriented_box
from ggslam.objects.table import ObjectTable
from ggslam.runs.records.changes import ChangeRecord
from ggslam.runs.records.movers import MoverRecord, mover_colors
from ggslam.scene.id_colors import id_palette
from ggslam.scene.oriented_box import OrientedBox
from ggslam.system.tuning import Tuning

Color = tuple[int, int, int]


class ThingTuning(Tuning):
    """What counts as a thing while a map grows."""

    min_gaussians = 30
    """Fewest Gaussians of an object."""
    velocity_s = 0.5
    """Seconds over which a velocity is measured, about."""
    longest_gap_s = 2.0
    """Seconds without a sight after which a mover's velocity is not known."""


def pose_of_box(box: OrientedBox) -> np.ndarray:
    """T_world_box, float64 [4, 4]: its origin in the middle, x along the first of its axes."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(box.axes).T, box.center
    return T


def known_objects(table: ObjectTable) -> Things:
    """Those of a finished run."""
    return Things(MAP, tuple(
        Thing(o.id, o.name or "", pose_of_box(o.box), np.array(o.box.size), o.color,
              1.0 if o.confidence is None else o.confidence) for o in table.objects
    ))  # fmt: skip


def growing_objects(means: np.ndarray, ids: np.ndarray) -> Things:
    """Those that the Gaussians on surfaces belong to by now; they have no names yet.

    Args:
        means: [N, 3], metres.
        ids: [N], object of each, 0: none.
    """
    if not len(ids):
        return Things(MAP, ())
    order = np.argsort(ids, kind="stable")
    found, starts = np.unique(ids[order], return_index=True)
    things = []
    for number, rows in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        if number and len(rows) >= ThingTuning.min_gaussians:
            box = oriented_box(means[rows])
            things.append(Thing(number, "", pose_of_box(box), np.array(box.size), _color(number)))
    return Things(MAP, tuple(things))


def known_movers(movers: Iterable[MoverRecord], times: Mapping[int, float]) -> Things:
    """Where each mover of a finished run was last, and how fast; `times` of frames by index, seconds."""
    listed = list(movers)
    colors, things = mover_colors(listed), []
    for mover in listed:
        last = mover.after or mover.frames[-1]
        T = last.T_world_mover.copy()
        T[:3, 3] = last.corners().mean(axis=0)
        velocity = np.zeros(3) if mover.after is not None else _velocity(
            [(times[f.frame], f.corners().mean(axis=0)) for f in mover.frames if f.frame in times]
        )  # fmt: skip
        size = np.asarray(last.box_max) - np.asarray(last.box_min)
        things.append(Thing(mover.id, mover.title, T, size, colors[mover.id], 1.0, velocity, mover.kind))
    return Things(MAP, tuple(things))


def known_changes(changes: Iterable[tuple[ChangeRecord, str]]) -> Things:
    """Changes between two visits, each with a sentence: at the place that it has now, else that it had."""
    things = []
    for number, (change, sentence) in enumerate(changes, 1):
        side = change.new if change.new is not None and change.new.box is not None else change.old
        if side is None or side.box is None:
            continue
        things.append(Thing(number, change.name, pose_of_box(side.box), np.array(side.box.size), _color(number),
                            change.confidence, note=sentence))  # fmt: skip
    return Things(MAP, tuple(things))


class MoversNow:
    """Follows the movers of a run that goes on."""

    def __init__(self) -> None:
        self._ways: dict[int, deque[tuple[float, np.ndarray]]] = {}

    def step(self, seen: Mapping[int, MoverSight], frame: int, stamp: float, T_map_optical: np.ndarray) -> Things:
        """What moves in a frame.

        Args:
            seen: the latest sight of each mover, by its number.
            frame: its index; sights of other frames are old.
            stamp: its time, seconds.
            T_map_optical: pose of the camera, [4, 4].
        """
        things = []
        for number, sight in seen.items():
            if sight.frame != frame:
                continue
            middle = np.eye(4)
            middle[:3, 3] = (np.asarray(sight.low) + np.asarray(sight.high)) / 2
            T = T_map_optical @ sight.T_camera_mover @ middle
            way = self._ways.setdefault(number, deque())
            while way and not 0 < stamp - way[-1][0] <= ThingTuning.longest_gap_s:
                way.clear()
            way.append((stamp, T[:3, 3].copy()))
            while len(way) > 2 and stamp - way[1][0] >= ThingTuning.velocity_s:
                way.popleft()
            size = np.asarray(sight.high) - np.asarray(sight.low)
            things.append(Thing(number, f"mover {number}", T, size, _color(number), 1.0, _velocity(list(way))))
        return Things(MAP, tuple(things))


def _velocity(way: list[tuple[float, np.ndarray]]) -> np.ndarray | None:
    """Of places with their times, m/s: over the last `ThingTuning.velocity_s`; None: not known."""
    recent = [one for one in way if way[-1][0] - one[0] <= 1.5 * ThingTuning.velocity_s]
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return None
    return np.asarray((recent[-1][1] - recent[0][1]) / (recent[-1][0] - recent[0][0]))


def _color(number: int) -> Color:
    red, green, blue = id_palette()[number].tolist()
    return red, green, blue
