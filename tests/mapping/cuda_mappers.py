# SPDX-License-Identifier: Apache-2.0
"""Mappers on a pretended GPU, for tests of their training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.identity_settings import IdentitySettings, NeighbourSettings
from ggslam.mapping.labelling import KeyframeLabels
from ggslam.mapping.settings import MapperSettings
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.scene.poses import inverse, se3_exp

LEARNING = IdentitySettings(every=2, pixels=64, neighbours=NeighbourSettings(samples=20, every=2))


def make_mapper(library: CudaLibrary, identity: IdentitySettings | None = None) -> CudaMapper:
    exposed, device = replace(MapperSettings().exposure, enabled=True), library.whole_device(None)
    learner = None if identity is None else CudaIdentityLearner(identity, 1, device, library)
    gaussians = GaussianMap(feature_channels=0 if identity is None else IDENTITY_CHANNELS, device=device)
    mapper = CudaMapper(gaussians, replace(MapperSettings(), exposure=exposed), library, identity=learner)
    mapper.pixel_m = 0.01
    return mapper


def add_keyframe(mapper: CudaMapper, frame: Frame, number: int = 0, **labels: Any) -> None:
    """Where it is, but for a little that training takes back."""
    assert frame.T_world_camera is not None
    shaken = se3_exp(1e-3 * np.random.default_rng(number).normal(size=6))
    found = KeyframeLabels(frame.mask, **labels)
    mapper.add_keyframe(frame, frame.T_world_camera @ inverse(shaken), lambda keyframe, show: found)


def assert_same(found: CudaMapper, expected: CudaMapper) -> None:
    ours, theirs = found.map.state(), expected.map.state()
    assert ours["count"] == theirs["count"] > 500
    for name, rows in theirs["rows"].items():
        assert torch.equal(ours["rows"][name], rows), name
    assert np.array_equal(found._states.read_poses(), expected._states.read_poses())
    assert np.array_equal(found._states.read_exposures(), expected._states.read_exposures())
    assert found._states.read_sums() == expected._states.read_sums()
    assert torch.equal(found._rasterizer.overflows, expected._rasterizer.overflows)
    assert [k.iterations for k in found.keyframes] == [k.iterations for k in expected.keyframes]
    assert found.times.iterations == expected.times.iterations and found.times.steps == expected.times.steps
