# SPDX-License-Identifier: Apache-2.0
"""The classifier of identity vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning


def classifier() -> IdentityClassifier:
    weight = 4 * np.eye(2, 16, dtype=np.float32)
    return IdentityClassifier(np.array([7, 300], np.uint16), weight, np.zeros(2, np.float32))


def vector(*leading: float) -> np.ndarray:
    return np.array([*leading, *[0] * (16 - len(leading))], np.float32)


def test_probabilities_are_a_softmax_with_nothing() -> None:
    p = classifier().probabilities(np.stack([vector(2), vector()]))
    e = np.exp([[8, 0, IdentityVectorTuning.nothing_logit], [0, 0, IdentityVectorTuning.nothing_logit]])
    assert p.dtype == np.float32 and np.allclose(p, (e / e.sum(1, keepdims=True))[:, :2], atol=1e-6)


def test_what_is_near_zero_is_no_object() -> None:
    ids, probability = classifier().labels(np.stack([vector(0, 1), vector(0.1, 0.2), vector(-3)]))
    assert ids.dtype == np.uint16 and ids.tolist() == [300, 0, 0]
    assert probability[0] == pytest.approx(classifier().probabilities(vector(0, 1))[1], rel=1e-5)
    assert not probability[1:].any()


def test_without_classes_all_is_nothing() -> None:
    ids, probability = IdentityClassifier.empty().labels(np.ones((3, 2, 16), np.float32))
    assert ids.shape == (3, 2) and not ids.any() and not probability.any()
    assert IdentityClassifier.empty().probabilities(np.ones((3, 16), np.float32)).shape == (3, 0)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "classifier.npz"
    path.write_bytes(classifier().to_bytes())
    read = IdentityClassifier.from_file(path)
    assert read.class_ids.tolist() == [7, 300] and np.array_equal(read.weight, classifier().weight)
    path.write_bytes(classifier().to_bytes()[:-50])
    with pytest.raises(FormatError, match="classifier.npz"):
        IdentityClassifier.from_file(path)
    with pytest.raises(FormatError, match="missing"):
        IdentityClassifier.from_file(tmp_path / "none.npz")


def test_some_classes_only() -> None:
    rest = classifier().without([7])
    assert rest.class_ids.tolist() == [300] and rest.class_of(300) == 0
    with pytest.raises(KeyError):
        rest.class_of(7)
