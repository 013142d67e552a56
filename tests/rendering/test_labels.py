# SPDX-License-Identifier: Apache-2.0
"""Object ids of pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.errors import RenderError
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import LabelTuning, label_image, render_labels, vote_label_image
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.tuning import overridden

CAMERA = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)


def classifier_of(classes: int, seed: int = 0) -> IdentityClassifier:
    rng = np.random.default_rng(seed)
    ids = rng.permutation(np.arange(1, 65536))[:classes].astype(np.uint16)
    weight = rng.normal(size=(classes, 16)).astype(np.float32)
    return IdentityClassifier(ids, weight, rng.normal(size=classes).astype(np.float32))


def two_walls() -> GaussianMap:
    """Left half of the view object 300, right half object 7, many opaque Gaussians each, nothing below; in front of the
    left one a faint Gaussian of object 9."""
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform((-1, -0.8, 2), (1, 0.6, 2.01), (1500, 3)), [[-0.5, 0, 1.5]]])
    ids = np.where(means[:, 0] < 0, 300, 7)
    ids[-1] = 9
    opacity = np.where(ids == 9, -1.5, 6.0)
    gaussians = GaussianMap(feature_channels=16, with_moments=False)
    features = np.zeros((len(means), 16), np.float32)
    for channel, name in enumerate((300, 7, 9)):
        features[ids == name, channel] = 8
    gaussians.insert(
        torch.from_numpy(means).float(), torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        torch.full((len(means), 3), np.log(0.06)), torch.from_numpy(opacity).float(), torch.zeros(len(means), 3),
        torch.from_numpy(features), object_id=torch.from_numpy(ids.astype(np.int32)),
    )  # fmt: skip
    return gaussians


def test_pixels_get_the_most_probable_class() -> None:
    rng = np.random.default_rng(1)
    classifier = classifier_of(30)
    features = rng.normal(size=(16, 12, 17)).astype(np.float32)
    alpha = rng.uniform(0, 1, (12, 17)).astype(np.float32)
    expected, probability = classifier.labels(features.transpose(1, 2, 0))
    for values_at_once in (1 << 18, 100, 7):  # in one part, in many, less than a pixel's logits
        with overridden(LabelTuning, logits_at_once=values_at_once):
            ids, confidence = label_image(features, torch.from_numpy(alpha), classifier)
        assert ids.dtype == np.uint16 and (ids == np.where(alpha >= 0.5, expected, 0)).all()
        assert np.allclose(confidence, np.where(alpha >= 0.5, probability, 0), atol=1e-5)
        alone, nothing = label_image(features, alpha, classifier, only_ids=True)
        assert np.array_equal(alone, ids) and not nothing.any()
    assert (label_image(features, alpha, classifier, min_alpha=0.9)[0] > 0).sum() == (alpha >= 0.9).sum()


def test_a_thousand_classes_do_not_need_a_thousand_images(monkeypatch: pytest.MonkeyPatch) -> None:
    classifier = classifier_of(1000)
    features = torch.from_numpy(np.random.default_rng(2).normal(size=(16, 120, 160)).astype(np.float32))
    largest = 0
    multiply = torch.addmm

    def noted(*arguments: torch.Tensor) -> torch.Tensor:
        nonlocal largest
        out = multiply(*arguments)
        largest = max(largest, out.numel())
        return out

    monkeypatch.setattr(torch, "addmm", noted)
    ids, _ = label_image(features, torch.ones(120, 160), classifier)
    assert 0 < largest <= 1 << 18
    assert len(np.unique(ids)) > 500


def test_no_classes_and_wrong_shapes() -> None:
    ids, confidence = label_image(torch.ones(16, 4, 5), torch.ones(4, 5), IdentityClassifier.empty())
    assert not ids.any() and not confidence.any() and ids.shape == (4, 5)
    with pytest.raises(RenderError, match="16, H, W"):
        label_image(torch.ones(8, 4, 5), torch.ones(4, 5), classifier_of(3))
    with pytest.raises(RenderError, match="alpha"):
        label_image(torch.ones(16, 4, 5), torch.ones(5, 4), classifier_of(3))


def test_a_map_rendered_and_classified() -> None:
    weight = np.zeros((3, 16), np.float32)
    weight[[0, 1, 2], [0, 1, 2]] = 1
    classifier = IdentityClassifier(np.array([300, 7, 9], np.uint16), weight, np.zeros(3, np.float32))
    ids, confidence = render_labels(CpuRasterizer(), two_walls(), classifier, CAMERA, np.eye(4))
    assert (ids[5:25, 2:18] == 300).all() and (ids[5:25, 22:38] == 7).all()
    assert confidence[15, 30] > 0.99
    bare = two_walls()
    plain = GaussianMap(with_moments=False)
    plain.insert(bare.means, bare.quaternions, bare.log_scales, bare.opacity_logits, bare.rgb)
    with pytest.raises(RenderError, match="feature channels"):
        render_labels(CpuRasterizer(), plain, classifier, CAMERA, np.eye(4))


def test_the_heaviest_label_of_a_pixel() -> None:
    gaussians, rasterizer = two_walls(), CpuRasterizer()
    own = gaussians.object_id.numpy().astype(np.uint16)
    one_hot = torch.from_numpy((own[:, None] == np.array([300, 7, 9])).astype(np.float32)).contiguous()
    gaussians.features[:] = 0
    gaussians.features[:, :3] = one_hot
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4))
    weights = view.features[:3].numpy()
    expected = np.where(view.alpha.numpy() >= 0.5, np.array([300, 7, 9])[weights.argmax(0)], 0)
    clear = np.sort(weights, 0)[-1] - np.sort(weights, 0)[-2] > 0.01
    with overridden(LabelTuning, pixels_at_once=500):
        ids = vote_label_image(rasterizer, view, own)
    assert (ids == expected)[clear].all() and clear.mean() > 0.8 and {0, 300, 7} == set(np.unique(ids))
    assert (vote_label_image(rasterizer, view, own, stride=3) == ids[::3, ::3]).all()
    behind = np.where(own == 300, 0, own).astype(np.uint16)  # unlabelled Gaussians hide what weighs less
    assert not vote_label_image(rasterizer, view, behind)[5:25, 2:18].any()
