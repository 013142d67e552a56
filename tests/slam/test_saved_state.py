# SPDX-License-Identifier: Apache-2.0
"""The state of a run: another one goes on from it as if nothing had happened, and what does not fit is refused."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError, FormatError, MissingDependency
from ggslam.loops.activity import ActivitySettings
from ggslam.mapping.cpu.neighbours import NeighbourIndex
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences import open_sequence
from ggslam.slam import parts
from ggslam.slam.config import Config, load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.result import SlamResult
from ggslam.slam.saved_state import (
    check_state,
    describe_state,
    reason_against_saving,
    restore_state,
)
from ggslam.slam.slam import Slam

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "identity.final_passes=1"]
KINDS: dict[str, list[str]] = {
    "as usual": [],
    "no objects": ["identity.enabled=false", "loops.enabled=false"],
    "edges and planes, segmented": ["tracker=edges_planes", "edges_planes.align.budget_ms=0", "masks.source=geometry"],
    "dense identities, degree 1": ["identity.schedule=dense", "sh_degree=1", "mapping.exposure.enabled=true"],
    "objects as colours": ["identity.schedule=colors", "identity.every=2"],
    "random keyframes": ["identity.enabled=false", "mapping.order=random"],
    "newest keyframes first": ["identity.enabled=false", "mapping.order=newest"],
    "covisible keyframes, cloned Gaussians": [
        "identity.enabled=false", "mapping.order=covisible", "mapping.densification=added",
        "mapping.pruning.every_keyframes=2",
    ],
}  # fmt: skip


def copied(slam: Slam) -> tuple[Any, list[np.ndarray]]:
    """The state as a file would hold it."""
    tree, arrays = describe_state(slam)
    return json.loads(json.dumps(tree)), [array.copy() for array in arrays]


def assert_same(one: SlamResult, other: SlamResult) -> None:
    assert len(one.gaussians) == len(other.gaussians) > 0
    rows = len(one.gaussians)
    for name, array in one.gaussians._storage.items():
        assert array[:rows].numpy().tobytes() == other.gaussians._storage[name][:rows].numpy().tobytes(), name
    assert one.trajectory().tobytes() == other.trajectory().tobytes()
    assert one.places == other.places
    events = [[(e.kind, e.frame, e.old_keyframe, e.moved_m, re.sub(r"[\d.]+ s$", "", e.reason)) for e in r.loop_events]
              for r in (one, other)]  # fmt: skip
    assert events[0] == events[1]  # but for the seconds that a closure took
    assert (one.objects is None) == (other.objects is None)
    if one.objects is not None and other.objects is not None:
        assert one.objects.classifier.to_bytes() == other.objects.classifier.to_bytes()
        assert one.objects.observations == other.objects.observations
    exposures = [np.stack([keyframe.exposure for keyframe in result.keyframes]) for result in (one, other)]
    assert exposures[0].tobytes() == exposures[1].tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_another_run_goes_on_bit_for_bit(room: Path, kind: str) -> None:
    sequence = open_sequence(room, stop=14, scale=0.5)
    config = load_config(None, [*FEW, *KINDS[kind]])
    slams = [Slam(sequence.camera, config, sequence.has_masks) for _ in range(2)]
    for frame in sequence.stream(masks="lazy"):
        slams[0].step(frame)
        if frame.index == 7:
            tree, arrays = copied(slams[0])
            restore_state(slams[1], tree, arrays)
            again, same = copied(slams[1])
            assert again == tree
            assert [array.tobytes() for array in arrays] == [array.tobytes() for array in same]
        elif frame.index > 7:
            slams[1].step(frame)
    assert_same(*(slam.finish() for slam in slams))


def test_the_tree_of_neighbours_is_built_anew_when_it_would_have_been() -> None:
    gaussians, random = GaussianMap(), np.random.default_rng(0)

    def grow(count: int) -> None:
        means = torch.from_numpy(random.random((count, 3), np.float32))
        turned, ones = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.ones(count, 3)
        gaussians.insert(means, turned, -ones, ones[:, 0].clone(), ones / 2, birth_keyframe=0)

    grow(100)
    indices = NeighbourIndex(0.5), NeighbourIndex(0.5)
    rows = np.arange(20)
    indices[0].neighbours(gaussians, rows, 3)
    indices[1].set_state(indices[0].state())
    for size, built in ((140, 1), (160, 2)):
        grow(size - len(gaussians))
        one, other = (index.neighbours(gaussians, rows, 3) for index in indices)
        assert np.array_equal(one, other) and [index.built for index in indices] == [built, built]


@pytest.mark.parametrize(("camera_number", "elsewhere"), [(0, False), (2, True), (2, False)])
def test_keyframes_of_an_earlier_map_may_be_of_a_rig(room: Path, camera_number: int, elsewhere: bool) -> None:
    """One whose camera this recording does not have."""
    sequence = open_sequence(room, stop=3, scale=0.5)
    slam = Slam(sequence.camera, load_config(None, [*FEW, "identity.enabled=false"]), False)
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    slam.mapper.keyframes[0].camera_number = camera_number
    if elsewhere:
        slam.mapper.keyframes[0].frame_index = FROM_EARLIER_RUN
    if camera_number and not elsewhere:
        with pytest.raises(FormatError, match="keyframe 0"):
            check_state(slam)
    else:
        check_state(slam)


@pytest.mark.long("three runs with a loop closed and a camera lost")
def test_what_was_put_aside_lost_and_found_goes_along(room: Path) -> None:
    """Keyframes that are put aside, a camera that is lost and found again, the state in the midst of it."""
    loops = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
    config = dataclasses.replace(load_config(None, [*FEW, "identity.enabled=false"]), loops=loops)
    sequence = open_sequence(room)
    frames = list(sequence.stream(masks=False))
    dark = dataclasses.replace(frames[0], color=np.zeros_like(frames[0].color), depth=np.zeros_like(frames[0].depth))
    order = [*range(0, 24, 2), None, *range(22, -1, -2)]
    played = [dataclasses.replace(dark if i is None else frames[i], index=k) for k, i in enumerate(order)]
    slams = [Slam(sequence.camera, config, False) for _ in range(3)]
    for k, frame in enumerate(played):
        slams[0].step(frame)
        for slam, begin in zip(slams[1:], (11, 13), strict=True):
            if k == begin - 1:
                restore_state(slam, *copied(slams[0]))
            elif k >= begin:
                slam.step(frame)
    results = [slam.finish() for slam in slams]
    assert any(frame.status == "lost" for frame in results[0].frames) and results[0].loop_events
    assert_same(results[0], results[1])
    assert_same(results[0], results[2])


def test_a_state_is_data_and_must_fit(room: Path) -> None:
    sequence = open_sequence(room, stop=3)
    config = load_config(None, [*FEW, "identity.enabled=false", "loops.enabled=false"])

    def fresh(settings: Config = config) -> Slam:
        return Slam(sequence.camera, settings, False)

    slam = fresh()
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    tree, arrays = copied(slam)
    name, attributes = tree["o"]

    def refused(changed: Any, match: str, given: list[np.ndarray] = arrays) -> None:
        with pytest.raises(FormatError, match=match):
            restore_state(fresh(), changed, given)

    refused({"o": ["os.system", {}]}, "KeyError")
    refused({"o": [name, {**attributes, "camera": None}]}, "camera")
    refused({"o": [name, {**attributes, "scale": {"x": 1}}]}, r"\bx$")
    refused({"o": [name, {**attributes, "poses": {"r": 10**6}}]}, "list index")
    refused(tree, "list index", [])
    wide = [np.zeros((2, 2, 3), np.uint8) if array.shape == (120, 160, 3) else array for array in arrays]
    refused(tree, r"\[h, w\].*\b2\b.*\[120, 160\]", wide)
    short = [array[:-1] if len(array) == slam.map.count else array for array in arrays]
    refused(tree, f"{slam.map.count - 1}.*{slam.map.count}", short)
    with pytest.raises(ConfigError, match="memory"):
        describe_state(fresh(dataclasses.replace(config, memory_limit_mb=4000.0)))
    assert reason_against_saving(config) is None
    assert "GPU" in str(reason_against_saving(dataclasses.replace(config, device="cuda")))


@pytest.mark.parametrize("has_gpu", [False, True])
def test_a_device_that_is_left_open_is_saved_where_it_is_the_cpu(
    monkeypatch: pytest.MonkeyPatch, has_gpu: bool
) -> None:
    def library_for_device() -> object:
        if not has_gpu:
            raise MissingDependency("no GPU")
        return object()

    monkeypatch.setattr(parts, "library_for_device", library_for_device)
    reason = reason_against_saving(Config(device="auto"))
    assert "GPU" in str(reason) if has_gpu else reason is None
