# SPDX-License-Identifier: Apache-2.0
"""The list of objects: what it says of a map, how its objects are named, and files that are damaged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError, FormatError
from ggslam.objects.boxes import middle_of, oriented_box
from ggslam.objects.settings import ClassifierTuning
from ggslam.objects.table import ObjectRecord, ObjectTable, Observation
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.id_colors import PaletteTuning, id_palette
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning
from ggslam.scene.oriented_box import OrientedBox
from ggslam.system.tuning import overridden


def rotation(seed: int) -> np.ndarray:
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.linalg.det(Q)


def map_of(ids: list[int], means: np.ndarray | None = None, features: np.ndarray | None = None) -> GaussianMap:
    count = len(ids)
    gaussians = GaussianMap(feature_channels=16, with_moments=False)
    points = np.random.default_rng(0).normal(size=(count, 3)) if means is None else means
    gaussians.insert(
        torch.as_tensor(points, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 3),
        None if features is None else torch.as_tensor(features, dtype=torch.float32),
        object_id=torch.tensor(ids, dtype=torch.int32),
    )  # fmt: skip
    return gaussians


def table_of(names: dict[int, str | None]) -> ObjectTable:
    box = OrientedBox((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (1.0, 1.0, 1.0))
    records = [ObjectRecord(i, name, (1, 2, 3), 5, 0.5, (0.0, 0.0, 0.0), box) for i, name in names.items()]
    return ObjectTable("masks", 3, records)


# --- what it says of a map -------------------------------------------------------------------------------------------


def test_a_table_counts_names_and_observes() -> None:
    ids = [7, 0, 3, 7, 7, 0]
    table = ObjectTable.build(
        map_of(ids), IdentityClassifier.empty(), "geometry", {7: "mug", 8: "gone"}, {3: Observation(4, 9, 2)}
    )
    assert table.ids() == [3, 7] and table.unlabelled_gaussians == 2 and table.supervision == "geometry"
    mug, other = table.record(7), table.record(3)
    assert (mug.name, mug.gaussians, mug.first_frame, mug.views) == ("mug", 3, None, 0)
    assert (other.name, other.gaussians, other.first_frame, other.last_frame, other.views) == (None, 1, 4, 9, 2)
    assert mug.confidence is None  # no class, no probability
    assert (mug.label(), other.label()) == ("mug (7)", "object 3")
    assert len(ObjectTable.build(map_of([]), IdentityClassifier.empty(), "masks")) == 0
    with pytest.raises(ValueError, match="70000"):
        ObjectTable.build(map_of([70000]), IdentityClassifier.empty(), "masks")


def test_confidence_is_the_mean_probability_of_the_own_class() -> None:
    weight = np.zeros((2, 16), np.float32)
    weight[0, 0], weight[1, 1] = 1, 1
    classifier = IdentityClassifier(np.array([3, 7], np.uint16), weight, np.zeros(2, np.float32))
    features = np.zeros((3, 16))
    features[0, 0], features[1, 0], features[2, 1] = np.log(4), np.log(9), 0
    with overridden(ClassifierTuning, values_at_once=3):  # one Gaussian at a time
        table = ObjectTable.build(map_of([3, 3, 7], features=features), classifier, "masks")
    nothing = np.exp(IdentityVectorTuning.nothing_logit)
    assert table.record(3).confidence == pytest.approx((4 / (5 + nothing) + 9 / (10 + nothing)) / 2)
    assert table.record(7).confidence == pytest.approx(1 / (2 + nothing))


def test_a_box_finds_the_axes_of_a_turned_block() -> None:
    R, middle = rotation(1), np.array([3.0, -2.0, 5.0])
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3), -1).reshape(-1, 3) * [2.0, 1.0, 0.4]
    points = (grid @ R.T + middle).astype(np.float32)
    box = oriented_box(points)
    axes = np.array(box.axes)
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-6) and np.linalg.det(axes) == pytest.approx(1)
    assert np.allclose(np.abs(axes @ R), np.eye(3), atol=1e-3)
    assert np.allclose(box.center, middle, atol=1e-2) and np.allclose(box.size, [2.0, 1.0, 0.4], rtol=0.1)
    far = np.concatenate([points, middle + np.random.default_rng(2).normal(size=(60, 3)) * 20]).astype(np.float32)
    inflated = np.array(oriented_box(far).size)
    assert (inflated < [2.2, 1.1, 0.44]).all()  # 0.6 % floaters do not matter
    assert np.allclose(middle_of(far, np.ones(len(far))), middle, atol=0.02)


@pytest.mark.parametrize("points", [[[1, 2, 3]], [[1, 2, 3], [1, 2, 5]], [[1, 2, 3]] * 4, [[0, 0, 0], [1, 1, 0]] * 3])
def test_boxes_of_few_and_flat_points(points: list[list[float]]) -> None:
    box = oriented_box(np.array(points, np.float32))
    axes = np.array(box.axes)
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-6) and np.linalg.det(axes) == pytest.approx(1)
    inside = np.abs((np.array(points) - box.center) @ axes.T)
    assert (inside <= np.array(box.size) / 2 + 1e-6).all()
    assert box.size[0] == pytest.approx(np.linalg.norm(np.array(points[0]) - points[-1] if len(points) > 1 else 0))


def test_faint_gaussians_hardly_move_the_middle() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    assert middle_of(points, np.array([0.9, 0.1])) == pytest.approx((0.1, 0, 0))


def test_a_real_segmented_map(segmented_room: Any) -> None:
    room = segmented_room
    table = ObjectTable.build(room.gaussians, room.classifier, "masks", room.sequence.instance_names)
    assert table.ids() == room.classifier.class_ids.tolist()
    assert sum(record.gaussians for record in table.objects) + table.unlabelled_gaussians == len(room.gaussians)
    assert all(record.confidence > 0.9 and record.name for record in table.objects)
    assert max(max(record.box.size) for record in table.objects) < 7  # metres: the room is 5.2 wide


# --- colours ---------------------------------------------------------------------------------------------------------


def test_colours_are_distinct_and_never_grey() -> None:
    colors = id_palette()
    assert tuple(colors[0]) == PaletteTuning.unlabelled and not colors.flags.writeable
    first = colors[1:601].astype(int)
    steps = {step: np.abs(first[step:] - first[:-step]).sum(-1).min() for step in (1, 2, 3, 5, 8, 13, 21, 34, 144, 288)}
    assert min(steps.values()) > 50, steps  # also where hues come near each other again
    first = first[:40]
    apart = np.abs(first[:, None] - first[None]).sum(-1) + 1000 * np.eye(40, dtype=int)
    assert apart.min() > 20 and (first.max(1) - first.min(1)).min() > 60


def test_the_table_has_the_last_word_on_colours() -> None:
    palette = table_of({5: None}).palette()
    assert palette[5].tolist() == [1, 2, 3] and (palette[6] == id_palette()[6]).all()


# --- names -----------------------------------------------------------------------------------------------------------


def test_names_and_ids() -> None:
    table = table_of({2: "mug", 7: "Big Book", 9: "mug", 12: None, 13: "12"})
    assert table.find("7") == [7] and table.find(" big book ") == [7] and table.find("MUG") == [2, 9]
    assert table.find("12") == [12] and table.find("13") == [13]
    assert table.find("Mug (9)") == [9] and table.find("object 12") == [12]
    assert table.select("mug, 7,2") == [2, 9, 7] and table.select("all") == [2, 7, 9, 12, 13]


@pytest.mark.parametrize(
    ("wanted", "hint"),
    [("mgu", r"'mgu'.*mug\W*$"), ("bigbook", r"'bigbook'.*Big Book\W*$"), ("99", "mug \\(2\\)"), ("", "''"),
     ("-7", "'-7'"), ("³", "'³'")],
)  # fmt: skip
def test_unknown_names_are_answered_with_near_ones(wanted: str, hint: str) -> None:
    table = table_of({2: "mug", 7: "Big Book"})
    with pytest.raises(ConfigError, match=hint):
        table.select(wanted)


def test_unknown_names_in_long_and_empty_tables() -> None:
    with pytest.raises(ConfigError, match="object 12 .*88"):
        table_of(dict.fromkeys(range(1, 101))).find("mug")
    with pytest.raises(ConfigError, match="'3'"):
        table_of({}).record(3)


# --- files -----------------------------------------------------------------------------------------------------------


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    ids = [7, 0, 3, 7, 7, 0]
    names, seen = {7: "tasse à café"}, {3: Observation(4, 9, 2)}
    table = ObjectTable.build(map_of(ids), IdentityClassifier.empty(), "associated masks", names, seen)
    table.save(tmp_path / "objects.json")
    assert ObjectTable.load(tmp_path / "objects.json") == table
    content = json.loads((tmp_path / "objects.json").read_text())
    assert set(content) == {"supervision", "unlabelled_gaussians", "objects"}
    assert set(content["objects"][0]) == {
        "id", "name", "color", "gaussians", "confidence", "centroid", "box", "first_frame", "last_frame", "views",
    }  # fmt: skip
    assert set(content["objects"][0]["box"]) == {"center", "axes", "size"}


def damaged(change: Any) -> str:
    values = table_of({2: "mug", 7: None}).to_dict()
    change(values)
    return json.dumps(values)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "cannot be read"),
        ("[]", "top level"),
        (damaged(lambda v: v.pop("objects") and v.update(objects="none")), "objects"),
        (damaged(lambda v: v["objects"][1].pop("id")), "objects.1.id"),
        (damaged(lambda v: v["objects"][1].update(id=0)), "objects.1.id"),
        (damaged(lambda v: v["objects"][0].update(id=70000)), "70000"),
        (damaged(lambda v: v["objects"][0].update(id=7)), "object 7 is listed twice"),
        (damaged(lambda v: v["objects"][0].update(color=[1, 2])), "objects.0.color"),
        (damaged(lambda v: v["objects"][0].update(color=[1, 2, 256])), "objects.0.color.2"),
        (damaged(lambda v: v["objects"][0].update(confidence=1.5)), "confidence"),
        (damaged(lambda v: v["objects"][0]["box"].update(size=[1, 2, float("nan")])), "objects.0.box.size.2"),
        (damaged(lambda v: v["objects"][0].update(centroid=["a", 0, 0])), "objects.0.centroid.0"),
        (damaged(lambda v: v.update(supervision="wishes")), "supervision"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "objects.json").write_text(content)
    with pytest.raises(FormatError, match="objects.json") as caught:
        ObjectTable.load(tmp_path / "objects.json")
    assert words in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"objects\.json"):
        ObjectTable.load(tmp_path / "objects.json")
