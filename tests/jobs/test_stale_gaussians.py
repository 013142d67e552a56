# SPDX-License-Identifier: Apache-2.0
"""What a visit that began in an earlier map looked through is not there any more."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.errors import SequenceError
from ggslam.jobs.changes.stale_gaussians import without_stale_gaussians
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.tracking.settings import DepthNoise

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
WALL_M = 2.0


def visit(
    points: list[list[float]], births: list[int], own: int, depth: np.ndarray, recording: bool = True,
    mask: np.ndarray | None = None,
) -> Any:  # fmt: skip
    """A run whose first keyframe is of an earlier map, with `own` more that look along z; and where its map is. All is
    of object 7."""
    gaussians, count = GaussianMap(0, 4), len(points)
    gaussians.insert(
        torch.tensor(points), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), -3.0),
        torch.zeros(count), torch.full((count, 3), 0.5),
    )  # fmt: skip
    gaussians.birth_keyframe[:] = torch.tensor(births, dtype=gaussians.birth_keyframe.dtype)
    gaussians.object_id[:] = 7
    color = np.zeros((30, 40, 3), np.uint8)
    frame = Frame(0, 0, 0.0, color, depth.astype(np.float32), CAMERA, mask=mask)
    source = SimpleNamespace(
        name="tuesday",
        record=SimpleNamespace(keyframes=[SimpleNamespace(frame=f) for f in (FROM_EARLIER_RUN, *range(own))]),
        sequence=SimpleNamespace(frame=lambda index, masks: frame) if recording else None,
        known=SimpleNamespace(noise=DepthNoise()), has_lasting_ids=lambda: mask is not None,
    )
    placed = SimpleNamespace(gaussians=gaussians, T_world_camera=np.tile(np.eye(4), (own + 1, 1, 1)))
    return source, placed


POINTS = [[0, 0, 1.0], [0.4, 0, 1.99], [0, 0, 2.5], [5, 0, 1.0], [0, 0, 1.2]]
"""Looked through; on the wall; behind it; outside; looked through, but the visit's own."""
BIRTHS = [0, 0, 0, 0, 1]


def test_what_the_earlier_map_shows_before_a_wall_goes() -> None:
    source, placed = visit(POINTS, BIRTHS, own=2, depth=np.full((30, 40), WALL_M))
    kept = without_stale_gaussians(source, placed, []).means.numpy()
    assert np.allclose(kept, np.array(POINTS[1:], np.float32)) and len(placed.gaussians) == len(POINTS)


def test_each_keyframe_looks_from_where_it_is() -> None:
    """Two metres beside the first, nothing of the earlier map is in view."""
    source, placed = visit(POINTS, BIRTHS, own=2, depth=np.full((30, 40), WALL_M))
    placed.T_world_camera[2, 0, 3] = -5.0
    assert len(without_stale_gaussians(source, placed, [])) == len(POINTS)


@pytest.mark.parametrize("case", ["one keyframe", "no depth", "an edge beside it", "no recording", "no earlier map"])
def test_what_is_not_surely_gone_stays(case: str) -> None:
    depth = np.full((30, 40), WALL_M)
    if case == "no depth":
        depth[:] = 0
    if case == "an edge beside it":
        depth[13:16, 21] = 1.0
    own = 1 if case == "one keyframe" else 2
    source, placed = visit(POINTS[:1], [0], own, depth, recording=case != "no recording")
    if case == "no earlier map":
        source.record.keyframes = source.record.keyframes[1:]
    notes: list[str] = []
    assert len(without_stale_gaussians(source, placed, notes)) == 1
    assert bool(notes) == (case == "no recording") and all("tuesday" in note for note in notes)


@pytest.mark.parametrize(
    ("shown", "wall_m", "expected"), [(29, WALL_M, 29), (7, WALL_M, 7), (0, WALL_M, 7), (29, 1.0, 7)]
)
def test_an_object_in_whose_place_own_masks_show_another_has_become_it(
    shown: int, wall_m: float, expected: int
) -> None:
    """Masks show another; itself; none; another in front of it."""
    mask, depth = np.full((30, 40), shown, np.uint16), np.full((30, 40), wall_m)
    source, placed = visit([[0, 0, 1.99], [0.1, 0, 2.0], [0, 0, 2.5]], [0, 0, 0], own=2, depth=depth, mask=mask)
    assert without_stale_gaussians(source, placed, []).object_id.tolist() == [expected] * 3
    assert placed.gaussians.object_id.tolist() == [7] * 3


@pytest.mark.parametrize(("elsewhere", "expected"), [(7, 7), (29, 29)])
def test_an_object_that_masks_show_elsewhere_moved_and_keeps_what_the_visit_made_of_it(
    elsewhere: int, expected: int
) -> None:
    """Where it stood is another thing now. If masks show it nowhere, the visit's own Gaussians only learned its id."""
    mask = np.full((30, 40), 29, np.uint16)
    mask[20:23, 20:23] = elsewhere
    points, births = [[0, 0, 1.99], [0.1, 0, 2.0], [0.1, 0.45, 2.0]], [0, 0, 1]
    source, placed = visit(points, births, own=2, depth=np.full((30, 40), WALL_M), mask=mask)
    assert without_stale_gaussians(source, placed, []).object_id.tolist() == [29, 29, expected]


def test_frames_that_cannot_be_read_are_left_out_and_named() -> None:
    source, placed = visit(POINTS, BIRTHS, own=3, depth=np.full((30, 40), WALL_M))
    whole, notes = source.sequence.frame, list[str]()

    def frame(index: int, masks: bool) -> Frame:
        if index == 1:
            raise SequenceError("depth/000001.png: ends too early")
        return whole(index, masks)

    source.sequence.frame = frame
    assert len(without_stale_gaussians(source, placed, notes)) == len(POINTS) - 1
    assert notes == ["tuesday: left out: depth/000001.png: ends too early"]
