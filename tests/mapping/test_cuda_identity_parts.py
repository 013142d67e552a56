# SPDX-License-Identifier: Apache-2.0
"""The parts of identity learning on a GPU, or emulated, against the CPU's: votes, classes, losses, drawn pixels."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from identity_picture import HEIGHT, WIDTH, picture

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.class_numbers import ClassTuning
from ggslam.mapping.cpu.class_table import CpuClassTable
from ggslam.mapping.cpu.cross_entropy import cross_entropy
from ggslam.mapping.cpu.identity import by_parts
from ggslam.mapping.cpu.neighbours import kl_gradient
from ggslam.mapping.cpu.pixel_pool import draw_pool
from ggslam.mapping.cuda.class_learning import ClassKernels
from ggslam.mapping.cuda.class_table import CudaClassTable, CudaClassTuning
from ggslam.mapping.cuda.pixel_pool import PixelDrawer
from ggslam.mapping.identity import IDS
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.mapping.votes import merge_votes, vote_labels
from ggslam.native.loader import NativeContext
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import overridden


def test_votes_that_name_one_object_after_a_merge_are_added(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians = GaussianMap(0, 16, device)
    gaussians.insert(*(torch.zeros(2, *shape, device=device) for shape in ((3,), (4,), (3,), (), (3,))))
    gaussians.vote_ids[:] = torch.tensor([[1, 2, 3, 0], [4, 3, 0, 0]])
    gaussians.vote_weights[:] = torch.tensor([[3.0, 2.0, 2.0, 0.0], [1.0, 0.5, 0.0, 0.0]])
    assert vote_labels(gaussians).tolist() == [1, 4]
    alias = torch.arange(IDS, dtype=torch.int32, device=device)
    alias[3], alias[4] = 2, 0
    merge_votes(gaussians, alias)
    assert vote_labels(gaussians).tolist() == [2, 2]
    assert gaussians.vote_weights.sum(1).tolist() == [7.0, 0.5]


# --- classes and losses ---------------------------------------------------------------------------------------------


def test_classes_grow_and_go_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    cpu = CpuClassTable(np.random.default_rng(0))
    cuda = CudaClassTable(np.random.default_rng(0), ClassKernels(device, cuda_library))
    ids = np.arange(1, 2 * ClassTuning.initial_rows, dtype=np.uint16)
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
def test_vectors_have_the_labels_of_the_cpu(cuda_library: CudaLibrary, at_once: int) -> None:
    with overridden(CudaClassTuning, logits_at_once=at_once):
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
    loss, gradient, rows = cross_entropy(features, table.classifier, targets, np.arange(classes), NativeContext(1))
    losses = torch.empty(45, device=device)
    count = torch.tensor([known.sum()], dtype=torch.int32, device=device)
    on_device = torch.from_numpy(features).to(device), torch.from_numpy(targets).to(device)
    found, found_rows = table.cross_entropy(*on_device, count, losses, 1.0)
    assert float(losses.sum() / known.sum()) == pytest.approx(loss, rel=1e-5)
    assert np.allclose(found.cpu(), gradient, atol=1e-6) and not found.cpu()[~known].any()
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
