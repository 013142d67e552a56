# SPDX-License-Identifier: Apache-2.0
"""The cross-entropy of pixels against torch's, on every instruction set."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.errors import CoreInputError, RenderError
from ggslam.mapping.cpu.cross_entropy import cross_entropy
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning


def make_classifier(classes: int, channels: int = 16, size: float = 1.0) -> IdentityClassifier:
    random = np.random.default_rng(classes)
    weight = (size * random.normal(size=(classes, channels))).astype(np.float32)
    return IdentityClassifier(
        np.arange(1, classes + 1, dtype=np.uint16), weight, random.normal(size=classes).astype(np.float32)
    )


def by_torch(
    features: np.ndarray, classifier: IdentityClassifier, classes: np.ndarray, chosen: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """In double precision."""
    parts = (features, classifier.weight[chosen], classifier.bias[chosen])
    f, w, b = (torch.tensor(part, dtype=torch.float64, requires_grad=True) for part in parts)
    logits = f @ w.T + b
    logits = torch.cat([logits, torch.full((len(f), 1), IdentityVectorTuning.nothing_logit, dtype=torch.float64)], 1)
    true = torch.from_numpy(np.where(classes >= 0, np.searchsorted(chosen, classes), -100))
    loss = torch.nn.functional.cross_entropy(logits, true)
    loss.backward()
    assert f.grad is not None and w.grad is not None and b.grad is not None
    return float(loss.detach()), f.grad.numpy(), np.concatenate([w.grad.numpy(), b.grad.numpy()[:, None]], 1)


@pytest.mark.parametrize("instruction_set", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize(
    ("pixels", "classes", "channels", "size"), [(1, 1, 16, 1), (257, 5, 16, 1), (700, 300, 16, 10), (45, 31, 7, 1)]
)
def test_gradients_are_those_of_torch(
    instruction_set: str, pixels: int, classes: int, channels: int, size: float
) -> None:
    if instruction_set not in available_instruction_sets():
        pytest.skip(f"this processor has no {instruction_set}")
    random, classifier = np.random.default_rng(0), make_classifier(classes, channels, size)
    features = random.normal(size=(pixels, channels)).astype(np.float32)
    true = random.integers(0, classes, pixels)
    true[1::3] = -1
    chosen = np.arange(classes)
    loss, gradient, rows = cross_entropy(features, classifier, true, chosen, NativeContext(2, instruction_set))
    expected, expected_gradient, expected_rows = by_torch(features, classifier, true, chosen)
    assert loss == pytest.approx(expected, rel=1e-5)
    assert np.allclose(gradient, expected_gradient, atol=2e-6 * size) and not gradient[1::3].any()
    assert np.allclose(rows, expected_rows, atol=2e-6)
    alone = cross_entropy(features, classifier, true, chosen, NativeContext(1, instruction_set))
    assert np.array_equal(alone[1], gradient) and np.array_equal(alone[2], rows) and alone[0] == loss


def test_some_classes_compete() -> None:
    classifier, chosen = make_classifier(300), np.array([3, 50, 200])
    features, true = np.random.default_rng(0).normal(size=(6, 16)).astype(np.float32), np.array([50, 3, 3, 200, -1, 50])
    loss, gradient, rows = cross_entropy(features, classifier, true, chosen, NativeContext(1))
    expected, expected_gradient, expected_rows = by_torch(features, classifier, true, chosen)
    assert loss == pytest.approx(expected, rel=1e-5) and rows.shape == (3, 17)
    assert np.allclose(gradient, expected_gradient, atol=1e-6) and np.allclose(rows, expected_rows, atol=1e-6)


def test_no_pixel_counts() -> None:
    features, context = np.ones((3, 16), np.float32), NativeContext(1)
    for classifier in (make_classifier(2), make_classifier(0)):
        chosen = np.arange(len(classifier))
        loss, gradient, rows = cross_entropy(features, classifier, np.full(3, -1), chosen, context)
        assert loss == 0 and not gradient.any() and not rows.any()
    loss, gradient, rows = cross_entropy(features[:0], make_classifier(2), np.zeros(0, int), np.arange(2), context)
    assert loss == 0 and gradient.shape == (0, 16) and not rows.any()


def test_wrong_input_is_refused() -> None:
    features, classifier, context = np.ones((3, 16), np.float32), make_classifier(2), NativeContext(1)
    with pytest.raises(RenderError, match=r"features: .*\[2, 16\]"):
        cross_entropy(features, classifier, np.zeros(2, int), np.arange(2), context)
    with pytest.raises(CoreInputError, match=r"classes: .*-1.*\b1\b.*\b2\b"):
        cross_entropy(features, classifier, np.full(3, 5), np.arange(2), context)
