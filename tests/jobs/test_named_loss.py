# SPDX-License-Identifier: Apache-2.0
"""`ggslam run --loss`: a loss of the user's own, by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import ggslam, refuse, succeed

from ggslam.errors import ConfigError
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.named_loss import NamedLoss
from ggslam.jobs.run.pipeline import RunRequest, execute, resume
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.slam.result import StepReport

CODE = '''
import torch
from dataclasses import dataclass
from beside import FACTOR

def redder(view, keyframe):
    assert view.image.requires_grad and keyframe.color.shape[2] == 3
    return -FACTOR * view.image[0].mean()

def pairs(view, keyframe):
    return view.image

def number(view, keyframe):
    return 3.0

def endless(view, keyframe):
    return torch.log(0 * view.depth).sum()

def fails(view, keyframe):
    return view.picture.mean()  # line 20

@dataclass
class Late:
    calls: int = 0

    def __call__(self, view, keyframe):
        self.calls += 1
        if self.calls > 6:
            raise ZeroDivisionError("late")
        return 0 * view.image.sum()

late = Late()
no_function = 7
'''
FEW = ["mapping.iterations_per_frame=2", "mapping.first_frame_iterations=4", "identity.enabled=false"]
RUN = ["--stop", 3, "--scale", 0.5, "--refine", 4, "--no-eval", *(w for text in FEW for w in ("--set", text))]


class Killed(BaseException):
    """Stands for a kill."""


class KillAfter(SilentObserver):
    """Kills a run after a frame."""

    def __init__(self, frame: int) -> None:
        self._frame = frame

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise Killed


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "beside.py").write_text("FACTOR = 5\n")
    (tmp_path / "own.py").write_text(CODE)
    return tmp_path / "own.py"


def redness(run: Path) -> float:
    return float(RunFolder.open(run).gaussians().rgb[:, 0].mean())


@pytest.mark.long("three runs")
def test_the_map_follows_it(
    room: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = {}
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, more in (("plain", []), ("file", ["--loss", f"{file}:redder"]), ("module", ["--loss", "own:redder"])):
        said[name] = succeed("run", room, "--out", tmp_path / name, *RUN, *more)
    assert redness(tmp_path / "file") > redness(tmp_path / "plain") + 0.02
    assert redness(tmp_path / "module") == redness(tmp_path / "file")
    assert "own:redder" in said["module"] and "loss of your own" not in said["plain"]
    assert any("own:redder" in note for note in RunFolder.open(tmp_path / "module").mark().notes())


@pytest.mark.parametrize(
    ("name", "words"),
    [("pairs", ["scalar", "[3, 60, 80]"]), ("number", ["scalar", "float"]), ("endless", ["not finite"]),
     ("fails", ["AttributeError", "picture", "own.py, line 20"]), ("nothing", ["no nothing", "redder"]),
     ("no_function", ["no function"])],
)  # fmt: skip
def test_what_is_no_loss_is_one_error_before_the_run(
    room: Path, file: Path, tmp_path: Path, name: str, words: list[str]
) -> None:
    refuse(ggslam("run", room, "--out", tmp_path / "run", *RUN, "--loss", f"{file}:{name}"), "--loss", name, *words)
    assert not (tmp_path / "run").exists()


def test_what_cannot_be_imported_is_refused(room: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("import torch\n\nx = 1 +\n")
    (tmp_path / "raises.py").write_text("import torch\n\n1 / 0\n")
    cases = {
        "just_a_word": ["module:function"], "nowhere.at_all:f": ["nowhere"], f"{tmp_path}/none.py:f": ["no such file"],
        f"{tmp_path}/broken.py:f": ["SyntaxError"], f"{tmp_path}/raises.py:f": ["ZeroDivisionError", "line 3"],
        "torch:": ["module:function"], "": ["module:function"],
    }  # fmt: skip
    for name, words in cases.items():
        refuse(ggslam("run", room, "--out", tmp_path / "run", *RUN, "--loss", name), *words)
    assert not (tmp_path / "run").exists()


def test_a_loss_that_fails_later_ends_the_run_with_what_there_is(room: Path, file: Path, tmp_path: Path) -> None:
    done = ggslam("run", room, "--out", tmp_path / "run", *RUN, "--loss", f"{file}:late")
    refuse(done, "ZeroDivisionError: late")
    assert len(RunFolder.open(tmp_path / "run").gaussians()) > 0


@pytest.mark.long("a run that is killed and resumed")
def test_a_run_goes_on_with_its_loss_and_with_no_other(room: Path, file: Path, tmp_path: Path) -> None:
    loss = f"{file}:redder"

    def request(out: str, every: int) -> RunRequest:
        return RunRequest(
            SequenceRequest(room, stop=6, scale=0.5), tmp_path / out, overrides=[*FEW, "refine_iterations=4"],
            evaluate=False, checkpoint_every=every, loss=loss,
        )  # fmt: skip

    assert execute(request("whole", 0)).error is None
    with pytest.raises(Killed):
        execute(request("cut", 2), KillAfter(4))
    for other in (None, f"{file}:number"):
        with pytest.raises(ConfigError, match="--resume") as refused:
            resume(tmp_path / "cut", loss=other)
        assert loss in str(refused.value)
    assert resume(tmp_path / "cut", loss=loss).error is None
    assert (tmp_path / "cut" / "map.ply").read_bytes() == (tmp_path / "whole" / "map.ply").read_bytes()


def test_it_trains_nothing_where_the_map_stays(room: Path, file: Path, tmp_path: Path) -> None:
    only = ["--map", tmp_path, "--localize-only"]
    refuse(ggslam("run", room, "--out", tmp_path / "run", *only, "--loss", f"{file}:redder"), "--localize-only")


def test_features_are_asked_for_by_the_function(file: Path) -> None:
    loss = NamedLoss.load(f"{file}:redder")
    assert not loss.uses_features
    loss.function.uses_features = True  # type: ignore[attr-defined]
    assert NamedLoss("again", loss.function).uses_features
