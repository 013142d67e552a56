# SPDX-License-Identifier: Apache-2.0
"""`run --encode`: the stream is that of `encode` afterwards, also of a run that was killed and resumed."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import ggslam, refuse, succeed

from ggslam.coding import CodecSettings, list_slices
from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.encode.coding import encode_file
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run import encoding
from ggslam.jobs.run.encoding import EncodeRequest
from ggslam.jobs.run.pipeline import RunRequest, execute, resume
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_container import open_container, read_container, write_container
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.verification import verify_run
from ggslam.slam.result import StepReport

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "refine_iterations=12",
       "identity.final_passes=1"]  # fmt: skip
SLICED = CodecSettings(qp=28, slices=3, geometry_qp=4)


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


class Observer(SilentObserver):
    """Kills a run after a frame; keeps notes; waits for a file before the scores end."""

    def __init__(self, frame: int | None = None, stage: str = "", file: Path | None = None) -> None:
        self._frame, self._stage, self._file, self._now = frame, stage, file, ""
        self.notes: list[str] = []
        self.was_there = False

    def begin(self, stage: str, total: int) -> None:
        self._now = stage

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise Killed

    def advance(self, done: int, total: int) -> None:
        if self._now != "score":
            return
        if self._stage == "score":
            raise Killed
        end = time.monotonic() + 60
        while self._file is not None and not self.was_there and time.monotonic() < end:
            self.was_there = self._file.is_file()
            time.sleep(0.02)

    def note(self, text: str) -> None:
        self.notes.append(text)


def request(room: Path, out: Path, encode: EncodeRequest | None, **more: Any) -> RunRequest:
    asked = {"evaluate": False, "checkpoint_every": 3, **more}
    return RunRequest(SequenceRequest(room, stop=8, scale=0.5), out, overrides=FEW, encode=encode, **asked)


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and beside it the stream that it was coded as."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    outcome = execute(request(room, out, EncodeRequest(out.with_suffix(".bin"), SLICED), checkpoint_every=0))
    assert outcome.error is outcome.encode_failure is None and str(out.with_suffix(".bin")) in outcome.encoded
    return out


def test_the_stream_is_that_of_encode(whole: Path, tmp_path: Path) -> None:
    encode_file(whole, tmp_path / "after.bin", SLICED)
    data = whole.with_suffix(".bin").read_bytes()
    assert data == (tmp_path / "after.bin").read_bytes() and len(list_slices(data)) == 3
    assert verify_run(whole).good


def test_slices_are_coded_while_the_run_is_scored(room: Path, tmp_path: Path) -> None:
    """And Gaussians are as `encode` codes them."""
    asked = EncodeRequest(tmp_path / "map.bin", preset="splat", rate="r02")
    observer = Observer(file=asked.out)
    outcome = execute(request(room, tmp_path / "run", asked, evaluate=True), observer)
    assert observer.was_there and outcome.metrics is not None
    encode_file(tmp_path / "run", tmp_path / "after.bin", CodecSettings(), "splat", "r02")
    assert asked.out.read_bytes() == (tmp_path / "after.bin").read_bytes()
    assert verify_run(tmp_path / "run").good


@pytest.mark.long("a run that is killed and resumed")
@pytest.mark.parametrize("moment", [{"frame": 5}, {"stage": "score"}], ids=str)
def test_a_resumed_run_gives_the_same_stream(room: Path, whole: Path, tmp_path: Path, moment: dict[str, Any]) -> None:
    asked = EncodeRequest(tmp_path / "points.bin", SLICED)
    with pytest.raises(Killed):
        execute(request(room, tmp_path / "run", asked, evaluate="stage" in moment), Observer(**moment))
    if asked.out.exists():
        with pytest.raises(ConfigError, match="remove it or choose another name"):
            resume(tmp_path / "run", encode=asked, evaluate=False)
        asked.out.unlink()
    assert resume(tmp_path / "run", encode=asked, evaluate=False).encode_failure is None
    assert asked.out.read_bytes() == whole.with_suffix(".bin").read_bytes()


def test_a_run_that_did_not_end_is_not_coded(room: Path, tmp_path: Path) -> None:
    class Stop(Observer):
        def frame(self, report: StepReport) -> None:
            if report.frame.frame_index == 4:
                raise KeyboardInterrupt

    observer, asked = Stop(), EncodeRequest(tmp_path / "points.bin")
    outcome = execute(request(room, tmp_path / "run", asked), observer)
    assert isinstance(outcome.error, KeyboardInterrupt) and not asked.out.exists() and outcome.encoded == ""
    assert any("points.bin: not written" in note for note in observer.notes)


def test_what_goes_wrong_with_the_stream_costs_no_run(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(encoding, "encode_saved_run", full)
    outcome = execute(request(room, tmp_path / "run", EncodeRequest(tmp_path / "points.bin")))
    assert isinstance(outcome.encode_failure, RunFolderError) and "No space" in str(outcome.encode_failure)
    assert outcome.error is None and RunFolder.open(tmp_path / "run").mark().complete


def test_what_cannot_be_is_said_before_the_run(room: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    for out, words in ((run / "a.bin", "own folder"), (tmp_path, "folder; name a file"), (tmp_path / "a.ggc", "ggc")):
        with pytest.raises(ConfigError, match=words):
            execute(request(room, run, EncodeRequest(out)))
    with pytest.raises(ConfigError, match="preset"):
        execute(request(room, run, EncodeRequest(tmp_path / "a.bin", preset="cloud")))
    assert not run.exists()


def test_nothing_but_a_stream_is_replaced(room: Path, whole: Path, tmp_path: Path) -> None:
    """And it is said before the run; the folders of a recording and of runs stay as they are."""
    copy, stream = tmp_path / "room", tmp_path / "old.bin"
    shutil.copytree(room, copy)
    for name, content in (("notes.bin", b"mine"), ("cloud.ggz", b"PK"), ("zeros.bin", bytes(99))):
        (tmp_path / name).write_bytes(content)
    stream.write_bytes(whole.with_suffix(".bin").read_bytes())
    (tmp_path / "old.ggz").write_bytes(stream.read_bytes())
    (tmp_path / "link.bin").symlink_to(whole / "map.ply")
    poses = next(path for path in copy.iterdir() if path.is_file())
    before = {path: path.read_bytes() for path in [*tmp_path.iterdir(), *copy.rglob("*"), *whole.iterdir()]
              if path.is_file()}  # fmt: skip
    for out, words in (
        (poses, "folder of a run or recording"), (copy / "a.bin", "folder of a run or recording"),
        (whole / "map.ply", "folder of a run or recording"), (whole / "new.bin", "folder of a run or recording"),
        (whole / "b" / "new.bin", "folder of a run or recording"),
        (tmp_path / "notes.bin", "no coded file"), (tmp_path / "cloud.ggz", "no coded file"),
        (tmp_path / "zeros.bin", "no coded file"), (tmp_path / "old.ggz", "no coded file"),
        (tmp_path / "link.bin", "folder of a run or recording"), (Path("/dev/null"), "no coded file"),
        (stream, "use `overwrite`"), (tmp_path / "notes.bin" / "a.bin", "is no folder"),
        (tmp_path / f"{300 * 'a'}.bin", "too long"),
    ):  # fmt: skip
        overwrite = out != stream
        with pytest.raises(ConfigError, match=words):
            execute(request(copy, tmp_path / "run", EncodeRequest(out), map=whole, overwrite=overwrite))
    with pytest.raises(RunFolderError, match="cannot be written to"):
        execute(request(copy, tmp_path / "run", EncodeRequest(Path("/proc/x.bin"))))
    assert not (tmp_path / "run").exists() and all(path.read_bytes() == held for path, held in before.items())
    outcome = execute(request(room, tmp_path / "run", EncodeRequest(stream), overwrite=True, checkpoint_every=0))
    assert outcome.encoded and stream.read_bytes() != before[stream]


@pytest.mark.parametrize("evaluate", [False, True])
def test_a_container_is_that_of_the_complete_run(room: Path, tmp_path: Path, evaluate: bool) -> None:
    asked = request(room, tmp_path / "run", EncodeRequest(tmp_path / "a.ggz"), evaluate=evaluate, energy=True)
    assert execute(asked).encode_failure is None
    write_container(RunFolder.open(tmp_path / "run"), tmp_path / "b.ggz", "r03", CodecSettings())
    assert (tmp_path / "a.ggz").read_bytes() == (tmp_path / "b.ggz").read_bytes()
    mark = json.loads(open_container(tmp_path / "a.ggz").members["run.json"])
    assert mark["complete"] and not mark["missing"]
    read_container(tmp_path / "a.ggz", tmp_path / "back")
    assert verify_run(tmp_path / "back").good


def test_what_coding_used_is_told(room: Path, tmp_path: Path) -> None:
    """Beside scoring it is one part with that; alone it has its own."""
    asked = EncodeRequest(tmp_path / "a.bin")
    outcome = execute(request(room, tmp_path / "run", asked, evaluate=True, energy=True))
    assert outcome.energy is not None and {"scoring and coding", "coding"} <= set(outcome.energy.parts)
    assert "scoring" not in outcome.energy.parts
    alone = execute(request(room, tmp_path / "alone", EncodeRequest(tmp_path / "b.bin"), energy=True))
    assert alone.energy is not None and alone.energy.parts["coding"].cpu_s > 0
    assert not any("scoring" in name for name in alone.energy.parts)
    assert alone.folder.timing().energy == alone.energy and verify_run(tmp_path / "alone").good


def test_the_command(room: Path, tmp_path: Path) -> None:
    run, few = tmp_path / "run", [word for value in FEW for word in ("--set", value)]
    words = ["run", str(room), "--stop", "3", "--no-eval", "--out", str(run), *few]
    for more, reason in (
        (["--encode-with", "qp=9"], "--encode-with goes with --encode"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", "qq=9"], "no option --qq"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", "sweep=qp"], "--sweep writes a study"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", "rate=r01"], "--rate goes with --preset splat"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", "qp=200"], "4 to 51, found '200'"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", "help"], "--encode-with: expected an option"),
        (["--encode", str(tmp_path / "a.bin"), "--encode-with", ""], "--encode-with: expected an option"),
        (["--encode", str(tmp_path / "a.ggz"), "--encode-with", "geometry-qp=8"], "--geometry-qp goes with"),
    ):
        refuse(ggslam(*words, *more), reason)
    said = succeed(*words, "--encode", str(tmp_path / "a.bin"), "--encode-with", "qp=34",
                   "--encode-with", "slices=2", "--encode-with", "no-ids")  # fmt: skip
    assert "in 2 slices" in said
    succeed("encode", str(run), str(tmp_path / "b.bin"), "--qp", "34", "--slices", "2", "--no-ids")
    assert (tmp_path / "a.bin").read_bytes() == (tmp_path / "b.bin").read_bytes()
    again = ("--overwrite", "--encode", str(tmp_path / "a.ggz"))
    assert "Gaussian" in succeed(*words, *again) and open_container(tmp_path / "a.ggz").head.gaussians > 100
