# SPDX-License-Identifier: Apache-2.0
"""Runs that are cut off go on from their newest checkpoint, and end as they would have ended."""

from __future__ import annotations

import errno
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import ggslam, refuse, succeed

from ggslam.cli.run_command import go_on_command
from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run import rescue
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute, resume
from ggslam.runs import checkpoints, writing
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.start import StartRecord, hash_of
from ggslam.runs.verification import verify_run
from ggslam.slam.result import StepReport
from ggslam.system.atomic import sync_folder, write_failure
from ggslam.system.folder_lock import folder_lock
from ggslam.system.interrupts import Interrupted

SAME = ("map.ply", "trajectory.txt", "keyframes.json", "points.ply", "points_grid.ply", "objects.json",
        "classifier.npz", "votes.npz", "places.npz")  # fmt: skip
"""Files that do not tell how long anything took."""
FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "identity.final_passes=1"]
REFINE = "refine_iterations=20"


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


class KillAt(SilentObserver):
    """Kills a run at a moment.

    Args:
        frame: after this frame; None: not there.
        stage: in this stage...
        done: ...after so many steps.
    """

    def __init__(self, frame: int | None = None, stage: str = "", done: int = 0) -> None:
        self._at, self._frame, self._now = (stage, done), frame, ""
        self.notes: list[str] = []

    def begin(self, stage: str, total: int) -> None:
        self._now = stage

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise Killed

    def advance(self, done: int, total: int) -> None:
        if self._now == self._at[0] and done >= self._at[1]:
            raise Killed

    def note(self, text: str) -> None:
        self.notes.append(text)


def request(room: Path, out: Path, every: int | None = 3, **more: Any) -> RunRequest:
    settings, sequence = [*FEW, REFINE], SequenceRequest(room, stop=14, scale=0.5)
    return RunRequest(sequence, out, overrides=settings, checkpoint_every=every, **{"evaluate": False, **more})


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that nothing cut off."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert execute(request(room, out, every=0)).error is None
    return out


@pytest.fixture(scope="module")
def cut_off(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was killed after frame 10."""
    out = tmp_path_factory.mktemp("runs") / "cut"
    with pytest.raises(Killed):
        execute(request(room, out), KillAt(frame=10))
    return out


@pytest.fixture
def cut(cut_off: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(cut_off, tmp_path / "cut"))


def assert_same(run: Path, whole: Path) -> None:
    differing = [name for name in SAME if (run / name).read_bytes() != (whole / name).read_bytes()]
    assert differing == []
    assert verify_run(run).good and not (run / checkpoints.FOLDER).exists()


def states(run: Path) -> list[Path]:
    return sorted((run / checkpoints.FOLDER).glob("state-*.bin"))


@pytest.mark.long("a run that is killed and resumed")
@pytest.mark.parametrize(
    "moment", [{"frame": 0}, {"frame": 13}, {"stage": "refine", "done": 14}], ids=str
)
def test_a_run_killed_at_any_moment_goes_on(room: Path, whole: Path, tmp_path: Path, moment: dict[str, Any]) -> None:
    out = tmp_path / "run"
    with pytest.raises(Killed):
        execute(request(room, out), KillAt(**moment))
    assert not (out / "run.json").exists()
    with pytest.raises(RunFolderError, match="before it was saved.*`resume`$"):
        RunFolder.open(out)
    with pytest.raises(RunFolderError, match="`resume`.*`overwrite`"):
        execute(request(room, out))
    outcome = resume(out)
    assert outcome.error is None
    assert_same(out, whole)


@pytest.mark.long("killed and resumed three times")
def test_killed_again_and_again(room: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    # On a slow disk: nothing may be at work in the folder still when it is looked at, or gone on with.
    monkeypatch.setattr(checkpoints, "sync_folder", lambda folder: (time.sleep(0.3), sync_folder(folder)))
    with pytest.raises(Killed):
        execute(request(room, out, every=1), KillAt(frame=3))
    for frame in (5, 6, 12):
        with pytest.raises(Killed):
            resume(out, KillAt(frame=frame), checkpoint_every=2 if frame == 6 else 1)
    assert len(states(out)) == checkpoints.CheckpointTuning.states
    resume(out, checkpoint_every=0)
    assert_same(out, whole)


@pytest.mark.long("a run that is killed and resumed")
def test_a_run_killed_while_it_is_scored(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(Killed):
        execute(request(room, out, evaluate=True), KillAt(stage="score", done=3))
    mark = RunFolder.open(out).mark()
    assert not mark.complete and mark.missing == ["metrics.json", "frames.csv", "report.html"]
    outcome = resume(out, evaluate=False)
    assert outcome.error is None and RunFolder.open(out).mark().complete


def test_a_damaged_checkpoint_is_passed_over(cut: Path, whole: Path) -> None:
    newest = states(cut)[-1]
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(data)
    observer = KillAt()
    assert resume(cut, observer).error is None
    assert any("damaged" in note and "going on from the checkpoint before" in note for note in observer.notes)
    assert_same(cut, whole)


def test_no_checkpoint_is_whole(cut: Path) -> None:
    for path in states(cut):
        path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RunFolderError, match=r"state-0000.*ends too early"):
        resume(cut)


def test_what_a_state_needs_is_checked_too(cut: Path) -> None:
    for path in (cut / checkpoints.FOLDER).glob("kept-*.bin"):
        path.unlink()
    with pytest.raises(RunFolderError, match=r"kept-000001\.bin.*missing"):
        resume(cut)


def test_another_recording_is_refused(cut: Path, room: Path, whole: Path, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(room, tmp_path / "moved"))
    images = [sorted((moved / name).iterdir()) for name in ("rgb", "depth")]
    original = images[1][4].read_bytes()
    images[1][4].write_bytes(images[1][5].read_bytes() + b"0")
    with pytest.raises(RunFolderError, match="moved.* 0 .* 8 "):
        resume(cut, recording=moved)
    images[1][4].write_bytes(original)
    for image in (images[0][-1], images[1][-1]):
        image.unlink()
    shorter = tmp_path / "other"
    shutil.copytree(cut, shorter)
    for kind in images:
        for image in kind[12:]:
            image.unlink(missing_ok=True)
    refuse_words = "moved.*other.*14.*12"
    with pytest.raises(GgslamError, match=refuse_words):
        resume(shorter, recording=moved)
    assert resume(cut).error is None  # where it was, it is as it was
    assert_same(cut, whole)


def test_what_would_change_the_result_is_refused(cut: Path, tmp_path: Path) -> None:
    for words in (["--seed", 3], ["--out", tmp_path], ["--iterations", 4], ["--overwrite"], ["--set", "seed=2"]):
        refuse(ggslam("run", "--resume", cut, *words), "--resume", f"{words[0]} cannot be changed")
    refuse(ggslam("run", "--resume", tmp_path / "nowhere"), "nowhere: no such folder")
    start = (cut / checkpoints.FOLDER / "start.json").read_text()
    (cut / checkpoints.FOLDER / "start.json").write_text(start.replace('"sh_degree": -1', '"sh_degree": 1'))
    refuse(ggslam("run", "--resume", cut), "start.json: the settings are not those that the run was begun with")
    (cut / checkpoints.FOLDER / "start.json").write_text(start.replace('"ggslam": "', '"ggslam": "0.', 1))
    refuse(ggslam("run", "--resume", cut), "was begun with ggslam 0.")


def test_nothing_to_resume(whole: Path, room: Path, tmp_path: Path) -> None:
    refuse(ggslam("run", "--resume", whole), "there is nothing to resume: the run is complete")
    out = tmp_path / "run"
    with pytest.raises(Killed):
        execute(request(room, out, every=0), KillAt(frame=5))
    refuse(ggslam("run", "--resume", out), "is an empty folder")


@pytest.mark.long("a run that is ended and resumed")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_saves_what_there_is(room: Path, whole: Path, tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "run"
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip(f"whoever started the tests (nohup, a shell's background) lets them ignore {number.name}")

    def follow(slam: Any, frame: Any, report: StepReport) -> None:
        if report.frame.frame_index == 7:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    outcome = execute(request(room, out, every=100), follower=follow)
    assert isinstance(outcome.error, KeyboardInterrupt) and len(outcome.result.frames) == 8
    assert isinstance(outcome.error, Interrupted) == (number != signal.SIGINT)
    mark = RunFolder.open(out).mark()
    assert not mark.complete and len(RunFolder.open(out).trajectory()) == 8
    assert signal.getsignal(number) is before
    assert go_on_command(out) == [f"next: ggslam run --resume {out}"]
    outcome = resume(out, checkpoint_every=0)  # the state of the last frame was saved
    assert go_on_command(out) == []
    assert outcome.error is None and outcome.result.times.saved == 1
    assert_same(out, whole)


@pytest.mark.long("two runs, one of them resumed")
def test_a_disk_too_full_for_checkpoints_is_no_reason_to_stop(
    room: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *_: object) -> None:
        raise write_failure(path, OSError(errno.ENOSPC, "No space left on device"))

    observer, real, calls = KillAt(), checkpoints.write_array_file, []

    def sometimes(path: Path, *more: Any) -> Any:
        calls.append(path)
        return full(path) if len(calls) % 2 else real(path, *more)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(checkpoints, "write_array_file", sometimes)
        execute(request(room, tmp_path / "run", every=2), KillAt(frame=12))
    assert resume(tmp_path / "run").error is None
    assert_same(tmp_path / "run", whole)
    monkeypatch.setattr(checkpoints, "write_array_file", full)
    assert execute(request(room, tmp_path / "again"), observer).error is None
    told = [note for note in observer.notes if "no checkpoint" in note]
    assert len(told) == 1 and "No space left on device; the run goes on" in told[0]
    assert_same(tmp_path / "again", whole)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where runs go that cannot be saved in their folder."""
    (tmp_path / "small").mkdir()
    (tmp_path / "large").mkdir()
    monkeypatch.setattr(rescue, "places", lambda: [tmp_path / "small", tmp_path / "large"])
    return tmp_path / "large"


Saving = Callable[[Path, RunOutcome | None], None]


def full_below(monkeypatch: pytest.MonkeyPatch, function: str, *folders: Path) -> None:
    """Files of a kind cannot be written below some folders: there the disk is full."""
    real = getattr(writing, function)

    def write(path: Path, *more: Any, **named: Any) -> Any:
        if any(folder in Path(path).parents for folder in folders):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return real(path, *more, **named)

    monkeypatch.setattr(writing, function, write)


@pytest.mark.long("a run that is saved elsewhere and resumed")
def test_a_map_that_cannot_be_saved_goes_elsewhere(
    room: Path, whole: Path, tmp_path: Path, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_below(monkeypatch, "write_gaussian_ply", tmp_path / "run", tmp_path / "small")
    outcome = execute(request(room, tmp_path / "run"))
    assert outcome.failure is not None and outcome.failure.exit_code == 1
    assert "No space left on device" in str(outcome.failure) and "the run was saved to" in str(outcome.failure)
    assert outcome.folder.path.parent == elsewhere and str(outcome.folder.path) in str(outcome.failure)
    saved = RunFolder.open(outcome.folder.path)
    assert (saved.path / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
    kept = RunFolder.open(tmp_path / "run")  # what is small is in the run's own folder, too
    assert (kept.path / "trajectory.txt").read_bytes() == (whole / "trajectory.txt").read_bytes()
    assert "map.ply" in kept.mark().missing and not kept.mark().complete and states(tmp_path / "run")
    monkeypatch.undo()
    assert resume(tmp_path / "run").error is None  # when there is room again
    assert_same(tmp_path / "run", whole)


def test_where_not_all_fits_the_map_goes_first(
    room: Path, whole: Path, tmp_path: Path, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_below(monkeypatch, "write_bytes", tmp_path)  # places.npz and what belongs to objects
    monkeypatch.setattr(writing, "write_objects", lambda folder, scene: writing.write_gaussian_ply(
        folder / "map.ply", scene.gaussians, extra=("object_id", "identity")))  # fmt: skip
    outcome = execute(request(room, tmp_path / "run"))
    assert outcome.failure is not None and "its map, poses and settings were saved to" in str(outcome.failure)
    folder = outcome.folder.path
    assert (folder / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
    assert (folder / "trajectory.txt").is_file() and (folder / "config.yaml").is_file()


def test_a_folder_deleted_in_mid_run(room: Path, whole: Path, tmp_path: Path, elsewhere: Path) -> None:
    def follow(slam: Any, frame: Any, report: StepReport) -> None:
        if report.frame.frame_index == 7:
            shutil.rmtree(tmp_path / "a")
            (tmp_path / "a").write_text("in the way")

    observer = KillAt()
    outcome = execute(request(room, tmp_path / "a" / "run"), observer, follow)
    assert outcome.failure is not None and outcome.folder.path.parent.parent == tmp_path
    assert (outcome.folder.path / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
    assert any("no checkpoint" in note for note in observer.notes)


def test_two_runs_into_one_folder(room: Path, cut: Path, tmp_path: Path) -> None:
    program = "\n".join([
        "import sys, time; from pathlib import Path; from ggslam.system.folder_lock import folder_lock",
        "with folder_lock(Path(sys.argv[1])):", "    print('locked', flush=True)", "    time.sleep(60)",
    ])  # fmt: skip
    out = tmp_path / "run"
    out.mkdir()
    for folder, words in [(out, ["run", room, "--out", out]), (cut, ["run", "--resume", cut])]:
        other = subprocess.Popen([sys.executable, "-c", program, str(folder)], stdout=subprocess.PIPE)
        assert other.stdout is not None and other.stdout.readline() == b"locked\n"
        try:
            refuse(ggslam(*words), f"{folder}: process {other.pid} is writing a run there")
        finally:
            other.kill()
            other.wait()
            other.stdout.close()
        with folder_lock(folder):  # whoever was killed holds no lock
            pass


@pytest.mark.long("a process of its own, killed by the system's signal")
def test_a_real_kill(room: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["run", room, "--out", out, "--stop", 14, "--scale", 0.5, "--no-eval",
             "--checkpoint-every", 1]  # fmt: skip
    settings = [word for setting in (*FEW, REFINE) for word in ("--set", setting)]
    process = subprocess.Popen([sys.executable, "-m", "ggslam", *map(str, words), *settings])
    deadline = time.monotonic() + 120
    while len(states(out)) < 2 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert "going on after frame" in succeed("run", "--resume", out)
    assert_same(out, whole)


def test_a_model_runs_only_if_it_is_named_again(cut: Path) -> None:
    """Whoever hands on a run could have written any model into it, with the right sum."""
    path = cut / checkpoints.FOLDER / StartRecord.FILE
    start = json.loads(path.read_text())
    start["config"]["masks"]["model"] = "a model.onnx"
    path.write_text(json.dumps({**start, "config_hash": hash_of(start["config"])}))
    command = f"ggslam run --resume {cut} --set masks.model='a model.onnx'"
    refuse(ggslam("run", "--resume", cut), "a model of masks, which is run like a program", command)
    assert go_on_command(cut) == [f"next: {command}"]
    with pytest.raises(ConfigError, match=r"--set masks\.model"):
        resume(cut, model="another.onnx")
    with pytest.raises(GgslamError, match=r"a model\.onnx"):
        resume(cut, model="a model.onnx")


def test_no_model_is_taken_by_a_run_without(cut: Path) -> None:
    again = ("run", "--resume", cut, "--set")
    refuse(ggslam(*again, "masks.model=a.onnx"), "was begun without a model of masks")
    refuse(ggslam(*again, "mapping.iterations_per_frame=1"), "--set cannot be changed")
