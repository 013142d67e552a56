# SPDX-License-Identifier: Apache-2.0
"""Options of `ggslam render` that would be ignored, and numbers of films and edits that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import ggslam, refuse

from ggslam.errors import ConfigError
from ggslam.jobs.batch.manifest import read_manifest
from ggslam.jobs.render.film import render_film
from ggslam.jobs.render.key_path import read_camera_keys
from ggslam.jobs.render.single_views import parse_pose
from ggslam.runs.folder import RunFolder

IGNORED = (
    (("--path", "orbit"), "--path: goes with --film"), (("--size", "64x48"), "--size: goes with --pose or --film"),
    (("--fps", "0"), "--fps: goes with --film"), (("--cut", "1"), "--cut: goes with --plan"),
    (("--film", "f.mp4", "--frames", "1"), "--frames: goes with --frames, not with --film"),
    (("--pose", "0 0 0 0 0 0 1", "--every", "2"), "not with --pose"),
    (("--plan", "p.png", "--what", "ids"), "not with --plan"),
)


@pytest.mark.parametrize(("words", "told"), IGNORED)
def test_options_that_would_be_ignored(
    room_run: RunFolder, words: tuple[str, ...], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refuse(ggslam("render", room_run.path, *words), told)


def test_numbers_that_make_no_film(room_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`fps`.*found 0"):
        render_film(room_run, tmp_path / "f.gif", fps=0)
    with pytest.raises(ConfigError, match="`smoothing`"):
        render_film(room_run, tmp_path / "f.gif", smoothing=1e99)
    key = {"time": 10**400, "position": [0, 0, 0], "look_at": [0, 0, 1], "up": [0, -1, 0]}
    (tmp_path / "keys.json").write_text(json.dumps({"keys": [key]}))
    with pytest.raises(ConfigError, match="time: expected a finite number"):
        read_camera_keys(tmp_path / "keys.json")
    with pytest.raises(ConfigError, match="`pose`.*1e300"):
        parse_pose("1e300 0 0 0 0 0 1")


def test_only_new_objects_get_a_name(room_run: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "all.json").write_text('[{"mode": "set", "shape": {"kind": "all"}}]')
    for name in ("none:x", "1:x"):
        refuse(ggslam("edit", room_run.path, "--assign", f"@{tmp_path / 'all.json'}", name), "new:NAME")
    refuse(ggslam("edit", room_run.path, "--remove", "@"), "name of a file")


def test_a_typo_in_a_manifest_is_named(tmp_path: Path) -> None:
    path = tmp_path / "runs.yaml"
    path.write_text("recordings: [a]\nsetings: {}\n")
    with pytest.raises(ConfigError, match="found setings"):
        read_manifest(path)
    path.write_text("recordings: [a]\noptions: --scal 0.5\n")
    with pytest.raises(ConfigError, match=r"did you mean --scale\?"):
        read_manifest(path)
