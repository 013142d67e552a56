# SPDX-License-Identifier: Apache-2.0
"""`ggslam` as people type it, inside this process: a process of its own would load torch for every command."""

from __future__ import annotations

import contextlib
import io
import sys
from dataclasses import dataclass
from unittest import mock

from ggslam.cli.main import main


@dataclass
class Done:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def ggslam(*words: object) -> Done:
    """Runs the whole command line, with what it makes of errors. The code of an error nobody foresaw is raised."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out), contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["ggslam", *map(str, words)]),
    ):  # fmt: skip
        try:
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def succeed(*words: object) -> str:
    """What a command prints that must not fail."""
    done = ggslam(*words)
    assert done.returncode == 0, (words, done)
    return done.stdout


def refuse(done: Done, *words: str) -> None:
    """Exit code 2 and one clear error with these words."""
    assert done.returncode == 2, done
    message = " ".join(done.stderr.split())
    assert all(word in message for word in words), message
