# SPDX-License-Identifier: Apache-2.0
"""Steps that are started as graphs are those that are started kernel by kernel, bit for bit, whatever changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cuda_emulation import emulated_library
from cuda_mappers import LEARNING, add_keyframe, assert_same, make_mapper

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.cuda.step_graphs import StepGraphs
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.22, stride=4).stream(masks=True))[:4]


@contextmanager
def without_graphs() -> Iterator[None]:
    functions = emulated_library().functions
    functions.ggslam_emulation_refuse_graphs(1)
    try:
        yield
    finally:
        functions.ggslam_emulation_refuse_graphs(0)


def counts_of(mapper: CudaMapper) -> dict[str, int]:
    counts = mapper._training.graphs.counts
    return {name: getattr(counts, name) for name in ("started", "plain", "made", "changed", "refused")}


def both_ways(work: Callable[[], CudaMapper]) -> dict[str, int]:
    """Counts of the pieces with graphs, after comparison with the same where the runtime refuses to record."""
    found = work()
    with without_graphs():
        expected = work()
    assert_same(found, expected)
    refused, counts = counts_of(expected), counts_of(found)
    assert refused["refused"] == 1 and refused["started"] == refused["made"] == refused["changed"] == 0
    assert counts["refused"] == 0 and counts["started"] + counts["plain"] == refused["plain"]
    return counts


def test_a_step_that_is_made_again_is_a_graph(frames: list[Frame]) -> None:
    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        add_keyframe(mapper, frames[0])
        mapper.run(1)
        mapper.run(6)
        add_keyframe(mapper, frames[1], 1)
        mapper.run(9)
        return mapper

    counts = both_ways(work)
    assert counts["plain"] < 6 < counts["started"] and counts["made"] > 0


def test_a_map_that_grew_changes_the_graph(frames: list[Frame]) -> None:
    """Of jobs that are used no more the graphs become those of jobs to come."""

    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        for number, frame in enumerate((*frames, *frames)):
            add_keyframe(mapper, frame, number)
            mapper.run(6)
        return mapper

    counts = both_ways(work)
    assert counts["changed"] >= 2 and counts["made"] >= 4 and counts["started"] > counts["plain"]


def test_steps_of_other_kernels_are_graphs_of_their_own(frames: list[Frame], room: Path) -> None:
    """Keyframes with and without exposures, cameras of two sizes, bounds of colours."""
    larger = next(iter(open_sequence(room, scale=0.3).stream()))

    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library())
        for number, frame in enumerate((frames[0], larger, frames[1], larger, frames[2])):
            add_keyframe(mapper, frame, number)
            mapper.run(8)
            exposure = replace(mapper.settings.exposure, enabled=number % 2 == 1)
            mapper.settings = replace(mapper.settings, exposure=exposure)
        mapper.refine(6)
        return mapper

    counts = both_ways(work)
    assert counts["started"] > 0 and counts["made"] > 4


def test_lessons_lie_between_two_graphs(frames: list[Frame]) -> None:
    def work() -> CudaMapper:
        mapper = make_mapper(emulated_library(), LEARNING)
        for number, frame in enumerate(frames[:2]):
            add_keyframe(mapper, frame, number)
            mapper.run(9)
        mapper.finish_identity()
        return mapper

    counts = both_ways(work)
    assert counts["started"] > 0 and counts["started"] + counts["plain"] > 18  # a step with a lesson is two pieces


def test_steps_without_room_change_nothing_in_graphs_too(frames: list[Frame]) -> None:
    mapper = make_mapper(emulated_library())
    add_keyframe(mapper, frames[0])
    mapper.run(2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapper._rasterizer.counter, "room_for", lambda recent: 10)
        before, started = mapper.map.means.clone(), counts_of(mapper)["started"]
        mapper.run(6)
    assert counts_of(mapper)["started"] > started and np.array_equal(mapper.map.means, before)
    assert mapper._rasterizer.overflows.tolist() == [6]


def test_the_runtime_records_steps(cuda_library: CudaLibrary, frames: list[Frame]) -> None:
    mapper = make_mapper(cuda_library)
    add_keyframe(mapper, frames[0])
    mapper.run(8)
    mapper.run(8)
    counts = counts_of(mapper)
    assert counts["started"] >= 8 and counts["refused"] == 0
    assert np.isfinite(mapper.map.means.cpu().numpy()).all()


def test_graphs_go_with_their_owner() -> None:
    graphs = StepGraphs(emulated_library(), 0)
    assert all(getattr(graphs.counts, name) == 0 for name, _ in graphs.counts._fields_)
    del graphs
