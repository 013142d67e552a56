# SPDX-License-Identifier: Apache-2.0
"""Training steps that are started by one call are those that are started by many, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cuda_emulation import emulated_library
from cuda_mappers import LEARNING, add_keyframe, assert_same, make_mapper
from device_watch import DeviceTensor, DeviceWatch

from ggslam.mapping.cuda.keyframe_states import KeyframeStateTuning
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.cuda.training import CudaTraining
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.system.tuning import overridden


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.22, stride=4).stream(masks=True))[:4]


@contextmanager
def one_by_one() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CudaTraining, "is_ready", property(lambda self: False))
        yield


def both_ways(work: Callable[[], CudaMapper]) -> tuple[CudaMapper, CudaMapper]:
    found = work()
    with one_by_one():
        expected = work()
    assert found._training.fillings > 0 and expected._training.fillings == 0
    assert_same(found, expected)
    return found, expected


def test_steps_are_those_of_single_calls(frames: list[Frame]) -> None:
    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        add_keyframe(mapper, frames[0])
        mapper.run(3)
        add_keyframe(mapper, frames[1], 1)
        mapper.run(8)
        mapper.refine(3)
        return mapper

    found, _ = both_ways(work)
    assert np.abs(found._states.read_poses()[1] - inverse(frames[1].T_world_camera)).max() > 1e-5
    assert not np.array_equal(found._states.read_exposures()[1], found._states.read_exposures()[0])
    assert found._training.fillings < 8


def test_the_job_follows_what_grows_and_goes(frames: list[Frame]) -> None:
    """The map's room, the table of keyframes, and images that the device has no room for."""

    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        mapper.map.growth = 0.0
        mapper._images._limit = int(1.5 * (frames[0].color.nbytes + frames[0].depth.nbytes // 2))
        capacities, tables = set[int](), set[int]()
        for number, frame in enumerate(frames):
            add_keyframe(mapper, frame, number)
            mapper.run(1)
            mapper.map.reserve(mapper.map.count + 1000)
            mapper.run(2)
            capacities.add(mapper.map.capacity)
            tables.add(mapper._states._table.data_ptr())
            assert len(mapper._images._images) == 1
        assert len(capacities) == len(frames) and len(tables) > 1
        mapper.map.keep(mapper.map.opacity_logits > mapper.map.opacity_logits.median())
        mapper.run(2)
        return mapper

    with overridden(KeyframeStateTuning, initial_rows=1):
        both_ways(work)


def test_where_cameras_show_nothing_and_what_moved(frames: list[Frame]) -> None:
    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        valid, moving = np.ones(frames[0].depth.shape, bool), np.zeros(frames[0].depth.shape, bool)
        valid[:, :5], moving[10:20, 10:20] = False, True
        for number, frame in enumerate(frames[:2]):
            add_keyframe(mapper, replace(frame, valid=valid, moving=moving if number else None), number)
            mapper.run(4)
        return mapper

    both_ways(work)


def test_cameras_of_several_sizes(frames: list[Frame], room: Path) -> None:
    """Steps that follow one another with one camera are one call."""
    larger = next(iter(open_sequence(room, scale=0.3).stream()))

    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        for number, frame in enumerate((frames[0], larger, frames[1])):
            add_keyframe(mapper, frame, number)
            mapper.run(4)
        return mapper

    found, _ = both_ways(work)
    assert len({keyframe.camera for keyframe in found.keyframes}) == 2 and found._training.fillings > 5


@pytest.mark.parametrize("schedule", ["sampled", "votes"])
def test_objects_are_learned_in_the_same_call(frames: list[Frame], schedule: Any) -> None:
    """Identity steps among the others, with parts of objects and classes that appear."""

    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library(), replace(LEARNING, schedule=schedule))
        for number, frame in enumerate(frames[:3]):
            parts = [tuple(np.unique(frame.mask)[1:3])] if number == 2 and frame.mask is not None else []
            add_keyframe(mapper, frame, number, splits=parts)
            mapper.run(5)
        mapper.finish_identity()
        return mapper

    found, expected = both_ways(work)
    assert found.identity is not None and expected.identity is not None
    ours, theirs = found.identity.classifier, expected.identity.classifier
    assert np.array_equal(ours.weight, theirs.weight) and np.array_equal(ours.bias, theirs.bias)
    assert found.identity.times.count == expected.identity.times.count > 6
    assert found.map.vote_weights.max() > 0.2 and found.map.features.any()


def test_steps_without_room_change_nothing_and_are_counted(frames: list[Frame]) -> None:
    mapper = make_mapper(emulated_library())
    add_keyframe(mapper, frames[0])
    mapper.run(2)
    mapper.run(1)
    before, sums = mapper.map.state()["rows"]["means"].clone(), mapper._states.read_sums()
    counter = mapper._rasterizer.counter
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counter, "room_for", lambda recent: 10)
        mapper.run(3)
    assert torch.equal(mapper.map.means, before) and mapper._states.read_sums() == sums
    assert mapper._rasterizer.overflows.tolist() == [3]
    done = mapper.times.iterations
    mapper.run(1)
    assert mapper.times.iterations == done + 4 and mapper._states.read_sums().iterations == sums.iterations + 4


def test_what_the_call_does_not_know_is_made_of_single_calls(frames: list[Frame]) -> None:
    """A loss of one's own, and rendered images of identities."""
    mapper = make_mapper(emulated_library())
    add_keyframe(mapper, frames[0])
    mapper.run(2)
    fillings, seen = mapper._training.fillings, list[int]()
    mapper.extra_loss = lambda view, keyframe: (seen.append(keyframe.index), 0 * view.image.sum())[1]
    mapper.run(3)
    assert seen == [0, 0, 0] and mapper._training.fillings == fillings and mapper._states.read_sums().iterations == 5
    dense = make_mapper(emulated_library(), replace(LEARNING, schedule="dense", every=1))
    add_keyframe(dense, frames[0])
    dense.run(2)
    assert dense._training.fillings == 0 and dense.identity is not None and dense.identity.times.count == 2


def test_nothing_is_waited_for_copied_or_allocated(frames: list[Frame]) -> None:
    with DeviceWatch() as watch:
        mapper = make_mapper(watch.library, LEARNING)
        for number, frame in enumerate(frames[:2]):
            add_keyframe(mapper, frame, number)
            mapper.run(4)
        mapper.run(4)
        operations: list[str] = []
        dispatch = watch.dispatch

        def noting(func: Any, args: Any, kwargs: Any) -> Any:
            if any(isinstance(value, DeviceTensor) for value in args) or kwargs.get("device") is not None:
                operations.append(func.overloadpacket.__name__)
            return dispatch(func, args, kwargs)

        watch.dispatch = noting  # type: ignore[method-assign]
        watch.forget()
        mapper.run(4)
        assert [call.operation for call in watch.calls] == ["train"]
        assert [name for name in operations if name != "device"] == ["copy_"]  # numbers that go to the host
        assert not watch.waits and not watch.uploads
        assert mapper.identity is not None and mapper.identity.times.count > 4
        watch.forget()
        mapper.refine(3)
        assert [call.operation for call in watch.calls] == 3 * ["train"]
