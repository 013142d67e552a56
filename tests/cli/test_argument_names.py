# SPDX-License-Identifier: Apache-2.0
"""The library names arguments, the command line options."""

from __future__ import annotations

import ast
import re
from functools import lru_cache
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import ggslam
from ggslam.cli.argument_names import option_of, with_options
from ggslam.cli.main import app

ROOT = Path(ggslam.__file__).parent
COMMANDS = {"pip install", "ggslam ", "run --", "limit a run", "--device cuda", "--version", "--threads"}
"""Texts with these speak of a command that is to be typed, or start one."""
EDITS = {"move", "duplicate", "merge", "rename", "remove", "keep", "recolor"}


@lru_cache(maxsize=1)
def messages() -> list[tuple[str, str]]:
    """Strings of the library that are no docstrings, with where they stand."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        if path.relative_to(ROOT).parts[0] == "cli":
            continue
        documents = set()  # the walk comes to statements before their parts
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Expr):
                documents.add(id(node.value))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
                found.append((node.value, f"{path.relative_to(ROOT)}:{node.lineno}"))
    return found


def options() -> set[str]:
    commands = typer.main.get_command(app).commands.values()  # type: ignore[attr-defined]
    return {
        option
        for command in commands
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }


def test_the_library_knows_no_options() -> None:
    speaking = [(text, place) for text, place in messages() if re.search(r"(^|[\s(,:])--[a-z]", text)]
    assert [place for text, place in speaking if not any(command in text for command in COMMANDS)] == []
    assert speaking  # advice of doctor


def test_every_argument_that_is_named_has_an_option() -> None:
    known, named = options() | {f"--{edit}" for edit in EDITS}, 0
    for text, place in messages():
        for argument in re.findall(r"`([a-z][a-z_]*)`", text):
            assert option_of(argument) in known, f"{place}: {argument}"
            named += 1
    assert named > 40


def test_names_become_options() -> None:
    assert with_options("`no_eval` in `ggslam run`, not `map`") == "--no-eval in `ggslam run`, not --map"
    assert with_options("`overrides` x: expected name=value") == "--set x: expected name=value"


@pytest.mark.parametrize("words", [("run", "nowhere", "--localize-only"), ("run", "nowhere", "--set", "mapping")])
def test_errors_of_commands_name_options(words: tuple[str, ...], tmp_path: Path) -> None:
    error = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")]).exception
    assert words[2] in str(error) and "`" not in str(error)
