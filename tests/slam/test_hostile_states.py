# SPDX-License-Identifier: Apache-2.0
"""A state that came from elsewhere is refused in one line, or the run goes on: nothing that compiled code or a later
step would not survive gets into a `Slam`."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_states import changed, places_of

from ggslam.errors import FormatError, GgslamError
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam

FEW = ("mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "identity.final_passes=1", "threads=1")
VARIANTS = {"points": FEW, "features": (*FEW, "tracker=edges_planes", "masks.source=geometry")}
FRAMES = 9
STATES = 120

Saved = tuple[Config, list[Frame], Any, list[np.ndarray]]


@pytest.fixture(scope="module", params=VARIANTS)
def saved(request: pytest.FixtureRequest, room: Path) -> Saved:
    """A run after some frames of the room at a quarter of its size, and frames to come."""
    config, sequence = load_config(overrides=VARIANTS[request.param]), open_sequence(room, scale=0.5)
    frames = [sequence.frame(k) for k in range(FRAMES + 2)]
    slam = Slam(frames[0].camera, config, True)
    for frame in frames[:FRAMES]:
        slam.step(frame)
    tree, arrays = describe_state(slam)
    return config, frames, tree, [array.copy() for array in arrays]


def go_on(saved: Saved, tree: Any, arrays: list[np.ndarray]) -> Slam:
    """A fresh `Slam` brought to a state, and two steps."""
    config, frames = saved[:2]
    slam = Slam(frames[0].camera, config, True)
    restore_state(slam, tree, arrays)
    for frame in frames[FRAMES:]:
        slam.step(frame)
    return slam


def test_changed_states_are_refused_or_go_on(saved: Saved) -> None:
    rng, ends, wrong = random.Random(7), Counter[str](), []
    for _ in range(STATES):
        tree, arrays, told = changed(saved[2], [array.copy() for array in saved[3]], rng)
        try:
            go_on(saved, tree, arrays)
        except GgslamError as error:
            ends["refused"] += 1
            assert len(str(error)) < 1000
        except Exception as error:
            wrong.append(f"{told}: {error!r}")
        else:
            ends["went on"] += 1
    assert wrong == []
    assert ends["refused"] > STATES / 2 and ends["went on"] > STATES / 40, ends


def test_the_state_itself_goes_on(saved: Saved) -> None:
    assert len(go_on(saved, saved[2], [array.copy() for array in saved[3]]).frames) == FRAMES + 2


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("updates", -1, r"\bupdates\b.*\b0\b"),
        ("updates", 2**31 - 1, r"\bupdates\b.*\b0\b"),
        ("vote_ids", 65536, "vote_ids.*65535"),
        ("birth_keyframe", 99, "birth_keyframe.*-1"),
        ("means", np.nan, "means"),
        ("_class_of", 65000, "classes"),
        ("_cameras", np.inf, "_cameras"),
        ("T_camera_world", 7.0, "T_camera_world"),
    ],
)
def test_numbers_that_cannot_be_are_told(saved: Saved, attribute: str, value: float, message: str) -> None:
    tree, arrays = saved[2], [array.copy() for array in saved[3]]
    found = [place for name, places in places_of(tree).items() for place in places
             if name.endswith(f".{attribute}") or name.endswith(":d0") and place[0][0] == attribute]  # fmt: skip
    assert found, attribute
    for container, key in found:
        content = container[1] if isinstance(container, list) else container[key]
        ((_, number),) = content.items()
        arrays[number["p"] if isinstance(number, dict) else number][...] = value
    with pytest.raises(FormatError, match=message):
        go_on(saved, tree, arrays)
