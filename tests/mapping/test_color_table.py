# SPDX-License-Identifier: Apache-2.0
"""Objects as colours: the classifier is the nearest colour, and the loss is L1."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.mapping.cpu.color_table import ColorTable, color_loss
from ggslam.scene.id_colors import id_palette
from ggslam.scene.identity import IdentityClassifier

IDS = np.array([3, 700, 12, 5, 65535], np.uint16)


def make_table() -> ColorTable:
    table = ColorTable(np.random.default_rng(0))
    table.add(IDS[:2])
    table.add(IDS[1:])
    return table


def nearest(colors: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Id of the nearest colour of a palette [P, 3], that of no object among them."""
    candidates = np.append(ids, np.uint16(0))
    palette = id_palette()[candidates].astype(float) / 255
    return candidates[((colors[:, None] - palette) ** 2).sum(2).argmin(1)]


def test_the_classifier_is_the_nearest_colour() -> None:
    table, random = make_table(), np.random.default_rng(1)
    colors = random.random((5000, 3))
    features = random.normal(size=(5000, 16)).astype(np.float32)  # the other channels say nothing
    features[:, :3] = colors - id_palette()[0] / 255
    assert (table.classifier.labels(features)[0] == nearest(colors, IDS)).mean() > 0.999
    table.remove(700)
    table.add(np.array([40], np.uint16))
    rest = np.array([3, 12, 5, 65535, 40], np.uint16)
    assert (table.classifier.labels(features)[0] == nearest(colors, rest)).mean() > 0.999
    assert not table.classifier.labels(np.zeros((3, 16), np.float32))[0].any()


def test_codes_are_the_colours_and_are_told_with_certainty() -> None:
    table = make_table()
    codes = table.codes(np.array([*IDS, 4, 0], np.uint16))
    assert np.allclose(255 * codes[:5, :3], id_palette()[IDS].astype(int) - id_palette()[0], atol=1e-4)
    assert not codes[5:].any() and not codes[:, 3:].any()
    ids, confidence = table.classifier.labels(codes[:5])
    assert np.array_equal(ids, IDS) and confidence.min() > 0.9


def test_training_and_an_earlier_map_change_no_colour() -> None:
    table = make_table()
    before = table.classifier.to_bytes()
    table.step(np.arange(5), np.ones((5, 17), np.float32), 0.1)
    trained = IdentityClassifier(IDS, np.ones((5, 16), np.float32), np.ones(5, np.float32))
    table.resume(trained)
    assert table.classifier.to_bytes() == before


def test_the_loss_has_the_gradient_of_torch() -> None:
    random = np.random.default_rng(2)
    features, codes = (random.normal(size=(40, 16)).astype(np.float32) for _ in range(2))
    loss, gradient = color_loss(features, codes)
    x = torch.from_numpy(features).requires_grad_()
    expected = torch.nn.functional.l1_loss(x[:, :3], torch.from_numpy(codes)[:, :3])
    expected.backward()
    assert abs(loss - expected.item()) < 1e-6 and np.allclose(gradient, x.grad, atol=1e-8)
    assert color_loss(features[:0], codes[:0])[0] == 0.0
