# SPDX-License-Identifier: Apache-2.0
"""Which runs a manifest, or a folder of recordings, makes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ggslam.errors import ConfigError
from ggslam.jobs.batch.manifest import REPLICA, manifest_of_folder, read_manifest

MANIFEST = """
out: tables/first
options: --scale 0.5
recordings:
  - kitchen
  - {path: /data/office 3, name: office3, options: --stop 100}
settings:
  default: ""
  "one step": --iterations 1
seeds: [0, 7]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "experiments.yaml"
    path.write_text(text)
    return path


def test_recordings_times_settings_times_seeds(tmp_path: Path) -> None:
    found = read_manifest(written(tmp_path, MANIFEST))
    assert (found.title, found.out) == ("experiments", tmp_path / "tables/first")
    names = [job.name for job in found.jobs]
    assert names == [
        f"{recording}/{settings}/seed{seed}"
        for recording in ("kitchen", "office3") for settings in ("default", "one_step") for seed in (0, 7)
    ]  # fmt: skip
    assert found.jobs[0].words == (str(tmp_path / "kitchen"), "--scale", "0.5", "--seed", "0")
    last = ("/data/office 3", "--scale", "0.5", "--stop", "100", "--iterations", "1", "--seed", "7")
    assert found.jobs[-1].words == last and found.jobs[-1].settings == "one step"


def test_a_short_manifest(tmp_path: Path) -> None:
    found = read_manifest(written(tmp_path, "recordings: [a]"), tmp_path / "here")
    assert [job.name for job in found.jobs] == ["a/default/seed0"] and found.out == tmp_path / "here"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings: []", "recordings: expected a list"),
        ("seeds: [1]", "expected recordings"),
        ("recordings: [a]\nworkers: 3", "no other keys"),
        ("recordings: [{name: b}]", r"recordings\[0\]: expected a path"),
        ("recordings: [a]\nseeds: [-1]", "seeds: expected whole numbers"),
        ("recordings: [a]\nseeds: [true]", "seeds: expected whole numbers"),
        ("recordings: [a]\nsettings: [x]", "settings: expected names"),
        ("recordings: [a]\nsettings: {x: --out b}", "settings.x: --out is not for batches"),
        ("recordings: [a]\noptions: --seed=3", "options: --seed is not for batches"),
        ("recordings: [a]\noptions: 'unclosed \"'", "options: No closing quotation"),
        ("recordings: [a]\noptions: [x]", "options: expected options of"),
        ("recordings: [a, b/a]", "two runs would have the folder a/default/seed0"),
        ("recordings: [a", "experiments.yaml: "),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read_manifest(written(tmp_path, text))


def test_a_manifest_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        read_manifest(tmp_path / "none.yaml")


def test_all_recordings_of_a_folder(room: Path, tmp_path: Path) -> None:
    for name in ("b", "room0", "office1"):
        shutil.copytree(room, tmp_path / name, ignore=shutil.ignore_patterns("masks"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no recording")
    found = manifest_of_folder(tmp_path, seeds=(0, 1), options=("--stop", "5"))
    names = [f"{name}/default/seed{seed}" for name in ("b", "office1", "room0") for seed in (0, 1)]
    assert [job.name for job in found.jobs] == names
    assert found.jobs[0].words == (str(tmp_path / "b"), "--stop", "5", "--seed", "0")
    replica = manifest_of_folder(tmp_path, only=REPLICA)
    assert [job.recording for job in replica.jobs] == ["room0", "office1"]  # in the order of papers
    for folder in (tmp_path / "empty", tmp_path / "nothing"):
        with pytest.raises(ConfigError, match="no recording|no such folder"):
            manifest_of_folder(folder)
