# SPDX-License-Identifier: Apache-2.0
"""What moves is found, whole, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.movers.detector import MoverDetector
from ggslam.movers.settings import MoverSettings
from ggslam.movers.trail import Trail, gone_since
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, compare

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
WALL, BOX = 3.0, 1.5
CONTEXT = NativeContext(2)
NOISE = 0.002


def pose(n: int) -> np.ndarray:
    """The camera goes to the right, a centimetre a frame."""
    T = np.eye(4)
    T[0, 3] = 0.01 * n
    return T


def frame(
    n: int, box_at: float | None, seed: int | None = None, ids: bool = False, distance: float = BOX
) -> Frame:  # fmt: skip
    """A wall, and 1.5 m away (`distance`) the front of a box 0.4 m wide; its middle is at `box_at` (world x)."""
    depth = np.full((240, 320), WALL, np.float32)
    mask = np.ones((240, 320), np.uint16)
    if box_at is not None:
        x = (np.arange(320) - CAMERA.cx) / CAMERA.fx * distance + 0.01 * n
        columns, half = np.abs(x - box_at) < 0.2, round(40 * BOX / distance)
        rows = slice(120 - half, 120 + half)
        depth[rows, columns], mask[rows, columns] = distance, 7
    if seed is not None:
        depth += np.random.default_rng(1000 * seed + n).normal(0, NOISE, depth.shape).astype(np.float32)
    color = np.zeros((240, 320, 3), np.uint8)
    return Frame(n, n, n / 30, color, depth, CAMERA, mask if ids else None)


margin = Margin(0.004, 0.0, 5.0, NOISE)


def look_at(boxes: list[float | None], seed: int | None = 0, ids: bool = False) -> list[np.ndarray | None]:
    """The masks of frames in which a box is here and there."""
    detector, found = MoverDetector(MoverSettings(enabled=True)), []
    for n, at in enumerate(boxes):
        detector.look(frame(n, at, seed, ids), pose(n), margin, CONTEXT)
        found.append(detector.mask)
    return found


def overlap(mask: np.ndarray | None, wanted: np.ndarray) -> float:
    assert mask is not None
    return float((mask & wanted).sum() / (mask | wanted).sum())


@pytest.mark.parametrize("ids", [False, True])
def test_a_box_that_comes_in_is_found_whole(ids: bool) -> None:
    boxes = [None] * 24 + [-0.4 + 0.03 * n for n in range(12)]
    found = look_at(boxes, ids=ids)
    assert all(mask is None for mask in found[:25])
    for n in range(26, 36):
        assert overlap(found[n], frame(n, boxes[n]).depth < 2) > 0.8


@pytest.mark.parametrize("ids", [False, True])
def test_nothing_is_found_where_only_the_camera_moves(ids: bool) -> None:
    assert all(mask is None for mask in look_at([0.1] * 30, ids=ids))


def test_a_box_that_was_there_and_begins_to_move_is_found_by_its_segment() -> None:
    boxes: list[float | None] = [0.0] * 10 + [0.01 * n for n in range(20)]
    found = look_at(boxes, ids=True)
    assert all(mask is None for mask in found[:11])
    first = next(n for n, mask in enumerate(found) if mask is not None)
    assert first <= 20  # 10 cm
    assert overlap(found[first], frame(first, boxes[first]).depth < 2) > 0.8


def test_what_has_come_to_rest_is_no_mover_any_more() -> None:
    boxes: list[float | None] = [None] * 6 + [-0.6 + 0.05 * n for n in range(10)] + [-0.15] * 14
    found = look_at(boxes)
    assert found[15] is not None
    assert all(mask is None for mask in found[-4:])


def test_a_mover_goes_on_though_frames_before_saw_it_all_about() -> None:
    """It goes to and fro, then straight away from the camera: where it is then, nobody ever looked past."""
    detector, found = MoverDetector(MoverSettings(enabled=True)), []
    to_and_fro = [0.0] * 50 + [0.03 * min(n, 12 - n) for n in range(13)]
    places = [(at, BOX) for at in to_and_fro] + [(0.0, BOX + 0.02 * n) for n in range(1, 30)]
    for n, (at, distance) in enumerate(places):
        detector.look(frame(n, at, 0, True, distance), pose(n), margin, CONTEXT)
        found.append(detector.mask)
    assert all(mask is None for mask in found[:51])
    assert all(mask is not None for mask in found[58:])
    for _ in range(10):
        n += 1
        detector.look(frame(n, at, 0, True, distance), pose(n), margin, CONTEXT)
    assert detector.mask is None  # at rest


def test_a_lost_frame_breaks_the_row() -> None:
    detector = MoverDetector(MoverSettings(enabled=True))
    for n in range(6):
        detector.look(frame(n, None), pose(n), margin, CONTEXT)
    detector.look(frame(6, 0.0), None, margin, CONTEXT)
    detector.look(frame(7, 0.0), pose(7), margin, CONTEXT)
    assert detector.mask is None and len(detector.views) == 1


def test_the_next_frame_is_located_without_the_mover() -> None:
    detector = MoverDetector(MoverSettings(enabled=True))
    for n, at in enumerate([None] * 6 + [-0.3, -0.27, -0.24]):
        detector.look(frame(n, at), pose(n), margin, CONTEXT)
    following = frame(9, -0.21)
    assert not detector.expect(following).depth[following.depth < 2].any()
    now = frame(8, -0.24)
    cleaned = detector.clean(now)
    assert cleaned.moving is not None and not cleaned.depth[cleaned.moving].any()
    assert (cleaned.depth[~cleaned.moving] == now.depth[~cleaned.moving]).all()


def test_a_wrong_pose_is_no_mover_as_large_as_the_image() -> None:
    detector = MoverDetector(MoverSettings(enabled=True))
    for n in range(8):
        T = pose(n)
        T[2, 3] = -0.5 if n > 5 else 0.0  # the wall seems to have come nearer
        detector.look(frame(n, None), T, margin, CONTEXT)
        assert detector.mask is None


def test_evidence_says_what_was_passed_and_what_was_there() -> None:
    before, now = frame(0, None), frame(1, 0.0)
    views = [CoarseView.of(f.depth, CAMERA, 3, pose(f.index), margin, CONTEXT) for f in (before, now)]
    found, box = compare(views[1], [views[0]], margin, CONTEXT)[0], views[1].depth < 2
    assert found.passed[box].all() and not found.passed[~box].any()
    assert not found.same[box].any() and found.same[~box].mean() > 0.9


def test_depth_next_to_holes_says_nothing() -> None:
    before, now = frame(0, None), frame(1, 0.0)
    depth = before.depth.copy()
    depth[::2, ::2] = 0
    views = [CoarseView.of(d, CAMERA, 3, pose(i), margin, CONTEXT) for i, d in enumerate((depth, now.depth))]
    assert not compare(views[1], [views[0]], margin, CONTEXT)[0].passed.any()


@pytest.mark.parametrize("ids", [False, True])
def test_what_an_earlier_view_shows_at_the_trail_is_gone(ids: bool) -> None:
    settings, trail = MoverSettings(enabled=True), Trail()
    before, now = frame(0, 0.0, ids=ids), frame(20, None)
    old, new = (CoarseView.of(f.depth, CAMERA, 3, pose(f.index), margin, CONTEXT) for f in (before, now))
    (evidence,) = compare(old, [new], margin, CONTEXT)
    nothing = gone_since(old, evidence, trail, before.mask, (240, 320), 3, settings)
    assert nothing is None  # nothing has moved
    trail.add(old, (old.depth < 2))
    gone = gone_since(old, evidence, trail, before.mask, (240, 320), 3, settings)
    assert overlap(gone, before.depth < 2) > 0.8
    still = replace(now, depth=frame(20, 0.0).depth)
    there = CoarseView.of(still.depth, CAMERA, 3, pose(20), margin, CONTEXT)
    (evidence,) = compare(old, [there], margin, CONTEXT)
    assert gone_since(old, evidence, trail, before.mask, (240, 320), 3, settings) is None


KINECT = Margin(0.004, 0.0, 5.0, 0.008)


def noisy(n: int, step: float, shared: bool) -> Frame:
    """A wall in 8 mm of noise, a board on it that has come nearer by `step`; noise of pixels, or of 12 x 12 each."""
    clean = np.full((240, 320), 2.0, np.float32)
    columns = np.abs((np.arange(320) - CAMERA.cx) / CAMERA.fx * 2 + 0.01 * n) < 0.2
    clean[80:160, columns] -= step
    rng = np.random.default_rng(n)
    spread = (
        np.kron(rng.normal(0, 0.008, (20, 27)), np.ones((12, 12)))[:, :320]
        if shared
        else rng.normal(0, 0.008, (240, 320))
    )
    mask = np.where(clean < 2.0 if step else False, 7, 1).astype(np.uint16)
    return Frame(n, n, n / 30, np.zeros((240, 320, 3), np.uint8), clean + spread.astype(np.float32), CAMERA, mask)


def look_in_noise(steps: list[float], shared: bool = False) -> list[np.ndarray | None]:
    detector, found = MoverDetector(MoverSettings()), []
    for n, step in enumerate(steps):
        detector.look(noisy(n, step, shared), pose(n), KINECT, CONTEXT)
        found.append(detector.mask)
    return found


def test_a_few_centimetres_are_found_in_a_kinects_noise() -> None:
    found = look_in_noise([0.0] * 8 + [0.003 * n for n in range(1, 13)])
    assert all(mask is None for mask in found[:9])
    first = next(n for n, mask in enumerate(found) if mask is not None)
    assert 0.003 * (first - 7) <= 0.03
    board = noisy(19, 0.036, False).mask
    assert board is not None and overlap(found[19], board == 7) > 0.8


@pytest.mark.parametrize("shared", [False, True])
def test_noise_is_no_mover_whether_pixels_share_it_or_not(shared: bool) -> None:
    assert all(mask is None for mask in look_in_noise([0.0] * 40, shared))
    assert all(mask is None for mask in look_in_noise([0.05] * 40, shared))


def test_a_person_entering_is_left_out_of_tracking_before_they_are_believed() -> None:
    detector = MoverDetector(MoverSettings())
    for n, at in enumerate([None] * 6 + [-0.3]):
        detector.look(frame(n, at), pose(n), margin, CONTEXT)
    following = frame(7, -0.29)
    assert detector.mask is None and not detector.expect(following).depth[following.depth < 2].any()


def test_what_was_seen_once_is_not_expected_where_the_image_shifts_far() -> None:
    """At 60 pixels a frame it will be elsewhere; what is believed is left out as before."""
    def far(n: int) -> np.ndarray:
        return pose(30 * n)

    detector, left_out = MoverDetector(MoverSettings()), []
    for n, at in enumerate([None] * 3 + [0.9, 1.2, 1.5]):
        detector.look(frame(30 * n, at), far(n), margin, CONTEXT)
        left_out.append(bool(detector.found is not None and detector.expected is None))
    assert left_out[3] and detector.mask is not None and detector.expected is not None


def test_what_one_clear_look_passed_is_found_though_the_rest_was_not_seen_before() -> None:
    """The camera turns: of a tall thing at the side most lies where no frame before it looked."""
    detector = MoverDetector(MoverSettings())
    for n in range(7):
        seen = frame(n, 0.0 if n > 5 else None, ids=True)
        depth = seen.depth.copy()
        if n <= 5:
            depth[93:] = 0
        detector.look(replace(seen, depth=depth), pose(n), margin, CONTEXT)
    assert detector.found is not None and detector.found[40:50, 45:60].all()
