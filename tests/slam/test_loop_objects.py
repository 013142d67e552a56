# SPDX-License-Identifier: Apache-2.0
"""Objects that a camera maps when it leaves and again when it comes back are one once the loop is closed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from drifting_camera import walk_with_drift

from ggslam.loops.activity import ActivitySettings
from ggslam.loops.settings import GraphSettings, VerificationSettings
from ggslam.objects.same_object import LabelledVoxels
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.object_masks import MaskSettings, ObjectMasks
from ggslam.slam.slam import Slam


def cube(corner: float) -> np.ndarray:
    axis = np.arange(0.01, 0.4, 0.02)
    return np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) + corner


def voxels(things: dict[int, np.ndarray]) -> LabelledVoxels:
    means = np.concatenate(list(things.values()))
    labels = np.concatenate([np.full(len(points), i, np.int64) for i, points in things.items()])
    return LabelledVoxels.of(means, labels, np.ones(len(means)), 0.04)


def test_the_older_end_keeps_its_ids_and_what_is_there_already_is_not_dropped() -> None:
    masks = ObjectMasks(MaskSettings(source="geometry"), False)
    older, newer = voxels({1: cube(0), 2: cube(1)}), voxels({7: cube(0), 8: cube(2)})
    assert masks.unite(older, newer) == [(1, 7)]
    assert masks.unite(older, voxels({2: cube(0)})) == []  # object 2 stands elsewhere at the older end


def test_masks_with_ids_of_their_own_are_left_alone() -> None:
    masks = ObjectMasks(MaskSettings(source="recording"), True)
    assert masks.unite(voxels({1: cube(0)}), voxels({7: cube(0)})) == []


def drifting(frames: list[Frame]) -> Slam:
    """A camera goes through the room and back again, tracked with drift of 60 cm, and closes its loop; the ids of
    masks are not believed."""
    settings = ["mapping.iterations_per_frame=1", "masks.association.mode=always", "masks.source=recording"]
    activity = ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0)
    loops = LoopSettings(
        activity=activity, graph=GraphSettings(translation_drift=0.2, rotation_drift_deg=3),
        verification=VerificationSettings(min_cells_alike=5),  # it closes late: by then there are double objects
    )  # fmt: skip
    config = dataclasses.replace(load_config(None, settings), loops=loops)
    slam = Slam(frames[0].camera, config, has_masks=True)
    walk_with_drift(slam, frames, np.array([0.5, 0.2, -0.3, 0.0, np.radians(8), 0.0]))
    return slam


@pytest.mark.long("24 keyframes of a generated room, there and back")
def test_objects_on_both_sides_of_a_closed_loop_become_one(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unite, united = ObjectMasks.unite, list[tuple[int, int]]()

    def watched(masks: ObjectMasks, older: LabelledVoxels, newer: LabelledVoxels) -> list[tuple[int, int]]:
        united.extend(unite(masks, older, newer))
        return united

    monkeypatch.setattr(ObjectMasks, "unite", watched)
    slam = drifting(list(open_sequence(room).stream()))
    assert slam.loops is not None and any(event.kind == "closed" for event in slam.loops.events)
    assert united and slam.mapper.identity is not None
    left = set(np.unique(slam.mapper.vote_labels()).tolist())
    for kept, dropped in united:
        assert dropped not in left and slam.mapper.identity.current(np.array([dropped]))[0] == kept
