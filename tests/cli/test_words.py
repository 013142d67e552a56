# SPDX-License-Identifier: Apache-2.0
"""Names of options, help, which format a file's name says, and progress where output is no terminal."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from ggslam.cli import console as printing
from ggslam.cli import main
from ggslam.cli.console import ProgressLines, duration
from ggslam.cli.observer import ProgressObserver
from ggslam.cli.old_names import OLD_NAMES
from ggslam.errors import ConfigError
from ggslam.formats.table import choose_writer

COMMANDS = typer.main.get_command(main.app).commands  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_and_says_what_every_option_does(name: str) -> None:
    shown = CliRunner().invoke(main.app, [name, "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0 and "Examples" in shown.output and f"ggslam {name}" in shown.output
    assert [p.name for p in COMMANDS[name].params if not p.help] == []


def test_examples_of_help_use_options_that_exist() -> None:
    for name, command in COMMANDS.items():
        known = {option for p in command.params for option in p.opts + p.secondary_opts}
        for line in re.findall(rf"^  ggslam {name} (.*)$", command.epilog, re.M):
            assert {word for word in line.split() if word.startswith("--")} <= known, line


@pytest.mark.parametrize("command", OLD_NAMES)
def test_old_names_of_options_are_understood(command: str) -> None:
    options = {option: p for p in COMMANDS[command].params for option in p.opts}
    for old, new in OLD_NAMES[command].items():
        assert new in options and old not in options
        value = [] if options[new].is_flag else ["7"]
        words = ["a", "b", *(["--out", "o.ply"] if "--out" in options and new != "--out" else []), old, *value]
        needed = sum(p.param_type_name == "argument" for p in COMMANDS[command].params)
        context = COMMANDS[command].make_context(command, words[2 - needed :])
        assert str(context.params[options[new].name]) in ("7", "True")
        if value:
            joined = [*words[2 - needed : -2], f"{old}=7"]
            assert str(COMMANDS[command].make_context(command, joined).params[options[new].name]) == "7"


@pytest.mark.parametrize(
    ("name", "kind"),
    [("x.ply", "ply"), ("x.OBJ", "mesh"), ("x.glb", "mesh"), ("x.spz", "spz"), ("x.splat", "splat"), ("x.pcd", "pcd"),
     ("x.txt", "trajectory"), ("x.compressed.ply", "compressed-ply")],
)  # fmt: skip
def test_the_name_says_the_format(name: str, kind: str) -> None:
    assert choose_writer(None, Path(name), None).name == kind
    assert choose_writer(kind, Path(name), None).name == kind


def test_formats_that_share_a_suffix_and_folders() -> None:
    for kind in ("segmented", "compressed-ply", "mesh"):
        assert choose_writer(kind, Path("x.ply"), None).name == kind
    assert choose_writer("gltf", Path("x.glb"), None).name == "gltf"
    assert choose_writer("colmap", Path("folder"), None).name == "colmap"
    assert choose_writer(None, Path("folder"), "mug,7").name == "ply"


@pytest.mark.parametrize(
    ("asked", "name", "words"),
    [("mesh", "x.splat", r"x\.splat.*splat.*`format`.*mesh"), ("ply", "x.obj", r"x\.obj.*mesh.*`format`.*ply"),
     ("points", "x.ply", r"x\.ply.*`format`.*points"), (None, "x.xyz", r"x\.xyz.*`format`"),
     (None, "folder", "folder.*`format`")],
)  # fmt: skip
def test_a_name_against_the_format_is_refused(asked: str | None, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        choose_writer(asked, Path(name), None)


def test_a_log_gets_a_line_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(printing.time, "monotonic", lambda: clock[0])
    output = io.StringIO()
    with ProgressLines(Console(file=output, width=60)) as bar:
        for task in bar.tasks:
            task.get_time = lambda: clock[0]
        bar.get_time = lambda: clock[0]
        observer = ProgressObserver(bar)
        observer.begin("refine", 50)
        for done in range(1, 51):
            clock[0] += 1.0
            observer.advance(done, 50)
    lines = output.getvalue().splitlines()
    assert [line.split(",")[0] for line in lines] == [f"refine {n}/50" for n in (10, 20, 30, 40, 50)]
    assert lines[0] == "refine 10/50, 1.0/s, 40 s left" and lines[-1].startswith("refine 50/50, 1.0/s")


def test_a_terminal_keeps_its_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(printing, "console", Console(file=io.StringIO(), force_terminal=True))
    assert not isinstance(printing.progress_bar(), ProgressLines)
    monkeypatch.setattr(printing, "console", Console(file=io.StringIO(), force_terminal=False))
    assert isinstance(printing.progress_bar(), ProgressLines)


def test_lines_of_a_log_are_not_wrapped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    words, names = " ".join(["word"] * 100), [f"precision {n}" for n in range(20)]
    output = io.StringIO()
    console = printing.PlainConsole(file=output)
    console.print(words)
    console.print(printing.table("scores", names, [["0.123"] * 20]))
    lines = output.getvalue().splitlines()
    assert lines[0] == words and "precision 19" in output.getvalue() and max(map(len, lines)) < 1000
    assert printing.PlainConsole(file=output, width=60).width == 60, "a width that was asked for counts"
    monkeypatch.setenv("COLUMNS", "70")
    assert printing.PlainConsole(file=io.StringIO()).width == 70


def test_durations() -> None:
    assert [duration(s) for s in (8.6, 125, 4800)] == ["9 s", "2 min 5 s", "1 h 20 min"]
