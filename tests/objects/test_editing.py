# SPDX-License-Identifier: Apache-2.0
"""Edits of a segmented map: the generated room with true labels."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError
from ggslam.jobs.edit.edits import Edit, apply_edit
from ggslam.objects.displacement import Displacement
from ggslam.objects.editing import (
    duplicate_objects,
    keep_objects,
    merge_objects,
    move_objects,
    rebuild_table,
    recolor_objects,
    remove_objects,
    rename_object,
    rigid_motion,
)
from ggslam.objects.recoloring import parse_color
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.segmented_rows import copies_of
from ggslam.objects.table import ObjectTable
from ggslam.rendering.types import GaussianTensors


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
    assert sofa not in scene.table.ids() and list(change.left) == [sofa]
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
    (copy,) = change.made
    assert scene.table.record(copy).name == "mug copy"
    rows = scene.gaussians.object_id.numpy() == copy
    assert not rows[:count].any() and rows[count:].all()
    assert (told(scene)[rows] == copy).all()
    assert (told(scene)[:count] == told_before).mean() > 0.99  # the new class takes nobody's members
    before, after = scene.table.record(mug).centroid, scene.table.record(copy).centroid
    assert np.allclose(np.subtract(after, before), [0, -0.3, 0], atol=0.02)


def test_a_duplicate_finds_an_id_that_is_free(scene: SegmentedMap) -> None:
    merge_objects(scene, largest(scene, "sofa"), largest(scene, "cushion"))
    scene.gaussians.object_id[scene.gaussians.object_id == largest(scene, "rug")] = 65535
    rebuild_table(scene)
    (copy,) = duplicate_objects(scene, [largest(scene, "mug")]).made
    assert 1 <= copy < 65535
    assert copy in scene.table.ids()


def test_a_name_with_a_comma_can_be_addressed(scene: SegmentedMap) -> None:
    record = replace(scene.table.record(largest(scene, "sofa")), name="a,b")
    assert replace(scene.table, objects=[record]).select("A,b") == [record.id]


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


def followed(scene: SegmentedMap, *edits: Edit, earlier: Displacement | None = None) -> Displacement:
    displacement = Displacement.from_json(json.loads(json.dumps((earlier or Displacement()).to_json())))
    for edit in edits:
        displacement.follow(apply_edit(scene, edit), scene)
    return displacement


def lying_at(parts: list[GaussianTensors], centroid: Any) -> list[bool]:
    return [bool(np.linalg.norm(part.means.numpy().mean(0) - centroid) < 0.1) for part in parts]


def test_a_moved_object_in_a_list_keeps_no_other_hole_open(scene: SegmentedMap) -> None:
    mug, sofa = largest(scene, "mug"), largest(scene, "sofa")
    homes = [part.means.numpy().mean(0) for part in copies(scene, mug, sofa)]
    after = followed(scene, Edit("move", str(mug), "0.8 0 0"), Edit("remove", f"{mug},{sofa}"))
    assert [sum(lying_at(after.left(), home)) for home in homes] == [1, 1] and len(after.left()) == 2
    assert after.ids() == []


def test_what_an_earlier_edit_placed_leaves_no_hole(scene: SegmentedMap) -> None:
    mug = largest(scene, "mug")
    earlier = followed(scene, Edit("move", str(mug), "0.8 0 0"), Edit("duplicate", "sofa", "0 -2 0"))
    copied = next(i for i in earlier.ids() if i != mug)
    assert followed(scene, Edit("remove", f"{mug},{copied}"), earlier=earlier).left() == []


def test_there_and_back_leaves_no_hole(scene: SegmentedMap) -> None:
    mug = str(largest(scene, "mug"))
    there, back = Edit("move", mug, "0.8 0 0", "0 30 0"), Edit("move", mug, "-0.8 0 0", "0 -30 0")
    after = followed(scene, there, back)
    assert after.left() == [] and after.ids() == []
    earlier = followed(scene, there)
    after = followed(scene, back, earlier=earlier)
    assert after.left() == [] and after.ids() == []
    assert len(followed(scene, Edit("remove", mug), earlier=after).left()) == 1


def test_a_merged_object_stays_displaced(scene: SegmentedMap) -> None:
    mug, sofa = str(largest(scene, "mug")), str(largest(scene, "sofa"))
    after = followed(scene, Edit("move", mug, "0.8 0 0"), Edit("merge", sofa, mug))
    assert after.ids() == [int(sofa)]
    after = followed(scene, Edit("remove", sofa), earlier=after)
    assert after.left() == []


def ball(scene: SegmentedMap, object_id: int, radius: float) -> str:
    center = np.array(scene.table.record(object_id).centroid).tolist()
    return json.dumps([{"mode": "set", "shape": {"kind": "sphere", "center": center, "radius": radius}}])


def test_an_object_made_of_a_part_stands_where_it_was_recorded(scene: SegmentedMap) -> None:
    sofa = largest(scene, "sofa")
    after = followed(scene, Edit("assign", "new", "seat", selection=ball(scene, sofa, 0.2)))
    assert after.ids() == [] and after.cut() == [sofa]
    assert len(followed(scene, Edit("remove", "seat"), earlier=after).left()) == 1


def test_a_part_of_a_moved_object_stays_displaced(scene: SegmentedMap) -> None:
    sofa, mug, pouf = (largest(scene, name) for name in ("sofa", "mug", "pouf"))
    moved = followed(scene, Edit("move", str(sofa), "0 -2 0"))
    part = ball(scene, sofa, 0.2)
    after = followed(scene, Edit("assign", "new", "seat", selection=part), earlier=moved)
    seat = scene.table.find("seat")[0]
    assert after.ids() == sorted([sofa, seat])
    assert np.allclose(after.motions[seat], moved.motions[sofa])
    after = followed(scene, Edit("assign", str(pouf), selection=ball(scene, seat, 0.1)), earlier=after)
    assert after.motions[pouf] is None and mug not in after.ids()  # of a moved part and one in its place
    back = Edit("move", "seat", "0 2 0")
    assert seat not in followed(scene, back, earlier=after).ids()


def copies(scene: SegmentedMap, *ids: int) -> list[GaussianTensors]:
    return [copies_of(scene.gaussians, scene.gaussians.object_id.numpy() == i) for i in ids]


FAULTS: list[tuple[Callable[[SegmentedMap], object], str]] = [
    (lambda s: remove_objects(s, [999]), "999"),
    (lambda s: remove_objects(s, []), "no object"),
    (lambda s: merge_objects(s, 1, 1), "object 1 "),
    (lambda s: merge_objects(s, 1, 999), "999"),
    (lambda s: rename_object(s, 1, "12"), "12"),
    (lambda s: rename_object(s, 1, "a,b"), "a,b"),
    (lambda s: rename_object(s, 1, "a\x1b[2Jb"), r"\\x1b\[2Jb"),
    (lambda s: rename_object(s, 1, "Sofa"), "'Sofa'.* 9 "),
    (lambda s: apply_edit(s, Edit("move", "sofa", "1 2")), "`move`.*'1 2'"),
    (lambda s: apply_edit(s, Edit("move", "sofa", "1 2 nan")), "`move`.*'1 2 nan'"),
    (lambda s: move_objects(s, [1], (1e4, 0, 0)), "--move"),
    (lambda s: duplicate_objects(s, [1], (0, -1e9, 0)), "--duplicate"),
    (lambda s: apply_edit(s, Edit("rename", "mug", "cup")), "`rename`.*'mug'.*25, 26"),
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
