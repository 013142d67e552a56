# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from simulated_map import LabelledVoxels, assigned_iou, scramble

from ggslam.errors import ConfigError
from ggslam.objects.association import Association, Associator, MapView
from ggslam.objects.evidence import PairEvidence
from ggslam.objects.overlap import SegmentOverlap
from ggslam.objects.segments import clean_segments
from ggslam.objects.settings import AssociationSettings
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence

ALWAYS = AssociationSettings(mode="always")
SHAPE = (120, 160)
DEPTH = np.full(SHAPE, 2.0, np.float32)
TABLE, MUG, WALL = np.s_[60:], np.s_[70:80, 50:58], np.s_[:60]


def scene(wall: int, table: int, mug: int) -> np.ndarray:
    ids = np.zeros(SHAPE, np.uint16)
    ids[WALL], ids[TABLE], ids[MUG] = wall, table, mug
    return ids


def shown(ids: np.ndarray, depth: np.ndarray = DEPTH) -> MapView:
    """A map that shows exactly `ids`."""
    return MapView(ids, np.where(ids > 0, 1, 0).astype(np.float32), depth)


def started(ids: np.ndarray, settings: AssociationSettings = ALWAYS) -> Associator:
    associator = Associator(settings)
    associator.associate(ids, None, DEPTH)
    return associator


def test_first_keyframe_keeps_raw_ids() -> None:
    result = Associator().associate(scene(5, 700, 9), None, DEPTH)
    np.testing.assert_array_equal(result.ids, scene(5, 700, 9))
    assert sorted(result.created) == [5, 9, 700]
    assert result.merges == []


def test_new_ids_in_every_frame_find_their_objects() -> None:
    associator = started(scene(1, 2, 3))
    for frame in range(5):
        raw = scene(10 + 3 * frame, 11 + 3 * frame, 12 + 3 * frame)
        result = associator.associate(raw, shown(scene(1, 2, 3)), DEPTH)
        np.testing.assert_array_equal(result.ids, scene(1, 2, 3))
        assert result.created == []


def test_ids_swapped_between_objects_are_put_right() -> None:
    result = started(scene(1, 2, 3)).associate(scene(2, 3, 1), shown(scene(1, 2, 3)), DEPTH)
    np.testing.assert_array_equal(result.ids, scene(1, 2, 3))


def test_pieces_of_one_object_both_go_to_it() -> None:
    raw = scene(20, 30, 40)
    raw[:60, 80:] = 21
    result = started(scene(1, 2, 3)).associate(raw, shown(scene(1, 2, 3)), DEPTH)
    np.testing.assert_array_equal(result.ids, scene(1, 2, 3))


def test_a_new_object_takes_its_raw_id_if_no_other_had_it_else_the_next_free() -> None:
    known = scene(1, 1, 1)
    known[MUG] = 0
    result = started(known).associate(scene(8, 8, 2), shown(known), DEPTH)
    assert result.ids[75, 54] == 2 and result.created == [2]
    result = started(known).associate(scene(8, 8, 1), shown(known), DEPTH)
    assert result.ids[75, 54] == 2 and result.created == [2]


def test_reserved_ids_are_not_given_away() -> None:
    known = scene(1, 1, 0)
    associator = Associator(ALWAYS, reserved=[2, 3])
    associator.associate(known, None, DEPTH)
    assert associator.associate(scene(8, 8, 1), shown(known), DEPTH).ids[75, 54] == 4


def test_another_surface_in_front_is_a_new_object() -> None:
    """The mug was set down where the map shows table: geometry does not agree."""
    known = scene(1, 2, 2)
    depth = DEPTH.copy()
    depth[MUG] = 1.8
    result = started(known).associate(scene(11, 12, 13), shown(known), depth)
    assert result.created == [13]
    np.testing.assert_array_equal(result.ids, scene(1, 2, 13))


def test_unlabelled_pixels_stay_so() -> None:
    raw = scene(4, 0, 6)
    result = started(scene(1, 2, 3)).associate(raw, shown(scene(1, 2, 3)), DEPTH)
    np.testing.assert_array_equal(result.ids, scene(1, 0, 3))


def test_new_ground_extends_what_it_continues() -> None:
    known = np.zeros(SHAPE, np.uint16)
    known[:, :20] = 6
    result = started(known).associate(np.full(SHAPE, 17, np.uint16), shown(known), DEPTH)
    assert (result.ids == 6).all()


def test_a_mug_whose_rim_shows_the_table_is_not_the_tables() -> None:
    view = scene(1, 2, 3)
    view[70:76, 50:58] = 2  # the map has most of the mug wrong
    result = started(scene(1, 2, 3)).associate(scene(11, 12, 13), shown(view), DEPTH)
    np.testing.assert_array_equal(result.ids, scene(1, 2, 3))


def test_one_segment_over_two_objects_merges_nothing_and_leaves_the_maps_labels() -> None:
    associator = started(scene(1, 2, 3))
    for _ in range(6):
        associator.associate(scene(11, 12, 13), shown(scene(1, 2, 3)), DEPTH)
    for _ in range(5):
        result = associator.associate(scene(11, 12, 12), shown(scene(1, 2, 3)), DEPTH)
        np.testing.assert_array_equal(result.ids, scene(1, 2, 3))
        assert result.merges == []


def test_an_object_born_in_two_halves_becomes_one() -> None:
    born = scene(1, 2, 3)
    born[:60, 90:] = 4
    associator = started(born)
    merges: list[tuple[int, int]] = []
    for _ in range(4):
        result = associator.associate(scene(31, 32, 33), shown(born), DEPTH)
        merges += result.merges
    assert merges == [(1, 4)]  # the larger half keeps its id
    np.testing.assert_array_equal(result.ids, scene(1, 2, 3))
    # A map that has not caught up yet does not bring the dropped id back.
    later = associator.associate(scene(41, 42, 43), shown(born), DEPTH)
    np.testing.assert_array_equal(later.ids, scene(1, 2, 3))


def test_fewer_observations_than_asked_for_merge_nothing() -> None:
    born = scene(1, 2, 3)
    born[:60, 90:] = 4
    associator = started(born, AssociationSettings(mode="always", merge_observations=50))
    assert not any(associator.associate(scene(31, 32, 33), shown(born), DEPTH).merges for _ in range(8))


def test_a_segment_across_many_pieces_counts_once_a_keyframe() -> None:
    """Two pieces become one in the third keyframe; the third piece lay with both of them in the first two only."""
    evidence = PairEvidence(ALWAYS)
    pieces, pixel = np.array([1, 2, 3], np.uint16), np.zeros(1, np.int32)
    across = SegmentOverlap(np.array([9], np.uint16), pieces, np.array([[30, 20, 10]]), np.array([60]), pixel, pixel)
    two = SegmentOverlap(np.array([9], np.uint16), pieces[:2], np.array([[30, 20]]), np.array([50]), pixel, pixel)
    for overlap, expected in ((across, []), (across, []), (two, [(1, 2)]), (across, [(1, 3)])):
        evidence.observe(overlap, set())
        assert evidence.merges() == expected


CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def test_a_part_that_comes_back_at_its_place_becomes_an_object() -> None:
    known = scene(1, 2, 2)  # the mug was in the table's segment when both were first seen
    associator = started(known)
    results = [
        associator.associate(scene(11, 12, 13), shown(known), DEPTH, CAMERA, np.eye(4)) for _ in range(4)
    ]  # fmt: skip
    np.testing.assert_array_equal(results[0].ids, known)
    np.testing.assert_array_equal(results[3].ids, scene(1, 2, 13))
    assert [r.created for r in results].count([13]) == 1
    assert results[3].splits == [(2, 13)]


def test_what_made_a_part_an_object_counts_when_it_lies_with_the_rest_again() -> None:
    associator = started(scene(1, 2, 2))
    for _ in range(4):
        associator.associate(scene(11, 12, 13), shown(scene(1, 2, 2)), DEPTH, CAMERA, np.eye(4))
    merges = [
        associator.associate(scene(11, 12, 12), shown(scene(1, 2, 13)), DEPTH, CAMERA, np.eye(4)).merges
        for _ in range(6)
    ]  # fmt: skip
    assert not any(merges[:3]) and [(2, 13)] in merges[3:]


def test_pieces_cut_off_at_random_do_not_become_objects() -> None:
    known = scene(1, 2, 2)
    associator = started(known)
    for column in range(10, 150, 10):
        raw = scene(11, 12, 12)
        raw[60:, : min(column, 70)] = 13
        raw[60:] = np.roll(raw[60:], 2 * column, 1)
        result = associator.associate(raw, shown(known), DEPTH, CAMERA, np.eye(4))
        assert result.created == []


def test_an_object_that_nobody_finds_again_is_forgotten_and_one_that_came_twice_stays() -> None:
    associator = started(scene(1, 2, 2), AssociationSettings(mode="always", patience=4))
    speck, twice = np.s_[5:9, 20:26], np.s_[5:9, 80:86]
    results = []
    for frame in range(7):
        raw, seen, depth = scene(1, 2, 2), scene(1, 2, 2), DEPTH.copy()
        if frame == 0:  # a speck of noise in front of the wall, once
            raw[speck], depth[speck] = 50, 1.2
        if frame < 2:  # and one that the map shows when it comes again
            raw[twice], depth[twice] = 60 + frame, 1.2
            if frame:
                seen[twice] = 60
        results.append(associator.associate(raw, shown(seen, depth if frame else DEPTH), depth))
    assert sorted(results[0].created) == [50, 60]
    assert [result.forgotten for result in results] == [[], [], [], [], [], [50], []]
    assert 50 not in associator.sightings and associator.sightings[60] == 2


def test_what_was_forgotten_has_no_part_in_a_map_that_still_shows_it() -> None:
    associator = started(scene(1, 2, 2), AssociationSettings(mode="always", patience=1))
    seen = scene(1, 2, 2)
    associator.associate(scene(1, 2, 50), shown(seen), np.where(scene(0, 0, 1) > 0, 1.2, DEPTH).astype(np.float32))
    for _ in range(2):
        gone = associator.associate(scene(1, 2, 2), shown(seen), DEPTH).forgotten
    assert gone == [50]
    result = associator.associate(scene(1, 2, 60), shown(scene(1, 2, 50)), DEPTH)
    assert 50 not in result.ids and result.created == [60]


def stripes(ids: tuple[int, ...], shift: int) -> np.ndarray:
    """Eight vertical stripes with the ids in turn, moved by `shift` pixels."""
    image = np.repeat(np.resize(np.array(ids, np.uint16), 8), SHAPE[1] // 8)
    return np.ascontiguousarray(np.broadcast_to(np.roll(image, shift), SHAPE))


EIGHT = (5, 600, 7, 8, 30, 31, 32, 1)


def test_masks_with_consistent_ids_are_handed_through() -> None:
    associator, view = Associator(), None
    for shift in range(0, 16, 4):
        raw = stripes(EIGHT, shift)
        result = associator.associate(raw, view, DEPTH)
        np.testing.assert_array_equal(result.ids, raw)
        view = shown(stripes(EIGHT, shift + 4))
    assert associator.uses_own_ids is True
    odd = stripes((5, 600, 7, 8, 30, 30, 32, 1), 16)
    np.testing.assert_array_equal(associator.associate(odd, view, DEPTH).ids, odd)


def test_masks_with_shuffled_ids_are_associated() -> None:
    associator = started(stripes(EIGHT, 0), AssociationSettings())
    for k in range(1, 5):
        raw, known = stripes((*EIGHT[k:], *EIGHT[:k]), 4 * k), stripes(EIGHT, 4 * k)
        np.testing.assert_array_equal(associator.associate(raw, shown(known), DEPTH).ids, known)
    assert associator.uses_own_ids is False


def test_a_resting_camera_proves_nothing_and_a_wrong_verdict_is_taken_back() -> None:
    associator = started(stripes(EIGHT, 0), AssociationSettings())
    for _ in range(6):
        associator.associate(stripes(EIGHT, 0), shown(stripes(EIGHT, 0)), DEPTH)
    assert associator.uses_own_ids is None
    for shift in (4, 8, 12):
        associator.associate(stripes(EIGHT, shift), shown(stripes(EIGHT, shift)), DEPTH)
    assert associator.uses_own_ids is True
    for k in range(1, 4):
        known = stripes(EIGHT, 12 + 4 * k)
        result = associator.associate(stripes((*EIGHT[k:], *EIGHT[:k]), 12 + 4 * k), shown(known), DEPTH)
    assert associator.uses_own_ids is False
    np.testing.assert_array_equal(result.ids, known)


def test_modes() -> None:
    raw = scene(7, 8, 9)
    never = started(scene(1, 2, 3), AssociationSettings(mode="never"))
    np.testing.assert_array_equal(never.associate(raw, shown(scene(1, 2, 3)), DEPTH).ids, raw)
    with pytest.raises(ConfigError, match="mode.*auto.*always.*never.*'sometimes'"):
        AssociationSettings(mode="sometimes")  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["auto", "always", "never"])
def test_empty_masks_masks_of_one_id_and_maps_that_show_nothing(mode: str) -> None:
    associator = Associator(AssociationSettings(mode=mode))  # type: ignore[arg-type]
    empty = np.zeros(SHAPE, np.uint16)
    one = np.full(SHAPE, 7, np.uint16)
    for raw, view in [(empty, None), (one, shown(empty)), (empty, shown(one)), (one, shown(one)), (one, shown(one))]:
        result = associator.associate(raw, view, DEPTH)
        np.testing.assert_array_equal(result.ids, raw)
    assert associator.sightings == {7: 3}


def test_a_thousand_ids() -> None:
    cells = (np.arange(240) // 8)[:, None] * 40 + (np.arange(320) // 8)[None, :] + 1
    known = cells.astype(np.uint16)
    depth = np.ones(known.shape, np.float32)
    associator = Associator(ALWAYS)
    associator.associate(known, None, depth)
    order = np.random.default_rng(0).permutation(np.arange(2000, 2000 + known.max() + 1)).astype(np.uint16)
    result = associator.associate(order[known], shown(known, depth), depth)
    np.testing.assert_array_equal(result.ids, known)


def test_images_of_different_size_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(10, 160\).*\(120, 160\)"):
        Associator().associate(scene(1, 2, 3), None, DEPTH[:10])


def walk(room: Path, masks: Callable[[np.ndarray], np.ndarray], settings: AssociationSettings) -> tuple[float, int]:
    """Mean IoU on held-out frames and number of objects of a map labelled by association along the room."""
    sequence = open_sequence(room)
    associator, voxels = Associator(settings), LabelledVoxels(0.02)
    for index in range(0, len(sequence), 2):
        frame = sequence.frame(index)
        assert frame.mask is not None and frame.T_world_camera is not None
        view = voxels.render(frame.camera, frame.T_world_camera) if index else None
        segments = clean_segments(masks(frame.mask))
        result: Association = associator.associate(segments, view, frame.depth, frame.camera, frame.T_world_camera)
        for kept, dropped in result.merges:
            voxels.merge(kept, dropped)
        for whole, part in result.splits:
            voxels.split(frame, result.ids, whole, part)
        voxels.add(frame, result.ids)
    held_out = [sequence.frame(index) for index in range(1, len(sequence), 6)]
    predicted = np.stack([voxels.look_up(frame) for frame in held_out])
    true = np.stack([np.where(frame.depth > 0, frame.mask, 0) for frame in held_out])  # type: ignore[arg-type]
    iou = assigned_iou(predicted, true)
    large = [iou[i] for i in iou if (true == i).sum() > 100]
    return float(np.mean(large)), len(np.unique(voxels.labels()[0])) - 1


def test_scrambled_masks_give_nearly_the_map_of_exact_ones(room: Path) -> None:
    rng = np.random.default_rng(0)
    exact, objects = walk(room, lambda mask: mask, AssociationSettings(mode="never"))
    scrambled, found = walk(room, lambda mask: scramble(mask, rng), AssociationSettings())
    assert scrambled > exact - 0.05
    assert found <= objects + 8


def test_joined_segments_in_some_frames_do_not_join_the_map(room: Path) -> None:
    rng = np.random.default_rng(1)
    exact, _ = walk(room, lambda mask: mask, AssociationSettings(mode="never"))
    joined, _ = walk(room, lambda mask: scramble(mask, rng, merge=rng.random() < 0.1), AssociationSettings())
    assert joined > exact - 0.15
