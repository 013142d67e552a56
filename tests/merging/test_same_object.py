# SPDX-License-Identifier: Apache-2.0
"""Objects of two maps that are one thing get one id."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.merging.objects import RunObjects, UnitedObjects
from ggslam.objects.encoding import code_of, with_class
from ggslam.objects.same_object import LabelledVoxels, find_counterparts
from ggslam.objects.settings import SameObjectSettings
from ggslam.objects.table import ObjectTable, Observation
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier

SETTINGS = SameObjectSettings()


def box(centre: tuple[float, float, float], size: tuple[float, float, float], step: float = 0.02) -> np.ndarray:
    """Points on a grid in a box."""
    axes = [np.arange(c - s / 2, c + s / 2, step) for c, s in zip(centre, size, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def voxels(things: dict[int, np.ndarray]) -> LabelledVoxels:
    """A map of labelled points; 0 is what belongs to no object."""
    means = np.concatenate(list(things.values()))
    labels = np.concatenate([np.full(len(points), i, np.int64) for i, points in things.items()])
    return LabelledVoxels.of(means, labels, np.ones(len(means)), SETTINGS.voxel)


def pairs(first: dict[int, np.ndarray], second: dict[int, np.ndarray]) -> dict[int, int]:
    """Id of the second map -> id of the first."""
    return {found.second: found.first for found in find_counterparts(voxels(first), voxels(second), SETTINGS)}


SOFA, TABLE, LAMP = box((0, 0, 2), (1.0, 0.4, 0.4)), box((1.2, 0, 2), (0.5, 0.3, 0.5)), box((2, 0, 2), (0.2, 0.8, 0.2))


def test_a_voxel_is_of_the_object_with_the_most_weight() -> None:
    means = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.003, 0, 0], [0.5, 0, 0]])
    found = LabelledVoxels.of(means, np.array([3, 3, 8, 0]), np.array([0.2, 0.3, 0.6, 1.0]), 0.04)
    assert found.labels.tolist() == [8, 0] and len(found.keys) == 2


def test_things_are_found_again_under_other_ids() -> None:
    noise = np.random.default_rng(0).normal(0, 0.008, SOFA.shape)
    assert pairs({1: SOFA, 2: TABLE}, {7: TABLE + 0.01, 5: SOFA + noise, 9: LAMP}) == {7: 2, 5: 1}


def test_only_what_both_maps_know_counts() -> None:
    """Each run saw one half of the sofa and a piece of the other's."""
    left, right = SOFA[SOFA[:, 0] < 0.1], SOFA[SOFA[:, 0] > -0.1]
    assert pairs({1: left, 2: TABLE}, {4: right}) == {4: 1}


def test_pieces_become_what_they_were_cut_from() -> None:
    pieces = {4: SOFA[SOFA[:, 0] < 0], 5: SOFA[SOFA[:, 0] >= 0]}
    assert pairs({1: SOFA}, pieces) == {4: 1, 5: 1}


def test_a_cup_on_a_table_is_no_piece_of_it() -> None:
    cup = box((1.2, -0.13, 2), (0.12, 0.12, 0.12))
    table_as_if_with_cup = {2: np.concatenate([TABLE, cup])}
    assert pairs(table_as_if_with_cup, {6: cup, 8: TABLE}) == {8: 2}


def test_neighbours_that_touch_stay_two() -> None:
    beside = SOFA + np.array([1.0, 0, 0])
    assert pairs({1: SOFA}, {3: beside}) == {}


def learned(things: dict[int, np.ndarray], supervision: str, names: dict[int, str]) -> tuple[GaussianMap, RunObjects]:
    """A map of labelled points as a run has it, and its objects."""
    means = np.concatenate(list(things.values())).astype(np.float32)
    labels = np.concatenate([np.full(len(points), i) for i, points in things.items()])
    out, count = GaussianMap(0, 16), len(means)
    classifier = IdentityClassifier.empty()
    for i in sorted(things):
        if i:
            classifier = with_class(classifier, i, np.zeros((1, 16), np.float32))
    out.insert(
        torch.from_numpy(means), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), -4.0), 2.0,
        torch.full((count, 3), 0.5), object_id=torch.from_numpy(labels),
    )  # fmt: skip
    for i in sorted(things):
        if i:
            own = labels == i
            out.features[torch.from_numpy(own)] = torch.from_numpy(code_of(out, classifier, i))
    out.vote_ids[:, 0] = torch.from_numpy(labels.astype(np.int32))
    out.vote_weights[:, 0] = torch.from_numpy((labels > 0).astype(np.float32))
    seen = {i: Observation(0, 9, 4) for i in things if i}
    table = ObjectTable.build(out, classifier, supervision, names, seen)  # type: ignore[arg-type]
    return out, RunObjects(table, classifier, "masks of one room" if supervision == "masks" else None, 0)


def unite(*runs: tuple[GaussianMap, RunObjects | None]) -> tuple[UnitedObjects, GaussianMap]:
    """The objects of several maps in one world, and all Gaussians."""
    united, base = UnitedObjects(SETTINGS), GaussianMap(0, 16)
    for gaussians, objects in runs:
        united.add(base, gaussians, objects)
        base.append(gaussians.take(torch.arange(len(gaussians))))
    return united, base


def test_one_thing_has_one_id_its_name_and_all_its_views() -> None:
    first = learned({1: SOFA, 2: TABLE}, "geometry", {1: "sofa"})
    second = learned({2: SOFA + 0.005, 1: LAMP}, "geometry", {2: "couch", 1: "lamp"})
    second = second[0], RunObjects(second[1].table, second[1].classifier, None, 100)
    united, base = unite(first, second)
    assert united.ids == [{1: 1, 2: 2}, {1: 3, 2: 1}] and united.united == [(1, 1, 2)]
    table = united.table(base)
    assert {o.id: o.name for o in table.objects} == {1: "sofa", 2: None, 3: "lamp"}
    assert "sofa" in united.notes[0] and "couch" in united.notes[0]
    sofa, lamp = table.record(1), table.record(3)
    assert sofa.gaussians == 2 * len(SOFA) and (sofa.first_frame, sofa.last_frame, sofa.views) == (0, 109, 8)
    assert lamp.first_frame == 100 and lamp.confidence is not None and lamp.confidence > 0.8
    labels, _ = united.classifier.labels(base.features.numpy())
    assert (labels == base.object_id.numpy()).mean() > 0.99
    votes = np.take_along_axis(base.vote_ids.numpy(), base.vote_weights.numpy().argmax(1)[:, None], 1)[:, 0]
    assert np.array_equal(votes, base.object_id.numpy())


def test_ids_of_the_same_masks_are_believed_whatever_is_seen() -> None:
    """Nothing is seen twice, but both runs were taught by the same masks: object 2 is object 2."""
    united, base = unite(learned({1: SOFA, 2: TABLE}, "masks", {}), learned({2: LAMP, 5: LAMP + 3}, "masks", {}))
    assert united.ids[1] == {2: 2, 5: 5} and united.table(base).ids() == [1, 2, 5]
    assert united.supervision == "masks"


def test_ids_of_the_same_masks_stay_where_the_first_run_saw_too_little_of_a_thing() -> None:
    """The first run's masks told of object 5, but none of its Gaussians is of it."""
    first, objects = learned({1: SOFA}, "masks", {})
    classifier = with_class(objects.classifier, 5, first.features.numpy())
    objects = RunObjects(objects.table, classifier, objects.source, 0)
    united, base = unite((first, objects), learned({1: SOFA, 5: LAMP}, "masks", {}))
    assert united.ids[1] == {1: 1, 5: 5} and united.table(base).ids() == [1, 5]
    assert united.united == [(1, 1, 1)]
    labels, _ = united.classifier.labels(base.features.numpy())
    assert (labels == base.object_id.numpy()).mean() > 0.99


def test_a_run_without_objects_adds_none() -> None:
    bare = GaussianMap(0, 16)
    bare.insert(torch.zeros((3, 3)), torch.ones((3, 4)), torch.zeros((3, 3)), 1.0, torch.zeros((3, 3)))
    united, base = unite((bare, None), learned({4: SOFA}, "geometry", {}))
    assert united.ids == [{}, {4: 4}] and united.table(base).ids() == [4]
    assert united.table(base).unlabelled_gaussians == 3


@pytest.mark.parametrize("order", [("masks", "geometry"), ("geometry", "masks")])
def test_a_merged_map_is_as_sure_as_the_least_sure_run(order: tuple[str, str]) -> None:
    united, _ = unite(learned({1: SOFA}, order[0], {}), learned({1: TABLE}, order[1], {}))
    assert united.supervision == "geometry"


def test_small_things_are_known_again() -> None:
    """A tile of 6 x 4 x 2 cm fills two or three voxels; one beside it is another thing."""
    maps = []
    for ids, off in (((2, 3), 0.0), ((8, 9), 0.002)):
        out = GaussianMap(0)
        for i, centre in zip(ids, ((0.0, 0, 1), (0.12, 0, 1)), strict=True):
            points = torch.from_numpy(box(centre, (0.06, 0.04, 0.02), 0.004) + off).float()
            count, ids_of = len(points), torch.full((len(points),), i, dtype=torch.int32)
            turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
            out.insert(points, turns, torch.full((count, 3), -5.0), 2.0, torch.zeros((count, 3)), object_id=ids_of)
        maps.append(out)
    assert UnitedObjects(SETTINGS)._by_surface(*maps) == {8: 2, 9: 3}
