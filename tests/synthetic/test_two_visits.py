# SPDX-License-Identifier: Apache-2.0
"""Two visits to a generated room differ by what is said, and by nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence
from ggslam.synthetic.changes import ChangeTuning, room_at_two_visits
from ggslam.synthetic.scene import Scene


def poses_of(scene: Scene, instance: int) -> np.ndarray:
    return np.array([shape.T_world_shape for shape in scene.shapes if shape.instance == instance])


@pytest.mark.long("rooms are furnished four times")
@pytest.mark.parametrize("seed", [0, 3])
def test_what_changed_is_what_is_said(seed: int) -> None:
    first, second, made = room_at_two_visits(seed, 6)
    assert len(made) == 6 and {change.kind for change in made} == {"moved", "removed", "added"}
    by_id = {change.instance: change for change in made}
    for instance in first.instance_names:
        old, new = poses_of(first, instance), poses_of(second, instance)
        change = by_id.get(instance)
        if change is None:
            assert np.array_equal(old, new)
        elif change.kind == "moved":
            assert change.T_new_old is not None and np.allclose(change.T_new_old @ old, new)
            shift = np.linalg.norm(new[:, :3, 3].mean(0) - old[:, :3, 3].mean(0))
            assert 0.02 < shift < 0.6 and np.allclose(new[:, 2, 3], old[:, 2, 3])  # along what it stands on
        else:
            gone = new if change.kind == "removed" else old
            assert (gone[:, 2, 3] < -10).all()
    again = room_at_two_visits(seed, 6)[2]
    assert [(c.kind, c.instance) for c in again] == [(c.kind, c.instance) for c in made]


def test_moved_things_stand_free() -> None:
    _, second, made = room_at_two_visits(1, 6)
    for change in made:
        for shape in (s for s in second.shapes if s.instance == change.instance and change.kind == "moved"):
            middle = shape.T_world_shape[None, :3, 3]
            others = [s.distance(middle)[0] for s in second.shapes if s.instance != change.instance]
            assert min(others) > 0


def test_too_many_changes_are_refused() -> None:
    with pytest.raises(SequenceError, match=f"expected 0 to {ChangeTuning.max_changes}"):
        room_at_two_visits(0, ChangeTuning.max_changes + 1)


@pytest.mark.long("two recordings of a room are drawn")
def test_the_command_writes_both_visits(tmp_path: Path) -> None:
    small = ("--frames", 2, "--width", 32, "--height", 24)
    for visit in (1, 2):
        done = ggslam("synth", tmp_path / f"{visit}", "--changes", 3, "--visit", visit, *small)
        assert done.returncode == 0, done.stderr
    assert not (tmp_path / "1" / "changes.json").exists()
    made = json.loads((tmp_path / "2" / "changes.json").read_text())["changes"]
    assert len(made) == 3 and np.array(made[0]["T_new_old"]).shape == (4, 4)
    first, second = (open_sequence(tmp_path / name).ground_truth for name in "12")
    assert first is not None and second is not None and not np.allclose(first, second)


@pytest.mark.parametrize(
    ("words", "reason"),
    [(("--visit", 2), "only with --changes"), (("--changes", 2, "--rig", "front,back"), "not with --rig"),
     (("--changes", 2, "--scene", "loop"), "only the room")],
)  # fmt: skip
def test_what_has_no_two_visits_is_refused(tmp_path: Path, words: tuple[object, ...], reason: str) -> None:
    done = ggslam("synth", tmp_path / "room", "--frames", 2, *words)
    assert done.returncode == 2 and reason in done.stderr
