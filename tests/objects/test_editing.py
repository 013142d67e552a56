# SPDX-License-Identifier: Apache-2.0
"""Edits of a segmented map: the generated room with true labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.editing_jobs import Edit, apply_edit
from ggslam.errors import ConfigError
from ggslam.objects.editing import (
    duplicate_objects,
    keep_objects,
    merge_objects,
    move_objects,
    recolor_objects,
    remove_objects,
    rename_object,
    rigid_motion,
)
from ggslam.objects.recoloring import parse_color
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable


@pytest.fixture
def scene(segmented_room: Any) -> SegmentedMap:
    gaussians, classifier = segmented_room.gaussians, segmented_room.classifier
    ids = np.zeros((len(gaussians), 4), np.uint16)
    ids[:, 0] = gaussians.object_id.numpy()
    votes = ObjectVotes(ids, (ids > 0).astype(np.float32))
    names = segmented_room.sequence.instance_names
    return SegmentedMap(gaussians, classifier, ObjectTable.build(gaussians, classifier, "masks", names), votes)


def largest(scene: SegmentedMap, name: str) -> int:
    ids = scene.table.find(name)
    return max(ids, key=lambda i: scene.table.record(i).gaussians)


def told(scene: SegmentedMap) -> np.ndarray:
    """Ids by the classifier."""
    return scene.classifier.labels(scene.gaussians.features.numpy())[0]


def consistent(scene: SegmentedMap) -> None:
    """Labels, table, classifier and votes tell of the same objects and the same Gaussians."""
    present = sorted(set(scene.gaussians.object_id.tolist()) - {0})
    assert present == scene.table.ids()
    assert set(scene.classifier.class_ids.tolist()) <= set(present)
    assert scene.votes is not None and len(scene.votes) == len(scene.gaussians)
    assert set(np.unique(scene.votes.ids).tolist()) - {0} <= set(present)
    assert sum(r.gaussians for r in scene.table.objects) + scene.table.unlabelled_gaussians == len(scene.gaussians)


def test_remove_takes_the_object_and_leaves_the_others_as_they_were(scene: SegmentedMap) -> None:
    sofa, labels, means = largest(scene, "sofa"), scene.gaussians.object_id.clone(), scene.gaussians.means.clone()
    change = remove_objects(scene, [sofa])
    consistent(scene)
    assert sofa not in scene.table.ids() and change.vacated
    assert len(change.before.means) == len(labels) - len(scene.gaussians) >= 0.95 * (labels == sofa).sum()
    left = {row.tobytes() for row in scene.gaussians.means.numpy()}
    others = [row.tobytes() in left for row in means[(labels > 0) & (labels != sofa)].numpy()]
    assert np.mean(others) > 0.995  # all but a few that stuck in the sofa


def test_keep_leaves_nothing_else(scene: SegmentedMap) -> None:
    sofa = largest(scene, "sofa")
    keep_objects(scene, [sofa])
    consistent(scene)
    assert scene.table.ids() == [sofa] and scene.table.unlabelled_gaussians == 0


def test_move_is_rigid_and_moves_nothing_else(scene: SegmentedMap) -> None:
    sofa, before = largest(scene, "sofa"), scene.gaussians.means.clone()
    change = move_objects(scene, [sofa], (0.5, 0, -0.25), (0, 90, 0))
    consistent(scene)
    moved = (scene.gaussians.means != before).any(1)
    assert int(moved.sum()) == len(change.before.means) == scene.table.record(sofa).gaussians
    old, new = change.before.means.double(), change.after.means.double()
    weights = torch.sigmoid(change.before.opacity_logits).double()
    shift = ((new - old) * weights[:, None]).sum(0) / weights.sum()
    assert np.allclose(shift, [0.5, 0, -0.25], atol=1e-4)
    centred = old - old.mean(0)
    turned = torch.stack([centred[:, 2], centred[:, 1], -centred[:, 0]], 1)  # x to -z, z to x
    assert torch.allclose(new - new.mean(0), turned, atol=1e-4)


def test_rotations_are_done_about_x_then_y_then_z() -> None:
    T = rigid_motion(np.zeros(3), (0, 0, 0), (90, 0, 90))
    assert np.allclose(T[:3, :3] @ [0, 1, 0], [0, 0, 1]) and np.allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0])


def test_a_duplicate_is_an_object_of_its_own(scene: SegmentedMap) -> None:
    mug, count, told_before = largest(scene, "mug"), len(scene.gaussians), told(scene)
    change = duplicate_objects(scene, [mug], (0, -0.3, 0))
    consistent(scene)
    (copy,) = change.displaced
    assert scene.table.record(copy).name == "mug copy"
    rows = scene.gaussians.object_id.numpy() == copy
    assert not rows[:count].any() and rows[count:].all()
    assert (told(scene)[rows] == copy).all()
    assert (told(scene)[:count] == told_before).mean() > 0.99  # the new class takes nobody's members
    before, after = scene.table.record(mug).centroid, scene.table.record(copy).centroid
    assert np.allclose(np.subtract(after, before), [0, -0.3, 0], atol=0.02)


def test_a_duplicate_without_a_shift_stands_beside(scene: SegmentedMap) -> None:
    mug = largest(scene, "mug")
    change = duplicate_objects(scene, [mug])
    assert change.after.means[:, 0].min() > change.before.means[:, 0].median()
    assert torch.equal(change.after.means[:, 1:], change.before.means[:, 1:])


def test_recolor_sets_the_mean_and_keeps_shading(scene: SegmentedMap) -> None:
    sofa, before = largest(scene, "sofa"), scene.gaussians.rgb.clone()
    change = recolor_objects(scene, [sofa], (40, 90, 200))
    changed = (scene.gaussians.rgb != before).any(1)
    assert int(changed.sum()) <= len(change.before.means)
    painted, old = scene.gaussians.rgb[changed].clamp(0, 1), before[changed]
    assert np.allclose(painted.mean(0), np.array([40, 90, 200]) / 255, atol=0.06)
    assert np.corrcoef(painted.mean(1), old.mean(1))[0, 1] > 0.9


def test_colors_are_read_from_digits_and_names() -> None:
    assert parse_color("#0af") == (0, 170, 255) and parse_color(" Red ") == (220, 30, 30)
    with pytest.raises(ConfigError, match="#12345"):
        parse_color("#12345")


def test_merge_makes_one_of_two(scene: SegmentedMap) -> None:
    sofa, cushion = largest(scene, "sofa"), largest(scene, "cushion")
    total = scene.table.record(sofa).gaussians + scene.table.record(cushion).gaussians
    merge_objects(scene, sofa, cushion)
    consistent(scene)
    assert scene.table.record(sofa).gaussians == total and cushion not in scene.table.ids()
    rows = scene.gaussians.object_id.numpy() == sofa
    assert (told(scene)[rows] == sofa).mean() > 0.99
    assert scene.votes is not None and (scene.votes.labels()[rows] == sofa).all()


def test_rename(scene: SegmentedMap) -> None:
    sofa = largest(scene, "sofa")
    rename_object(scene, sofa, " couch ")
    assert scene.table.find("Couch") == [sofa]


FAULTS: list[tuple[Callable[[SegmentedMap], object], str]] = [
    (lambda s: remove_objects(s, [999]), "999"),
    (lambda s: remove_objects(s, []), "no object"),
    (lambda s: merge_objects(s, 1, 1), "itself"),
    (lambda s: merge_objects(s, 1, 999), "999"),
    (lambda s: rename_object(s, 1, "12"), "12"),
    (lambda s: rename_object(s, 1, "a,b"), "a,b"),
    (lambda s: rename_object(s, 1, "Sofa"), "has it already"),
    (lambda s: apply_edit(s, Edit("move", "sofa", "1 2")), "three numbers"),
    (lambda s: apply_edit(s, Edit("move", "sofa", "1 2 nan")), "finite"),
    (lambda s: apply_edit(s, Edit("rename", "mug", "cup")), "expected one object"),
    (lambda s: apply_edit(s, Edit("recolor", "sofa", "blurple")), "blurple"),
    (lambda s: apply_edit(s, Edit("paint", "sofa")), "paint"),  # type: ignore[arg-type]
]


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_faults_are_named_before_anything_is_changed(scene: SegmentedMap, number: int) -> None:
    edit, word = FAULTS[number]
    before, table = scene.gaussians.means.clone(), scene.table
    with pytest.raises(ConfigError, match=word):
        edit(scene)
    assert torch.equal(scene.gaussians.means, before) and scene.table is table
