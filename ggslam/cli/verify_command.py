# SPDX-License-Identifier: Apache-2.0
"""`ggslam verify`: is a run's folder whole, and all of it of one run?"""

from __future__ import annotations

from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console

EPILOG = """
[bold]Examples[/]

  ggslam verify runs/kitchen

  ggslam verify runs/kitchen --accept      (after a file was changed on purpose)
"""


def verify(
    run: options.RunPath,
    accept: Annotated[bool, typer.Option("--accept", help="Accept the files as they are now and rewrite the manifest.")]
    = False,
) -> None:  # fmt: skip
    """Compare a run's files with its manifest: sizes and SHA-256. Exit code 2 if they are not what the run wrote."""
    from ggslam.runs.verification import accept_files, verify_run

    found = accept_files(run) if accept else verify_run(run)
    for line in found.lines():
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if not found.good:
        raise typer.Exit(2)
