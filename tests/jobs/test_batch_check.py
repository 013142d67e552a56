# SPDX-License-Identifier: Apache-2.0
"""A batch looks at all its runs before it makes the first, and says why one failed."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import ggslam, refuse, succeed
from small_batch import write_small_batch


@pytest.mark.parametrize(
    ("recordings", "told"),
    [
        ("[first, {path: first, name: b, options: --stride a}]", "b/default/seed0: --stride: expected a whole number"),
        ("[first, {path: first, name: b, options: --set mapping.iteration=3}]", "did you mean mapping.iterations"),
        ("[first, {path: first, name: b, options: --tracker nobody}]", "--tracker: expected one of gicp, edges_planes"),
        ("[first, {path: first, name: b, options: --iterations 5000}]", "mapping.iterations_per_frame: expected"),
        ("[first, {path: first, name: b, options: --config swift}]", "swift"),
        ("[first, firts]", "did you mean"),
        ("[first, {path: batch.yaml, name: b}]", "b/default/seed0: "),
    ],
)
@pytest.mark.parametrize("more", [(), ("--dry-run",)])
def test_mistakes_are_found_before_the_first_run(
    tmp_path: Path, recordings: str, told: str, more: tuple[str, ...]
) -> None:
    path = write_small_batch(tmp_path, recordings, frames=2)
    refuse(ggslam("batch", path, *more), "1 of 2 runs cannot be made; none was begun:", told)
    assert not (tmp_path / "table").exists()


def test_the_same_mistake_is_told_once(tmp_path: Path) -> None:
    path = write_small_batch(tmp_path, "[first]", frames=2)
    with path.open("a") as file:
        file.write("seeds: [0, 1, 2]\nsettings: {default: '', bad: --stride 0}\n")
    refuse(ggslam("batch", path), "3 of 6 runs cannot be made", "first/bad/seed0 and 2 other runs: --stride: expected")


def test_a_dry_run_lists_the_runs_and_makes_none(tmp_path: Path) -> None:
    path = write_small_batch(tmp_path, "[first, {path: first, name: second}]", frames=2)
    said = succeed("batch", path, "--dry-run")
    assert "second/default/seed0" in said and "ggslam run" in said and "2 runs are to be made; none was begun" in said
    assert not (tmp_path / "table").exists()


@pytest.mark.long("makes two small runs in processes of their own")
def test_a_failing_scene_is_told_in_its_own_words(tmp_path: Path) -> None:
    path = write_small_batch(tmp_path, "[first, {path: first, name: far, options: --start 100}]", frames=3)
    done = ggslam("batch", path)
    told = f"far/default/seed0: failed: {tmp_path / 'first'}: start must be from 0 to 2, found 100"
    assert done.returncode == 1 and told in done.stdout, done.stdout
    assert "first/default/seed0: done" in done.stdout


def test_the_baseline_is_one_of_the_settings(tmp_path: Path) -> None:
    path = write_small_batch(tmp_path, "[first]", frames=2)
    refuse(ggslam("batch", path, "--baseline", "other"), "--baseline", "default", "other")
    with path.open("a") as file:
        file.write("baseline: other\n")
    refuse(ggslam("batch", path), "baseline: expected one of the settings default, found 'other'")
