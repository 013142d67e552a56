# SPDX-License-Identifier: Apache-2.0
"""A run folder tells the truth about itself, whatever happens while it is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from ggslam.errors import RunFolderError
from ggslam.runs import writing
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.verification import verify_run
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam


@pytest.fixture(scope="module")
def result(room: Path) -> SlamResult:
    sequence = open_sequence(room, stop=3)
    slam = Slam(sequence.camera, load_config(None, ["mapping.iterations_per_frame=1"]))
    for frame in sequence.stream():
        slam.step(frame)
    return slam.finish()


CAMERA = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
RECORDING = SequenceRecord.of({"open": {"path": "room"}, "camera": CAMERA})


def fail(*_: object, **__: object) -> None:
    raise RunFolderError("cannot write: No space left on device")


@pytest.mark.parametrize("broken", ["write_gaussian_ply", "save_points"])
def test_a_disk_that_fills_up(
    result: SlamResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.save(load_config(), RECORDING, result)
    assert folder.mark().complete is True
    assert verify_run(folder.path).good
    (tmp_path / "run" / "metrics.json").write_text("{}")
    before = (tmp_path / "run" / "map.ply").stat().st_ino
    monkeypatch.setattr(writing, broken, fail)
    again = RunFolder.create(tmp_path / "run", overwrite=True)
    with pytest.raises(RunFolderError, match="No space"):
        again.save(load_config(), RECORDING, result)
    if broken == "save_points":  # all but the clouds is there
        assert again.mark().missing == ["points.ply", "points_grid.ply"] and not again.mark().complete
        assert not (tmp_path / "run" / "metrics.json").exists() and not verify_run(folder.path).problems
    else:  # the run of before
        assert again.mark().complete and (tmp_path / "run" / "map.ply").stat().st_ino == before
    monkeypatch.undo()
    RunFolder.create(tmp_path / "run", overwrite=True).save(load_config(), RECORDING, result)  # it can be replaced
    assert RunFolder.open(tmp_path / "run").mark().complete is True


def test_a_probe_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, data: bytes) -> int:
        self.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RunFolderError, match="No space left"):
        RunFolder.create(tmp_path / "run")
    assert list((tmp_path / "run").iterdir()) == []


@pytest.mark.parametrize("name", ["map.ply", "volumes", "renders", "run.json"])
def test_a_link_is_refused_before_the_work(result: SlamResult, tmp_path: Path, name: str) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.save(load_config(), RECORDING, result)
    place = folder.path / name
    if place.exists():
        place.rename(folder.path / "aside")
    place.symlink_to("aside" if (folder.path / "aside").exists() else ".")
    before = sorted(path.name for path in folder.path.iterdir())
    with pytest.raises(RunFolderError, match=f"{name}: .*link") as refused:
        RunFolder.create(folder.path, overwrite=True)
    assert refused.value.exit_code == 2 and sorted(path.name for path in folder.path.iterdir()) == before
