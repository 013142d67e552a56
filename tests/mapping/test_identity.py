# SPDX-License-Identifier: Apache-2.0
"""Identity learning, from its parts to a wall with two pictures on it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ggslam.mapping.class_numbers import ClassTuning
from ggslam.mapping.cpu.class_table import CpuClassTable
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.cpu.neighbours import NeighbourIndex, kl_gradient
from ggslam.mapping.cpu.pixel_pool import at_boundary, draw_pool
from ggslam.mapping.identity_settings import IdentitySettings, NeighbourSettings
from ggslam.mapping.labelling import KeyframeLabels
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.settings import LearningRates, MapperSettings
from ggslam.mapping.votes import merge_votes, vote_labels
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import render_labels
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityVectorTuning

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)

SETTINGS = MapperSettings(rates=LearningRates(means=6e-4, sh_dc=1.8e-2))
"""Short steps: the soft colours of a wall that only one view shows hold no Gaussian in its place, and with the longer
ones of the defaults labels spread over some pixels beside their objects."""


def wall(index: int = 0, camera: Camera = CAMERA) -> Frame:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    color = np.stack([128 + 100 * np.sin(u / 6), 128 + 100 * np.cos(v / 5), 100 + 50 * np.sin((u + v) / 9)], -1)
    depth = (2.0 + 0.4 * u / camera.width).astype(np.float32)
    return Frame(index, index, index / 30, color.astype(np.uint8), depth, camera)


def pictures(small: int = 300, big: int = 2) -> np.ndarray:
    mask = np.full((60, 80), 1, np.uint16)
    mask[10:40, 8:40] = big
    mask[20:30, 55:65] = small
    return mask


def make_mapper(**changes: object) -> Mapper:
    settings = dataclasses.replace(IdentitySettings(every=1, pixels=512), **changes)  # type: ignore[arg-type]
    return CpuMapper(GaussianMap(0, 16), SETTINGS, NativeContext(2), 0, CpuIdentityLearner(settings))


def trained(mask: np.ndarray | None, iterations: int = 40, **changes: object) -> Mapper:
    mapper = make_mapper(**changes)
    mapper.add_keyframe(wall(), np.eye(4), lambda keyframe, show: KeyframeLabels(mask))
    mapper.run(iterations)
    mapper.finish_identity()
    return mapper


def shown(mapper: Mapper, camera: Camera = CAMERA) -> np.ndarray:
    assert mapper.identity is not None
    return render_labels(CpuRasterizer(), mapper.map, mapper.identity.classifier, camera, np.eye(4))[0]


# --- the whole --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [{}, {"initialisation": "random", "final_passes": 100}, {"schedule": "dense", "weight": 1.0},
     {"schedule": "dense", "detach": False}, {"schedule": "colors", "weight": 1.0}],
)  # fmt: skip
def test_objects_are_learned(changes: dict[str, object]) -> None:
    mapper = trained(pictures(), **changes)
    assert (shown(mapper) == pictures()).mean() > 0.98


def test_votes_alone_label_the_gaussians() -> None:
    mapper = trained(pictures(), schedule="votes")
    ids = mapper.map.object_id.numpy()
    assert set(np.unique(ids)) == {1, 2, 300}
    rows = CpuRasterizer()
    rows.forward(mapper.map, CAMERA, np.eye(4))
    seen, _ = rows.pixel_terms(np.arange(4800), 96, 0.0).labels(ids.astype(np.uint16))
    assert (seen.reshape(60, 80) == pictures()).mean() > 0.97


def test_identity_does_not_touch_colours_shapes_and_poses() -> None:
    """With detached gradients the map is, bit for bit, that of a run without objects."""
    plain = CpuMapper(GaussianMap(), SETTINGS, NativeContext(2))
    plain.add_keyframe(wall(), np.eye(4))
    plain.run(12)
    mapper = trained(pictures(), 12)
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(mapper.map, name), getattr(plain.map, name)), name
    attached = trained(pictures(), 12, schedule="dense", detach=False, weight=1.0)
    assert not torch.equal(attached.map.means, plain.map.means)


def test_a_run_repeats_bit_for_bit() -> None:
    first, second = trained(pictures()), trained(pictures())
    assert torch.equal(first.map.features, second.map.features)
    assert torch.equal(first.map.object_id, second.map.object_id)


def test_a_thousand_objects() -> None:
    mask = np.kron(np.arange(1, 1201).reshape(30, 40), np.ones((4, 4))).astype(np.uint16)  # 1200 ids of 4x4 pixels
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    mapper = make_mapper(pixels=2048)
    mapper.add_keyframe(wall(camera=camera), np.eye(4), lambda keyframe, show: KeyframeLabels(mask))
    mapper.run(40)
    mapper.finish_identity()
    assert mapper.identity is not None and len(mapper.identity.classifier) == 1200
    assert (mapper.map.object_id > 0).float().mean() > 0.75 and len(torch.unique(mapper.map.object_id)) > 1100
    assert (shown(mapper, camera) == mask).mean() > 0.6


@pytest.mark.parametrize("mask", [None, np.zeros((60, 80), np.uint16)])
def test_without_labels_nothing_is_learned(mask: np.ndarray | None) -> None:
    mapper = trained(mask, 3)
    assert mapper.identity is not None and len(mapper.identity.classifier) == 0
    assert not mapper.map.object_id.any() and not mapper.map.features.any()


def test_one_object() -> None:
    mapper = trained(np.full((60, 80), 9, np.uint16), 5)
    assert (shown(mapper) == 9).all() and (mapper.map.object_id == 9).all()


def test_unlabelled_pixels_teach_nothing() -> None:
    mask = pictures()
    mask[:, 70:] = 0
    mapper = trained(mask)
    right = (mapper.map.means[:, 0] / mapper.map.means[:, 2] * 70 + 39.5 > 74).numpy()
    assert right.any() and not mapper.map.object_id.numpy()[right].any()
    assert (shown(mapper)[:, 75:] > 0).mean() < 0.2  # nor does a rendering give all of them to the objects beside


# --- merging, splitting, taking back ----------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 3, 7])
def test_turns_that_are_due_are_those_asked_for_one_by_one(every: int) -> None:
    mapper, single = make_mapper(every=every), make_mapper(every=every)
    for one in (mapper, single):
        one.add_keyframe(wall(), np.eye(4), lambda keyframe, show: KeyframeLabels(pictures()))
    assert mapper.identity is not None and single.identity is not None
    for iterations in (4, 1, 0, 9):
        due = [turn for turn in range(iterations) if single.identity.due(single.keyframes[0])]
        assert list(mapper.identity.due_turns(iterations)) == due
    assert not mapper.identity.due_turns(0)
    without = CpuIdentityLearner(IdentitySettings(every=1))
    assert not without.due_turns(5)


def test_merged_objects_are_one_everywhere() -> None:
    mapper = trained(pictures())
    identity = mapper.identity
    assert identity is not None
    identity.merge(mapper.map, [(2, 300)])
    assert sorted(identity.classifier.class_ids.tolist()) == [1, 2]
    mapper.run(10)
    mapper.finish_identity()
    expected = np.where(pictures() == 300, 2, pictures())
    assert (shown(mapper) == expected).mean() > 0.97 and not (mapper.map.object_id == 300).any()


def test_a_part_that_proves_to_be_an_object_prevails_over_older_masks() -> None:
    whole = np.where(pictures() == 300, 1, pictures()).astype(np.uint16)
    mapper = trained(whole)
    found = KeyframeLabels(pictures(), [], [(1, 300)])
    mapper.add_keyframe(wall(1), np.eye(4), lambda keyframe, show: found)
    mapper.run(60)
    mapper.finish_identity()
    assert (shown(mapper)[20:30, 55:65] == 300).mean() > 0.9
    assert (shown(mapper) == pictures()).mean() > 0.95


def test_forgotten_objects_leave_nothing() -> None:
    mapper = trained(pictures())
    assert mapper.identity is not None
    mapper.identity.forget(mapper.map, [300])
    mapper.finish_identity()
    assert not (mapper.map.object_id == 300).any() and 300 not in mapper.identity.classifier.class_ids
    assert not (mapper.map.vote_ids == 300).any()
    assert np.isin(shown(mapper)[20:30, 55:65], (0, 1)).mean() > 0.9  # nothing or what is around, not any other one


@pytest.mark.parametrize("merged", [True, False])
def test_gaussians_that_were_on_disk_follow_what_became_of_their_objects(merged: bool) -> None:
    mapper = trained(pictures())
    assert mapper.identity is not None
    kept = {name: getattr(mapper.map, name).clone() for name in ("features", "vote_ids", "vote_weights")}
    if merged:
        mapper.identity.merge(mapper.map, [(2, 300)])
    else:
        mapper.identity.forget(mapper.map, [300])
    for name, values in kept.items():
        getattr(mapper.map, name).copy_(values)
    mapper.identity.catch_up_and_label(mapper.map)
    assert np.isin(shown(mapper)[22:28, 57:63], (2,) if merged else (0, 1)).mean() > 0.95
    assert not (mapper.map.object_id == 300).any()


def test_the_map_shows_its_labels_to_the_next_keyframe() -> None:
    mapper = trained(pictures())
    seen = []

    def labeller(keyframe: object, show: object) -> KeyframeLabels:
        seen.append(show())  # type: ignore[operator]
        return KeyframeLabels()

    mapper.add_keyframe(wall(1), np.eye(4), labeller)
    assert (seen[0].ids == pictures()).mean() > 0.93 and seen[0].confidence.mean() > 0.8
    assert np.abs(seen[0].depth - wall().depth).mean() < 0.02


# --- parts ------------------------------------------------------------------------------------------------------------


def with_nothing(logits: torch.Tensor) -> torch.Tensor:
    return torch.cat(
        [logits, torch.full((*logits.shape[:-1], 1), IdentityVectorTuning.nothing_logit, dtype=logits.dtype)], -1
    )


def test_kl_has_the_gradients_of_torch() -> None:
    random = np.random.default_rng(0)
    z, q = random.normal(size=(6, 5)), random.normal(size=(6, 3, 5))
    value, own, others = kl_gradient(z, q)
    a, b = torch.tensor(z, requires_grad=True), torch.tensor(q, requires_grad=True)
    log_p, log_q = torch.log_softmax(with_nothing(a), -1)[:, None], torch.log_softmax(with_nothing(b), -1)
    expected = (log_p.exp() * (log_p - log_q)).sum(-1).mean()
    expected.backward()
    assert value == pytest.approx(expected.item()) and value > 0
    assert np.allclose(own, a.grad) and np.allclose(others, b.grad)


def test_neighbours_follow_the_map() -> None:
    gaussians = GaussianMap(0, 16)

    def insert(x: np.ndarray) -> None:
        n = len(x)
        means = torch.zeros(n, 3)
        means[:, 0] = torch.from_numpy(x)
        gaussians.insert(means, torch.ones(n, 4), torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 3))

    insert(np.arange(100.0))
    index = NeighbourIndex(0.2)
    assert set(index.neighbours(gaussians, np.array([50]), 2)[0]) == {49, 51}
    insert(np.arange(100.0, 110.0))
    index.neighbours(gaussians, np.array([50]), 2)
    assert index.built == 1  # 10 % more: the old tree serves
    insert(np.arange(110.0, 150.0))
    assert set(index.neighbours(gaussians, np.array([149]), 1)[0]) == {148} and index.built == 2
    gaussians.keep(gaussians.means[:, 0] >= 50)  # rows move up
    assert set(index.neighbours(gaussians, np.array([1]), 2)[0]) == {0, 2} and index.built == 3


def test_neighbours_pull_an_unseen_gaussian_along() -> None:
    """A Gaussian that no pixel shows takes the object of those around it."""
    mapper = trained(np.full((60, 80), 1, np.uint16), 1, final_passes=0)
    identity = mapper.identity
    assert identity is not None
    identity.settings = dataclasses.replace(identity.settings, neighbours=NeighbourSettings(every=1, samples=400))
    identity.table.add(np.array([2], np.uint16))
    hidden = mapper.map.means[:40] + 0.001
    rows = mapper.map.insert(
        hidden, torch.ones(40, 4), torch.full((40, 3), -5.0), torch.full((40,), -9.0), torch.zeros(40, 3)
    )
    wrong = identity.table.codes(np.full(40, 2))
    mapper.map.features[rows] = torch.from_numpy(wrong)
    before = identity.classifier.probabilities(wrong)[:, identity.classifier.class_of(1)].mean()
    mapper.run(150)
    after = identity.classifier.probabilities(mapper.map.features[rows].numpy())
    assert after[:, identity.classifier.class_of(1)].mean() > before + 0.3


def test_classes_grow_and_go() -> None:
    table = CpuClassTable(np.random.default_rng(0))
    ids = np.arange(1, 2 * ClassTuning.initial_rows, dtype=np.uint16)
    table.add(ids)
    table.add(np.array([0, 5, 60000], np.uint16))
    assert table.count == len(ids) + 1 and table.classes(np.array([0, 60000])).tolist() == [-1, len(ids)]
    found, _ = table.classifier.labels(table.codes(ids))
    assert np.array_equal(found, ids)
    assert np.allclose(np.linalg.norm(table.codes(ids), axis=1), ClassTuning.code_length, atol=1e-5)
    assert not table.codes(np.array([0, 40000])).any()
    row = table.classifier.weight[-1].copy()
    table.remove(3)
    assert table.classes(np.array([3]))[0] == -1
    assert np.array_equal(table.classifier.weight[table.classifier.class_of(60000)], row)
    table.remove(60000)
    table.remove(int(table.classifier.class_ids[-1]))  # the last one has nobody to take its place
    table.remove(12345)  # never was there
    assert table.classes(np.array([0]))[0] == -1 and table.count == len(ids) - 2
    assert all(table.classifier.class_ids[table.classes(np.array([i]))[0]] == i for i in table.classifier.class_ids)


def test_the_sample_is_balanced_and_its_votes_are_not() -> None:
    ids = np.ones((100, 100), np.uint16)
    ids[40:50, 40:50] = 2
    ids[:, 90:] = 0
    pool = draw_pool(ids, 20000, IdentitySettings(balance=0.5, boundary=0.5), np.random.default_rng(0))
    drawn = ids.reshape(-1)[pool.pixels]
    assert (drawn == 0).sum() == 0
    assert (drawn == 2).mean() > 0.1  # 1.1 % of the labelled pixels
    assert at_boundary(ids).reshape(-1)[pool.pixels].mean() > 0.5
    votes = np.bincount(drawn, pool.vote_weights)
    assert votes[2] / votes.sum() == pytest.approx(100 / 9000, rel=0.1)


def test_members_are_what_the_classifier_takes_for_an_object_rather_than_for_its_rival() -> None:
    rng = np.random.default_rng(0)
    table = CpuClassTable(rng)
    table.add(np.arange(1, 40, dtype=np.uint16))
    asked, features = np.array([7, 21]), rng.normal(0, 0.7, (5000, 16)).astype(np.float32)
    labels = table.classifier.labels(features)[0]
    rows, objects = table.members(features, asked, np.zeros(5000, np.int32))
    taken = np.flatnonzero(np.isin(labels, asked))  # whom the classifier takes for them, whatever the rivals
    assert len(taken) > 50 and np.isin(taken, rows).all()
    np.testing.assert_array_equal(objects[np.isin(rows, taken)], labels[taken])
    # With the likeliest other class as the rival, those are all.
    logits = table.classifier.logits(features)
    logits[:, np.isin(table.classifier.class_ids, asked)] = -np.inf
    rivals = table.classifier.class_ids[logits.argmax(1)].astype(np.int32)
    rows, objects = table.members(features, asked, rivals)
    np.testing.assert_array_equal(rows, taken)
    np.testing.assert_array_equal(objects, labels[taken])


def test_many_merges_at_once_are_those_one_after_another() -> None:
    outcomes = []
    for pairs in ([[(2, 300), (2, 1)]], [[(2, 300)], [(2, 1)]]):
        mapper = trained(pictures())
        assert mapper.identity is not None
        for some in pairs:
            mapper.identity.merge(mapper.map, some)
        labels = mapper.identity.classifier.labels(mapper.map.features.numpy())[0]
        outcomes.append((labels, mapper.map.vote_ids.clone(), mapper.map.vote_weights.clone()))
    assert set(np.unique(outcomes[0][0])) <= {0, 2}
    for first, second in zip(*outcomes, strict=True):
        np.testing.assert_array_equal(np.asarray(first), np.asarray(second))


def test_votes_that_name_one_object_after_a_merge_are_added() -> None:
    gaussians = GaussianMap(0, 16)
    gaussians.insert(torch.zeros(2, 3), torch.ones(2, 4), torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 3))
    gaussians.vote_ids[:] = torch.tensor([[1, 2, 3, 0], [4, 3, 0, 0]])
    gaussians.vote_weights[:] = torch.tensor([[3.0, 2.0, 2.0, 0.0], [1.0, 0.5, 0.0, 0.0]])
    assert vote_labels(gaussians).tolist() == [1, 4]
    alias = torch.arange(65536, dtype=torch.int32)
    alias[3] = 2
    alias[4] = 0
    merge_votes(gaussians, alias)
    assert vote_labels(gaussians).tolist() == [2, 2]
    assert gaussians.vote_weights.sum(1).tolist() == [7.0, 0.5]
