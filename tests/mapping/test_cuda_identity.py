# SPDX-License-Identifier: Apache-2.0
"""Identity learning on a GPU, or emulated, against the CPU's. Both are given the same terms, so that what differs is
not what was rendered."""

from __future__ import annotations

import ctypes
import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from identity_picture import COUNT, HEIGHT, WIDTH, MaskedKeyframe, make_map, picture

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.class_numbers import ClassTuning
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.pixel_pool import draw_pool
from ggslam.mapping.cuda.class_table import CudaClassTuning
from ggslam.mapping.cuda.identity import CudaIdentityLearner, CudaIdentityTuning
from ggslam.mapping.cuda.insertion import NewRows
from ggslam.mapping.identity import IdentityTuning
from ggslam.mapping.identity_settings import IdentitySettings, NeighbourSettings
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.native.loader import NativeContext
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.pixel_terms import CpuPixelTerms
from ggslam.rendering.types import RenderBuffers
from ggslam.system.tuning import overridden

ALONE = NeighbourSettings(weight=0)


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

    def arrays(self, pixels: np.ndarray, capacity: int) -> CpuPixelTerms:
        rows, weights = np.zeros((2, len(pixels), capacity))
        counts = self.counts[pixels]
        used = np.arange(6) < counts[:, None]
        rows[:, :6], weights[:, :6] = self.gaussians[pixels] * used, self.weights[pixels] * used
        return CpuPixelTerms(rows.astype(np.int32), weights.astype(np.float32), counts, self.context)

    def pixel_terms(self, pixels, capacity: int = 48, min_weight: float = 0.0):  # type: ignore[no-untyped-def]
        if isinstance(pixels, np.ndarray):
            return self.arrays(pixels, capacity)
        assert pixels.dtype == torch.int32
        terms = self.arrays(pixels.cpu().numpy(), capacity)
        on_device = CudaPixelTerms.empty(len(pixels), capacity, self.library, self.device)
        for name in ("gaussians", "weights", "counts"):
            getattr(on_device, name).copy_(torch.from_numpy(getattr(terms, name)))
        return on_device


class Both:
    """A learner on the CPU and one on the device, each with a map of the same Gaussians, given the same keyframe."""

    def __init__(self, library: CudaLibrary, mask: np.ndarray | None = None, **changes: object) -> None:
        self.settings = dataclasses.replace(IdentitySettings(every=1, pixels=64, neighbours=ALONE), **changes)  # type: ignore[arg-type]
        self.device = library.whole_device(None)
        self.cpu = CpuIdentityLearner(self.settings, 3)
        self.cuda = CudaIdentityLearner(self.settings, 3, self.device, library)
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
        self.cpu._pools[0], self.cuda._pools[0] = pool, PixelPool(*tensors)

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
    both.cpu._choose_competitors = lambda classes: np.arange(200)  # type: ignore[method-assign]
    both.step(3)
    both.check()
    assert both.cuda.table.count == 200 > ClassTuning.initial_rows


def test_votes_alone_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, schedule="votes")
    both.begin()
    both.step(3)
    both.check(1e-6)
    assert np.isnan(both.cuda.last_loss)


@pytest.mark.parametrize("part", [2**24, 700])
def test_the_dense_schedule_gives_the_gradient_image(cuda_library: CudaLibrary, part: int) -> None:
    with overridden(CudaIdentityTuning, logits_at_once=part):
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
        learner = CudaIdentityLearner(settings, seed, both.device, cuda_library)
        learner.observe(both.mask)
        for _ in range(3):
            learner.step(both.device_map, both.view, both.keyframe, None)  # type: ignore[arg-type]
        runs.append(both.device_map.features.clone())
    assert torch.equal(runs[0], runs[1]) and not torch.equal(runs[0], runs[2])


def test_steps_are_due_where_there_are_masks_and_objects(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    learner = CudaIdentityLearner(IdentitySettings(every=3), 0, device, cuda_library)
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
    both.cuda.merge(both.device_map, [(2, 300)])
    where = [5 * WIDTH + 16, 5 * WIDTH + 3, 0, 23]
    pixels = torch.tensor(where, dtype=torch.int32, device=both.device)
    new, gaussians = NewRows(slice(2, 6), pixels.data_ptr()), both.device_map
    for keyframe, ids in ((both.keyframe, [2, 2, 1, 0]), (MaskedKeyframe(1, None, both.device), [0] * 4)):
        cuda_library.call("birth_labels", ctypes.byref(both.cuda.births(gaussians, keyframe, new)))
        assert gaussians.vote_ids[2:6, 0].tolist() == ids
        assert gaussians.vote_weights[2:6, 0].tolist() == [np.float32(IdentityTuning.birth_vote) * (k > 0) for k in ids]
        codes = both.cuda.table.codes(torch.tensor(ids, device=both.device))
        torch.testing.assert_close(gaussians.features[2:6], codes, atol=1e-6, rtol=0)
        assert bool(codes.any()) == any(ids)


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
    both.cpu.merge(both.map, [(2, 300)])
    both.cuda.merge(both.device_map, [(2, 300)])
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
    for learner, gaussians in ((both.cpu, both.map), (both.cuda, both.device_map)):
        gaussians.vote_ids[:9, 0], gaussians.vote_weights[:9, 0] = 2, 50.0  # as they were on disk meanwhile
        learner.catch_up(gaussians)
    both.check()
    assert not both.map.features[:9].any()
    both.cpu.merge(both.map, [(7, 7)])
    both.cuda.merge(both.device_map, [(7, 7)])
    both.check()


@overridden(CudaClassTuning, logits_at_once=100)
def test_learned_labels_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    """Where votes are not sure. By parts of few Gaussians."""
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


@overridden(CudaIdentityTuning, split_pixels=100)
def test_a_split_is_that_of_the_cpu(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, np.where(picture() == 300, 1, picture()).astype(np.uint16))
    both.begin()
    both.step(2)
    both.observe(picture())
    both.cpu.split(both.map, both.view, picture(), [(1, 300)])  # type: ignore[arg-type]
    both.cuda.split(both.device_map, both.view, picture(), [(1, 300)])  # type: ignore[arg-type]
    both.check()
    assert (both.map.vote_ids == 300).any()
    both.step(3, seed=2)  # on the old mask: the map tells which pixels are the part's
    both.check()
    assert (both.map.vote_weights[both.map.vote_ids == 300] > 0.2).any()


def test_a_map_made_before_is_resumed(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library)
    both.begin()
    both.step(2)
    learner = CudaIdentityLearner(both.settings, 9, both.device, cuda_library)
    learner.resume(both.cpu.classifier)
    assert np.array_equal(learner.classifier.class_ids, both.cpu.classifier.class_ids)
    assert np.array_equal(learner.classifier.weight, both.cpu.classifier.weight)
    assert np.array_equal(learner.classifier.bias, both.cpu.classifier.bias)
    both.cuda = learner
    learner.label(both.device_map)
    both.cpu.label(both.map)
    both.check()


def test_consecutive_parts_of_a_pool_are_used(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CudaIdentityLearner, "kept_pools", 2)
    both = Both(cuda_library)
    others = [MaskedKeyframe(number, both.keyframe.mask, both.device) for number in (1, 2)]
    parts = [both.cuda._draw(both.keyframe)[0] for _ in range(IdentityTuning.pool_steps)]
    assert torch.equal(torch.cat(parts), both.cuda._pools[0].pixels)
    first = both.cuda._pools[0]
    both.cuda._draw(both.keyframe)
    assert both.cuda._pools[0] is not first
    both.cuda._draw(others[0])
    both.cuda._draw(others[1])
    assert list(both.cuda._pools) == [1, 2]
    both.cuda.keep_pools([0, 2])
    assert list(both.cuda._pools) == [2]
