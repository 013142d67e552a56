# SPDX-License-Identifier: Apache-2.0
"""What a new keyframe sees of a map on a device is what the pictures themselves show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cuda_emulation import emulated_library
from cuda_mappers import LEARNING, add_keyframe, make_mapper

from ggslam.mapping.cuda.keyframe_look import KeyframeLook
from ggslam.mapping.cuda.look_memory import LABEL_STRIDE
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.labelling import MapLabels
from ggslam.mapping.votes import vote_labels
from ggslam.rendering.exposure import is_enough
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.22, stride=4).stream(masks=True))[:2]


def look_at(mapper: CudaMapper, frame: Frame) -> KeyframeLook:
    assert frame.T_world_camera is not None
    keyframe = mapper._new_keyframe(frame, frame.T_world_camera)
    mapper.note_valid(frame)
    return KeyframeLook(mapper, keyframe, frame.T_world_camera, True, True)


@pytest.mark.parametrize("gain", [1.0, 0.6, 0.004])
def test_exposures_are_those_of_the_pictures(frames: list[Frame], gain: float) -> None:
    mapper = make_mapper(emulated_library(), LEARNING)
    add_keyframe(mapper, frames[0])
    mapper.run(6)
    darker = replace(frames[1], color=np.rint(gain * frames[1].color).astype(np.uint8))
    look = look_at(mapper, darker)
    expected, found = look.pictures().measure(darker.color), look.measure(darker.color)
    assert expected is not None or gain < 0.01
    assert (found is None) == (expected is None)
    if expected is not None:
        assert np.array_equal(found, expected) and abs(np.log(expected[:, 0].mean() / gain)) < 0.1


def test_a_keyframe_that_shows_another_place_tells_nothing(frames: list[Frame]) -> None:
    mapper = make_mapper(emulated_library(), LEARNING)
    add_keyframe(mapper, frames[0])
    look = look_at(mapper, replace(frames[1], depth=2 * frames[1].depth))
    assert look.measure(frames[1].color) is None and look.pictures().measure(frames[1].color) is None
    assert is_enough(2, 100) and not is_enough(1, 100)


def test_labels_are_those_of_single_operations(frames: list[Frame]) -> None:
    """And where a camera shows nothing, nothing is missing."""
    mapper = make_mapper(emulated_library(), LEARNING)
    add_keyframe(mapper, frames[0])
    mapper.run(4)
    valid = np.ones(frames[1].depth.shape, bool)
    valid[:, :9] = False
    look = look_at(mapper, replace(frames[1], valid=valid))
    found, view = look.labels(), mapper._rasterizer.last_rendering.buffers
    height, width = valid.shape
    grid = torch.arange(height * width, dtype=torch.int32).view(height, width)[::LABEL_STRIDE, ::LABEL_STRIDE]
    ids, share = mapper._rasterizer.pixel_terms(grid.reshape(-1).contiguous()).labels(vote_labels(mapper.map))
    share = share.view(grid.shape) * (view.alpha[::LABEL_STRIDE, ::LABEL_STRIDE] > 0.5)
    expected = MapLabels.from_grid(
        ids.view(grid.shape).numpy(), share.numpy(), view.expected_depth.numpy(), LABEL_STRIDE
    )
    assert np.array_equal(found.ids, expected.ids) and len(np.unique(found.ids)) > 2
    assert np.array_equal(found.confidence, expected.confidence) and np.array_equal(found.depth, expected.depth)
    alpha, depth = look._memory.explained
    assert torch.equal(depth, view.expected_depth)
    assert bool((alpha[:, :9] == 1).all()) and torch.equal(alpha[:, 9:], view.alpha[:, 9:])
