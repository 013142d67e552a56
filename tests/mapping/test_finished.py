# SPDX-License-Identifier: Apache-2.0
"""Maps that are finished are trained further, and do not get worse by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_mapper import make_mapper, wall

from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.finished import StillMapper, load_finished, train_by_turns
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.exposure import identity_exposure
from ggslam.scene.gaussian_map import GaussianMap

DARK = 0.5
"""Gain of a darkened keyframe."""


@pytest.fixture(scope="module")
def trained() -> GaussianMap:
    """A map of the wall. Who changes it works on a copy."""
    mapper = make_mapper()
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(60)
    mapper.refine(60)
    return mapper.map


def keyframes(*gains: float) -> list[Keyframe]:
    """The wall as seen with exposures that are known."""
    found = []
    for number, gain in enumerate(gains):
        frame = wall(number)
        dark = replace(frame, color=np.rint(frame.color * np.float32(gain)).astype(np.uint8))
        found.append(make_keyframe(number, dark, np.eye(4)))
        found[-1].exposure = identity_exposure() * [gain, 1]
    return found


def psnr(gaussians: GaussianMap) -> float:
    """Of the wall as it is, dB."""
    mapper = CpuMapper(gaussians, MapperSettings(), NativeContext(2))
    image = mapper.render_view(wall().camera, np.eye(4)).image.numpy().clip(0, 1).transpose(1, 2, 0)
    return float(-10 * np.log10(((image - wall().color / 255.0) ** 2).mean()))


def test_known_exposures_count(trained: GaussianMap) -> None:
    """Dark images of a map do not darken it where their exposures tell why they are dark."""
    still = StillMapper(trained.copy("cpu"), MapperSettings(), NativeContext(2), keyframes(1, DARK), [None, None])
    still.train(30, [0])
    assert psnr(still.map) > 50
    assert np.array_equal(still.keyframes[1].exposure, keyframes(1, DARK)[1].exposure)


def test_known_exposures_count_beside_poses(trained: GaussianMap) -> None:
    """As at the seams of merged runs: an exposure is trained on, about where it was."""
    mapper = make_mapper()
    load_finished(mapper, trained.copy("cpu"), keyframes(1, DARK))
    train_by_turns(mapper, [0, 1], 30, 0)
    assert psnr(mapper.map) > 45
    assert np.abs(mapper.keyframes[1].exposure - keyframes(1, DARK)[1].exposure).max() < 0.05


def test_colours_that_are_fitted_are_not_trained(trained: GaussianMap) -> None:
    """No step gives harmonics; after all steps those get them that ask for them: of the wall from one side none."""
    still = StillMapper(trained.copy("cpu"), MapperSettings(), NativeContext(2), keyframes(1, 1), [None, None], True)
    still.map.raise_degree(2)
    still.map.sh[:5, 1:] = 0.01
    before = still.map.sh[:, 1:].clone()
    train_by_turns(still, [0, 1], 10, 0)
    assert torch.equal(still.map.sh[:, 1:], before)
    calls = []
    still._fit_view_colors = lambda: calls.append(len(still.map))  # type: ignore[method-assign]
    still.train(2, [0])
    still.train(0, [0])
    assert calls == [len(still.map)]


@pytest.mark.parametrize("steps", [1, 20, 50])
def test_few_steps_do_no_harm(trained: GaussianMap, steps: int) -> None:
    """The map is the mean of many; what is said of it is true of the map before the first step and after the last."""
    still = StillMapper(trained.copy("cpu"), MapperSettings(), NativeContext(2), keyframes(1, 1), [None, None])
    before, after = still.train(steps, [0])
    assert before == pytest.approx(psnr(trained), abs=0.2) and after == pytest.approx(psnr(still.map), abs=0.2)
    assert after > before - 0.1
