# SPDX-License-Identifier: Apache-2.0
"""Identity learning on a GPU, or emulated, against the CPU's. Both are given the same terms, so that what differs is
not what was rendered."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from device_watch import DeviceWatch

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.class_table import FIRST_CLASSES, ClassTable
from ggslam.mapping.cuda.class_learning import ClassKernels
from ggslam.mapping.cuda.class_table import CudaClassTable
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.pixel_pool import DevicePixelPool, PixelDrawer
from ggslam.mapping.cuda.votes import merge_votes, vote_labels
from ggslam.mapping.identity import IdentityLearner, by_parts, cross_entropy
from ggslam.mapping.identity_objects import IDS
from ggslam.mapping.identity_settings import IdentitySettings, NeighbourSettings
from ggslam.mapping.neighbours import kl_gradient
from ggslam.mapping.pixel_pool import PixelPool, at_boundary, draw_pool
from ggslam.native.loader import NativeContext
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.pixel_terms import PixelTerms
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

HEIGHT, WIDTH = 16, 24
COUNT = 300
ALONE = NeighbourSettings(weight=0)


def picture() -> np.ndarray:
    mask = np.ones((HEIGHT, WIDTH), np.uint16)
    mask[3:12, 2:12] = 2
    mask[5:8, 15:20] = 300
    mask[:, 22:] = 0
    return mask


@dataclass
class View:
    """Terms of each pixel of an image: arrays for the CPU, tensors for the device."""

    library: CudaLibrary
    device: torch.device
    context: NativeContext = field(default_factory=lambda: NativeContext(1))

    def __post_init__(self) -> None:
        random = np.random.default_rng(5)
        pixel = np.arange(HEIGHT * WIDTH)
        places = pixel * COUNT // len(pixel)  # neighbours share Gaussians
        near = random.permuted(np.tile(np.arange(8), (len(pixel), 1)), axis=1)
        self.gaussians = (places[:, None] + near[:, :6]) % COUNT
        self.weights = random.uniform(0.01, 0.16, (len(pixel), 6)).astype(np.float32)
        self.counts = random.integers(0, 7, len(pixel)).astype(np.int32)

    def arrays(self, pixels: np.ndarray, capacity: int) -> PixelTerms:
        rows, weights = np.zeros((2, len(pixels), capacity))
        counts = self.counts[pixels]
        used = np.arange(6) < counts[:, None]
        rows[:, :6], weights[:, :6] = self.gaussians[pixels] * used, self.weights[pixels] * used
        return PixelTerms(rows.astype(np.int32), weights.astype(np.float32), counts, self.context)

    def pixel_terms(self, pixels, capacity: int = 48, min_weight: float = 0.0):  # type: ignore[no-untyped-def]
        if isinstance(pixels, np.ndarray):
            return self.arrays(pixels, capacity)
        assert pixels.dtype == torch.int32
        terms = self.arrays(pixels.cpu().numpy(), capacity)
        on_device = CudaPixelTerms.empty(len(pixels), capacity, self.library, self.device)
        for name in ("gaussians", "weights", "counts"):
            getattr(on_device, name).copy_(torch.from_numpy(getattr(terms, name)))
        return on_device


@dataclass
class MaskedKeyframe:
    index: int
    mask: np.ndarray | None
    device: torch.device

    def __post_init__(self) -> None:
        self.device_mask = None if self.mask is None else torch.from_numpy(self.mask).to(self.device)


def near(points: torch.Tensor, rows: torch.Tensor, k: int, library: CudaLibrary) -> torch.Tensor:
    return torch.cdist(points[rows], points).topk(k + 1, largest=False).indices[:, 1:]


def make_map(device: torch.device | str, count: int = COUNT) -> GaussianMap:
    gaussians = GaussianMap(0, 16, torch.device(device))
    means = torch.from_numpy(np.random.default_rng(3).normal(size=(count, 3)).astype(np.float32)).to(device)
    other = [torch.zeros(count, *shape, device=device) for shape in ((4,), (3,), (), (3,))]
    gaussians.insert(means, *other)
    return gaussians


class Both:
    """A learner on the CPU and one on the device, each with a map of the same Gaussians, given the same keyframe."""

    def __init__(self, library: CudaLibrary, mask: np.ndarray | None = None, **changes: object) -> None:
        self.settings = dataclasses.replace(IdentitySettings(every=1, pixels=64, neighbours=ALONE), **changes)  # type: ignore[arg-type]
        self.device = library.whole_device(None)
        self.cpu = IdentityLearner(self.settings, 3)
        self.cuda = CudaIdentityLearner(self.settings, 3, self.device, library, near)
        self.map, self.device_map = make_map("cpu"), make_map(self.device)
        self.view = View(library, self.device)
        self.mask = picture() if mask is None else mask
        self.keyframe = MaskedKeyframe(0, self.mask, self.device)
        self.observe(self.mask)

    def observe(self, mask: np.ndarray) -> None:
        self.cpu.observe(mask)
        self.cuda.observe(mask)

    def begin(self) -> None:
        labels = np.random.default_rng(1).choice(self.mask.reshape(-1), COUNT)
        self.cpu.begin(self.map, slice(0, COUNT), labels)
        self.cuda.begin(self.device_map, slice(0, COUNT), torch.from_numpy(labels.astype(np.int32)).to(self.device))

    def give_pool(self, steps: int, seed: int = 0) -> None:
        """Both will use the same pixels in their next steps."""
        pool = draw_pool(self.mask, steps * self.settings.pixels, self.settings, np.random.default_rng(seed))
        tensors = torch.from_numpy(pool.pixels).to(self.device), torch.from_numpy(pool.vote_weights).to(self.device)
        self.cpu._pools[0], self.cuda._pools[0] = pool, DevicePixelPool(*tensors)

    def step(self, steps: int, seed: int = 0) -> None:
        self.give_pool(steps, seed)
        for _ in range(steps):
            assert self.cpu.step(self.map, self.view, self.keyframe, None, 0.5) is None
            assert self.cuda.step(self.device_map, self.view, self.keyframe, None, 0.5) is None

    def check(self, tolerance: float = 1e-5) -> None:
        for name in ("features", "vote_weights"):
            found, expected = getattr(self.device_map, name).cpu(), getattr(self.map, name)
            assert torch.allclose(found, expected, rtol=tolerance, atol=tolerance), name
        for name in ("vote_ids", "object_id", "feature_updates"):
            assert torch.equal(getattr(self.device_map, name).cpu(), getattr(self.map, name)), name
        found, expected = self.cuda.classifier, self.cpu.classifier
        assert np.array_equal(found.class_ids, expected.class_ids)
        assert np.allclose(found.weight, expected.weight, atol=tolerance)
        assert np.allclose(found.bias, expected.bias, atol=tolerance)


# --- steps ------------------------------------------------------------------------------------------------------------


def test_steps_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    both.begin()
    both.check(1e-6)
    before = both.map.features.clone()
    for seed in range(2):
        both.step(4, seed)
    both.check()
    assert (both.map.features - before).abs().max() > 0.1 and (both.map.vote_weights > 0.2).any()
    assert both.cuda.last_loss == pytest.approx(both.cpu.last_loss, rel=1e-4)
    assert both.cuda.times.count == 8 and both.cuda.times.steps > 0


def test_many_classes_compete_all_at_once(cuda_library: CudaLibrary) -> None:
    mask = (np.arange(HEIGHT * WIDTH) % 200 + 1).reshape(HEIGHT, WIDTH).astype(np.uint16)
    both = Both(cuda_library, mask)
    both.begin()
    both.cpu._competing = lambda classes: np.arange(200)  # type: ignore[method-assign]
    both.step(3)
    both.check()
    assert both.cuda.table.count == 200 > FIRST_CLASSES


def test_votes_alone_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, schedule="votes")
    both.begin()
    both.step(3)
    both.check(1e-6)
    assert np.isnan(both.cuda.last_loss)


@pytest.mark.parametrize("part", [2**24, 700])
def test_the_dense_schedule_gives_the_gradient_image(
    cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch, part: int
) -> None:
    monkeypatch.setattr("ggslam.mapping.cuda.identity.LOGITS_AT_ONCE", part)
    both = Both(cuda_library, schedule="dense", weight=1.0)
    both.begin()
    features = torch.from_numpy(np.random.default_rng(2).normal(size=(16, HEIGHT, WIDTH)).astype(np.float32))
    empty = torch.zeros(0)
    for _ in range(3):
        both.give_pool(1)
        expected = both.cpu.step(both.map, both.view, both.keyframe, RenderBuffers(empty, empty, empty, features))
        on_device = RenderBuffers(empty, empty, empty, features.to(both.device))
        found = both.cuda.step(both.device_map, both.view, both.keyframe, on_device)
        assert found is not None and expected is not None and expected.abs().max() > 1e-5
        assert torch.allclose(found.cpu(), expected, atol=1e-7)
    both.check()


def test_neighbours_are_pulled_together_as_on_the_cpu(
    cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = Both(cuda_library, neighbours=NeighbourSettings(every=2, samples=40, neighbours=3))
    both.begin()
    both.device_map.features.copy_(both.map.features.normal_(generator=torch.Generator().manual_seed(0)))
    rows = np.random.default_rng(0).integers(0, COUNT, 40)
    given = torch.from_numpy(rows).to(both.device)
    monkeypatch.setattr(torch, "randint", lambda size, shape, **_: given)
    monkeypatch.setattr(both.cpu, "_rng", type("Given", (), {"integers": staticmethod(lambda *_: rows)}))
    expected_rows, expected = both.cpu._pull_together(both.map)
    found_rows, found = both.cuda._pull_together(both.device_map)
    assert np.array_equal(found_rows.cpu(), expected_rows)
    assert np.allclose(found.cpu(), expected, rtol=1e-4, atol=1e-7) and np.abs(expected).max() > 1e-4
    both.step(3)
    both.check()


def test_a_seed_repeats_and_another_does_not(cuda_library: CudaLibrary) -> None:
    runs = []
    for seed in (0, 0, 1):
        both = Both(cuda_library)
        pull = NeighbourSettings(every=1, samples=20, neighbours=2)
        settings = dataclasses.replace(both.settings, neighbours=pull)
        learner = CudaIdentityLearner(settings, seed, both.device, cuda_library, near)
        learner.observe(both.mask)
        for _ in range(3):
            learner.step(both.device_map, both.view, both.keyframe, None)  # type: ignore[arg-type]
        runs.append(both.device_map.features.clone())
    assert torch.equal(runs[0], runs[1]) and not torch.equal(runs[0], runs[2])


def test_steps_are_due_where_there_are_masks_and_objects(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    learner = CudaIdentityLearner(IdentitySettings(every=3), 0, device, cuda_library, near)
    masked, bare = MaskedKeyframe(0, picture(), device), MaskedKeyframe(1, None, device)
    assert not any(learner.due(masked) for _ in range(6))
    learner.observe(picture())
    assert [learner.due(masked) for _ in range(6)] == [False, False, True] * 2
    assert not any(learner.due(bare) for _ in range(6))


# --- nothing to learn from --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", ["sampled", "dense", "votes"])
def test_a_mask_without_objects_changes_nothing(cuda_library: CudaLibrary, schedule: str) -> None:
    pull = NeighbourSettings(every=1, samples=20) if schedule == "sampled" else ALONE
    both = Both(cuda_library, schedule=schedule, neighbours=pull)
    both.begin()
    both.step(1) if schedule != "dense" else None  # moments that would carry on by themselves
    features, rows = both.device_map.features.clone(), both.cuda.table.rows.clone()
    votes, updates = both.device_map.vote_weights.clone(), both.device_map.feature_updates.clone()
    empty, image = torch.zeros(0), torch.ones(16, HEIGHT, WIDTH, device=both.device)
    view = RenderBuffers(empty, empty, empty, image)
    unlabelled = MaskedKeyframe(1, np.zeros((HEIGHT, WIDTH), np.uint16), both.device)
    gradient = both.cuda.step(both.device_map, both.view, unlabelled, view)
    assert gradient is None or not gradient.any()
    assert torch.equal(both.device_map.features, features) and torch.equal(both.cuda.table.rows, rows)
    assert torch.equal(both.device_map.vote_weights, votes)
    assert torch.equal(both.device_map.feature_updates, updates)


def test_pixels_drawn_before_their_objects_were_forgotten_change_nothing(cuda_library: CudaLibrary) -> None:
    pull = NeighbourSettings(every=1, samples=20)
    both = Both(cuda_library, np.where(picture() == 300, 300, 0).astype(np.uint16), neighbours=pull)
    both.observe(picture())
    both.begin()
    both.step(2)
    both.give_pool(1)
    both.cuda.forget(both.device_map, [300])
    before, rows = both.device_map.features.clone(), both.cuda.table.rows.clone()
    both.cuda.step(both.device_map, both.view, both.keyframe, None)  # type: ignore[arg-type]
    assert torch.equal(both.device_map.features, before) and torch.equal(both.cuda.table.rows, rows)


def test_new_gaussians_have_the_objects_of_their_pixels(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    both.cuda.merge(both.device_map, 2, 300)
    pixels = torch.tensor([5 * WIDTH + 16, 5 * WIDTH + 3, 0, 23], device=both.device)
    assert both.cuda.labels_at(both.keyframe, pixels).tolist() == [2, 2, 1, 0]
    assert both.cuda.labels_at(MaskedKeyframe(1, None, both.device), pixels).tolist() == [0] * 4


def test_new_gaussians_may_begin_at_random(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, initialisation="random")
    both.begin()
    spread = both.device_map.features.std().item()
    assert spread == pytest.approx(both.map.features.std().item(), rel=0.05)
    assert torch.equal(both.device_map.vote_ids.cpu(), both.map.vote_ids)


# --- objects ----------------------------------------------------------------------------------------------------------


def test_merges_removals_and_labels_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    both.begin()
    both.step(3)
    for gaussians in (both.map, both.device_map):
        gaussians.features[:9] = torch.from_numpy(both.cpu.table.codes(np.full(9, 300))).to(gaussians.device)
        gaussians.vote_weights[:6] = 0  # learned, but never seen
    both.cpu.merge(both.map, 2, 300)
    both.cuda.merge(both.device_map, 2, 300)
    both.check()
    assert torch.allclose(both.map.features[:6], torch.from_numpy(both.cpu.table.codes(np.full(6, 2))))
    assert 300 not in both.cuda.classifier.class_ids and np.array_equal(both.cuda.current(np.array([300])), [2])
    both.step(2, seed=1)
    both.check()
    for learner, gaussians in ((both.cpu, both.map), (both.cuda, both.device_map)):
        learner.observe(np.full((HEIGHT, WIDTH), 7, np.uint16))
        learner.forget(gaussians, [2])
        learner.label(gaussians)
    both.check()
    assert set(both.map.object_id.unique().tolist()) == {0, 1}
    both.cpu.merge(both.map, 7, 7)
    both.cuda.merge(both.device_map, 7, 7)
    both.check()


def test_learned_labels_are_those_of_the_cpu(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where votes are not sure. By parts of few Gaussians."""
    monkeypatch.setattr("ggslam.mapping.cuda.class_table._LOGITS_AT_ONCE", 100)
    both = Both(cuda_library, min_confidence=0.7)
    both.begin()
    both.step(4)
    for gaussians in (both.map, both.device_map):
        gaussians.vote_ids[:, 1:3] = torch.tensor([40, 41], dtype=torch.int32, device=gaussians.device)
        gaussians.vote_weights[:200, 1:3] = gaussians.vote_weights[:200, :1]
    both.cpu.label(both.map)
    both.cuda.label(both.device_map)
    both.check()
    assert len(both.map.object_id[:200].unique()) > 2


def test_a_split_is_that_of_the_cpu(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ggslam.mapping.cuda.identity.SPLIT_PIXELS", 100)
    both = Both(cuda_library, np.where(picture() == 300, 1, picture()).astype(np.uint16))
    both.begin()
    both.step(2)
    both.observe(picture())
    both.cpu.split(both.map, both.view, picture(), 1, 300)  # type: ignore[arg-type]
    both.cuda.split(both.device_map, both.view, picture(), 1, 300)  # type: ignore[arg-type]
    both.check()
    assert (both.map.vote_ids == 300).any()
    both.step(3, seed=2)  # on the old mask: the map tells which pixels are the part's
    both.check()
    assert (both.map.vote_weights[both.map.vote_ids == 300] > 0.2).any()


def test_a_map_made_before_is_resumed(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    both.begin()
    both.step(2)
    learner = CudaIdentityLearner(both.settings, 9, both.device, cuda_library, near)
    learner.resume(both.cpu.classifier)
    assert np.array_equal(learner.classifier.class_ids, both.cpu.classifier.class_ids)
    assert np.array_equal(learner.classifier.weight, both.cpu.classifier.weight)
    assert np.array_equal(learner.classifier.bias, both.cpu.classifier.bias)
    both.cuda = learner
    learner.label(both.device_map)
    both.cpu.label(both.map)
    both.check()


def test_votes_that_name_one_object_after_a_merge_are_added(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians = make_map(device, 2)
    gaussians.vote_ids[:] = torch.tensor([[1, 2, 3, 0], [4, 3, 0, 0]])
    gaussians.vote_weights[:] = torch.tensor([[3.0, 2.0, 2.0, 0.0], [1.0, 0.5, 0.0, 0.0]])
    assert vote_labels(gaussians).tolist() == [1, 4]
    alias = torch.arange(IDS, dtype=torch.int32, device=device)
    alias[3], alias[4] = 2, 0
    merge_votes(gaussians, alias)
    assert vote_labels(gaussians).tolist() == [2, 2]
    assert gaussians.vote_weights.sum(1).tolist() == [7.0, 0.5]


# --- parts ------------------------------------------------------------------------------------------------------------


def test_classes_grow_and_go_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    cpu = ClassTable(np.random.default_rng(0))
    cuda = CudaClassTable(np.random.default_rng(0), ClassKernels(device, cuda_library))
    ids = np.arange(1, 2 * FIRST_CLASSES, dtype=np.uint16)
    for table in (cpu, cuda):
        table.add(ids)
        table.add(np.array([0, 5, 60000], np.uint16))
        table.remove(3)
        table.remove(60000)
        table.remove(12345)  # never was there
    assert cuda.count == cpu.count == len(ids) - 1
    assert np.array_equal(cuda.classifier.class_ids, cpu.classifier.class_ids)
    assert np.array_equal(cuda.classifier.weight, cpu.classifier.weight)
    asked = np.array([0, 3, 4, 199, 60000])
    codes = cuda.codes(torch.from_numpy(asked.astype(np.int32)).to(device)).cpu()
    assert np.allclose(codes, cpu.codes(asked), atol=1e-6) and codes[2].norm() > 1
    assert np.array_equal(cuda.class_of.cpu()[asked], cpu.classes(asked))
    assert np.array_equal(cuda.ids.cpu(), cpu.classifier.class_ids)


@pytest.mark.parametrize("at_once", [2**24, 50])
def test_vectors_have_the_labels_of_the_cpu(
    cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr("ggslam.mapping.cuda.class_table._LOGITS_AT_ONCE", at_once)
    random, device = np.random.default_rng(0), cuda_library.whole_device(None)
    table = CudaClassTable(random, ClassKernels(device, cuda_library))
    vectors = (0.4 * random.normal(size=(500, 16))).astype(np.float32)
    assert not table.labels(torch.from_numpy(vectors).to(device)).any()
    table.add(np.arange(1, 8, dtype=np.uint16))
    for confidence in (0.0, 0.5):
        expected = by_parts(table.classifier, vectors, confidence)
        assert np.array_equal(table.labels(torch.from_numpy(vectors).to(device), confidence).cpu(), expected)
        assert 0.1 < (expected == 0).mean() < 0.9


@pytest.mark.parametrize("classes", [1, 31, 70])
def test_cross_entropy_has_the_gradients_of_the_cpu(cuda_library: CudaLibrary, classes: int) -> None:
    random, device = np.random.default_rng(0), cuda_library.whole_device(None)
    table = CudaClassTable(random, ClassKernels(device, cuda_library))
    table.add(np.arange(1, classes + 1, dtype=np.uint16))
    features = random.normal(size=(45, 16)).astype(np.float32)
    targets = random.integers(0, classes, 45).astype(np.int32)
    targets[::5] = -1
    known = targets >= 0
    loss, gradient, rows = cross_entropy(features[known], table.classifier, targets[known], np.arange(classes))
    losses = torch.empty(45, device=device)
    count = torch.tensor([known.sum()], dtype=torch.int32, device=device)
    on_device = torch.from_numpy(features).to(device), torch.from_numpy(targets).to(device)
    found, found_rows = table.cross_entropy(*on_device, count, losses, 1.0)
    assert float(losses.sum() / known.sum()) == pytest.approx(loss, rel=1e-5)
    assert np.allclose(found.cpu()[known], gradient, atol=1e-6) and not found.cpu()[~known].any()
    assert np.allclose(found_rows.cpu(), rows, atol=1e-6)


@pytest.mark.parametrize("classes", [1, 40])
def test_kl_has_the_gradients_of_the_cpu(cuda_library: CudaLibrary, classes: int) -> None:
    random, device = np.random.default_rng(0), cuda_library.whole_device(None)
    logits = random.normal(size=(13 * 4, classes)).astype(np.float32)
    _, own, others = kl_gradient(logits[:13], logits[13:].reshape(13, 3, classes))
    found = ClassKernels(device, cuda_library).neighbour_loss(torch.from_numpy(logits).to(device), 13, 2.0).cpu()
    assert np.allclose(found[:13], 2 * own, atol=1e-6)
    assert np.allclose(found[13:], 2 * others.reshape(-1, classes), atol=1e-6)


# --- the draw ---------------------------------------------------------------------------------------------------------


def drawn(library: CudaLibrary, mask: np.ndarray, wanted: int, **changes: float) -> PixelPool:
    device = library.whole_device(None)
    drawer = PixelDrawer(device, library, 7)
    alias = torch.arange(IDS, dtype=torch.int32, device=device)
    alias[301] = 300
    settings = dataclasses.replace(IdentitySettings(), **changes)  # type: ignore[arg-type]
    pool = drawer.draw(torch.from_numpy(mask).to(device), alias, wanted, settings)
    return PixelPool(pool.pixels.cpu().numpy(), pool.vote_weights.cpu().numpy())


@pytest.mark.parametrize("balance,boundary", [(0.5, 0.5), (0.0, 0.0), (1.0, 1.0), (0.8, 0.3)])
def test_pixels_are_drawn_as_on_the_cpu(cuda_library: CudaLibrary, balance: float, boundary: float) -> None:
    changes = {"balance": balance, "boundary": boundary}
    mask, wanted = picture(), 60000
    split = mask.copy()
    split[5:8, 17:20] = np.where(split[5:8, 17:20] == 300, 301, split[5:8, 17:20])  # one object by the alias
    found = drawn(cuda_library, split, wanted, **changes)
    settings = dataclasses.replace(IdentitySettings(), **changes)
    expected = draw_pool(mask, wanted, settings, np.random.default_rng(0))
    often, expected_often = (np.bincount(pool.pixels, minlength=mask.size) for pool in (found, expected))
    assert not often[mask.reshape(-1) == 0].any()
    assert (np.abs(often - expected_often) < 6 * np.sqrt(often + expected_often + 1)).all()
    weight = dict(zip(expected.pixels.tolist(), expected.vote_weights.tolist(), strict=True))
    assert np.allclose(found.vote_weights, [weight[p] for p in found.pixels.tolist()], rtol=0.03)
    assert found.vote_weights.mean() == pytest.approx(1, rel=1e-4)


def test_the_draw_does_not_depend_on_the_order_of_threads(cuda_library: CudaLibrary) -> None:
    if cuda_library.device_type == "cuda":
        pytest.skip("the order cannot be chosen on a GPU")
    expected = drawn(cuda_library, picture(), 500)
    for order in (1, 2):
        cuda_library.functions.ggslam_emulation_order(order)
        found = drawn(cuda_library, picture(), 500)
        cuda_library.functions.ggslam_emulation_order(0)
        assert np.array_equal(found.pixels, expected.pixels)
        assert np.array_equal(found.vote_weights, expected.vote_weights)


def test_an_image_without_boundaries_is_drawn_from_anywhere(cuda_library: CudaLibrary) -> None:
    pool = drawn(cuda_library, np.full((HEIGHT, WIDTH), 9, np.uint16), 20000)
    assert np.bincount(pool.pixels, minlength=HEIGHT * WIDTH).min() > 10
    assert np.allclose(pool.vote_weights, 1, atol=1e-5)


def test_of_an_unlabelled_image_no_labelled_pixels_are_drawn(cuda_library: CudaLibrary) -> None:
    pool = drawn(cuda_library, np.zeros((HEIGHT, WIDTH), np.uint16), 100)
    assert (pool.pixels >= 0).all() and (pool.pixels < HEIGHT * WIDTH).all() and not pool.vote_weights.any()


def test_consecutive_parts_of_a_pool_are_used(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    mask = both.keyframe.device_mask
    assert mask is not None and not at_boundary(np.ones((3, 3))).any()
    parts = [both.cuda._draw(0, mask)[0] for _ in range(8)]
    assert torch.equal(torch.cat(parts), both.cuda._pools[0].pixels)
    first = both.cuda._pools[0]
    both.cuda._draw(0, mask)
    assert both.cuda._pools[0] is not first
    both.cuda._draw(1, mask)
    both.cuda.keep_pools([1])
    assert list(both.cuda._pools) == [1]


# --- with a rasterizer ------------------------------------------------------------------------------------------------

CAMERA = Camera(WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)


def wall(device: torch.device | str) -> GaussianMap:
    """A Gaussian at every second pixel and row, 2 m away."""
    u, v = np.meshgrid(np.arange(0.5, WIDTH, 2), np.arange(0.5, HEIGHT, 2))
    z = np.full(u.size, 2.0)
    means = np.stack([(u.reshape(-1) - CAMERA.cx) / 10, (v.reshape(-1) - CAMERA.cy) / 10, z], 1).astype(np.float32)
    gaussians, count = GaussianMap(0, 16, torch.device(device)), len(means)
    quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    parameters = [torch.from_numpy(means), quaternions, torch.full((count, 3), -2.3), torch.full((count,), 3.0)]
    gaussians.insert(*(parameter.to(device) for parameter in parameters), torch.zeros(count, 3, device=device))
    return gaussians


def test_objects_are_learned(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    settings = IdentitySettings(every=1, pixels=128, neighbours=NeighbourSettings(samples=40))
    learner = CudaIdentityLearner(settings, 0, device, cuda_library)
    gaussians, rasterizer = wall(device), CudaRasterizer(device, library=cuda_library)
    keyframe = MaskedKeyframe(0, picture(), device)
    learner.observe(picture())
    unknown = torch.zeros(len(gaussians), dtype=torch.int32, device=device)
    learner.begin(gaussians, slice(0, len(gaussians)), unknown)
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=False)
    for _ in range(25):
        assert learner.due(keyframe)
        learner.step(gaussians, rasterizer, keyframe, view)
    learner.label(gaussians)
    expected = picture()[::2, ::2].reshape(-1)
    assert (gaussians.object_id.cpu().numpy() == expected).mean() > 0.8  # some stand at a boundary
    shown = rasterizer.forward(gaussians, CAMERA, np.eye(4)).features
    assert shown is not None
    ids, _ = learner.classifier.labels(shown.cpu().numpy().transpose(1, 2, 0))
    assert (ids == picture())[picture() > 0].mean() > 0.9
    assert learner.last_loss < 0.7


@pytest.mark.parametrize("schedule", ["sampled", "dense", "votes"])
def test_a_step_waits_for_nothing(schedule: str) -> None:
    with DeviceWatch() as watch:
        pull = NeighbourSettings(samples=20, every=2)
        settings = IdentitySettings(schedule=schedule, every=1, pixels=64, neighbours=pull)  # type: ignore[arg-type]
        learner = CudaIdentityLearner(settings, library=watch.library)
        gaussians, rasterizer = wall("cuda"), CudaRasterizer(library=watch.library)
        keyframe = MaskedKeyframe(0, picture(), learner.device)
        learner.observe(picture())
        learner.begin(gaussians, slice(0, len(gaussians)), torch.ones(len(gaussians), dtype=torch.int32, device="cuda"))
        view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=schedule == "dense")
        learner.split(gaussians, rasterizer, picture(), 1, 300)
        watch.forget()
        for _ in range(4):
            assert learner.due(keyframe)
            learner.step(gaussians, rasterizer, keyframe, view)
        assert watch.waits == [] and watch.uploads == [] and watch.downloads == []
        names = {call.operation for call in watch.calls}
        assert "draw_pixels" in names and ("cross_entropy" in names) == (schedule != "votes")
        assert np.isfinite(learner.last_loss) == (schedule != "votes") and bool(watch.waits) == (schedule != "votes")
        learner.merge(gaussians, 1, 2)
        learner.forget(gaussians, [300])
        learner.label(gaussians)
        assert set(watch.read(gaussians.object_id).tolist()) == {1}
