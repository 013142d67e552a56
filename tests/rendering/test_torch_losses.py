# SPDX-License-Identifier: Apache-2.0
"""The losses as torch functions, held against those that the compiled core and the mapper compute."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.errors import RenderError
from ggslam.mapping.cpu.cross_entropy import cross_entropy
from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.cpu.neighbours import kl_gradient
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.losses import color_loss, depth_loss, identity_loss, neighbour_loss
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.identity import IdentityClassifier


def test_colour_and_depth_are_those_of_the_compiled_core() -> None:
    random, size = np.random.default_rng(0), (31, 45)
    color = random.integers(0, 256, (*size, 3)).astype(np.uint8)
    depth = random.uniform(0.5, 3, size).astype(np.float32)
    depth[:7] = 0
    image = torch.from_numpy(random.random((3, *size), np.float32)).requires_grad_()
    rendered = torch.from_numpy(random.uniform(0.5, 3, size).astype(np.float32)).requires_grad_()
    view = RenderBuffers(image.detach(), rendered.detach(), torch.ones(size))
    settings = LossSettings(dssim_weight=0.2, depth_weight=0.7)
    expected = CpuImageLoss(NativeContext()).evaluate(view, LossTarget(color, depth, 1.0), settings)

    target = torch.from_numpy(color).permute(2, 0, 1) / 255
    of_color, of_depth = color_loss(image, target), depth_loss(rendered, torch.from_numpy(depth))
    loss = of_color + 0.7 * of_depth
    loss.backward()
    assert float(of_depth.detach()) == pytest.approx(expected.values.depth, rel=1e-5)
    assert float(loss.detach()) == pytest.approx(expected.values.total, rel=1e-5)
    assert image.grad is not None and rendered.grad is not None
    assert torch.allclose(image.grad, expected.d_image, atol=1e-3 * float(expected.d_image.abs().max()))
    assert torch.allclose(rendered.grad, expected.d_depth, atol=1e-6)


def test_identity_is_that_of_the_mapper() -> None:
    random = np.random.default_rng(1)
    features = random.normal(size=(50, 16)).astype(np.float32)
    weight, bias = random.normal(size=(5, 16)).astype(np.float32), random.normal(size=5).astype(np.float32)
    classes = random.integers(-1, 5, 50)
    classifier, known = IdentityClassifier(np.arange(1, 6, dtype=np.uint16), weight, bias), classes >= 0
    expected, gradient, rows = cross_entropy(features, classifier, classes, np.arange(5), NativeContext(1))

    leaves = [torch.from_numpy(array).requires_grad_() for array in (features, weight, bias)]
    loss = identity_loss(leaves[0] @ leaves[1].T + leaves[2], torch.from_numpy(classes))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    found = [leaf.grad.numpy() for leaf in leaves if leaf.grad is not None]
    assert np.allclose(found[0], gradient, atol=1e-6) and not gradient[~known].any()
    assert np.allclose(found[1], rows[:, :-1], atol=1e-6) and np.allclose(found[2], rows[:, -1], atol=1e-6)


def test_neighbours_are_those_of_the_mapper() -> None:
    random = np.random.default_rng(2)
    own, others = random.normal(size=(20, 6)), random.normal(size=(20, 3, 6))
    expected, of_own, of_others = kl_gradient(own, others)
    leaves = [torch.from_numpy(array).requires_grad_() for array in (own, others)]
    loss = neighbour_loss(*leaves)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(expected)
    assert leaves[0].grad is not None and np.allclose(leaves[0].grad.numpy(), of_own)
    assert leaves[1].grad is not None and np.allclose(leaves[1].grad.numpy(), of_others)


def test_nothing_measured_and_nothing_labelled() -> None:
    depth = torch.rand(4, 5, requires_grad=True)
    depth_loss(depth, torch.full((4, 5), float("nan"))).backward()
    assert depth.grad is not None and not depth.grad.any()
    logits = torch.rand(3, 2, requires_grad=True)
    identity_loss(logits, torch.full((3,), -1)).backward()
    assert logits.grad is not None and not logits.grad.any()


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(RenderError, match="color_loss"):
        color_loss(torch.zeros(3, 4, 5), torch.zeros(4, 5, 3))
    with pytest.raises(RenderError, match="depth_loss"):
        depth_loss(torch.zeros(4, 5), torch.zeros(5, 4))
    with pytest.raises(RenderError, match=r"\b0 to 1\b.*\b2\b"):
        identity_loss(torch.zeros(3, 2), torch.tensor([0, 1, 2]))
    with pytest.raises(RenderError, match="neighbour_loss"):
        neighbour_loss(torch.zeros(3, 2), torch.zeros(4, 1, 2))
