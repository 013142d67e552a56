# SPDX-License-Identifier: Apache-2.0
"""`ggslam doctor`: what there is on this machine, what is missing, what to do."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer
from rich.text import Text

from ggslam.cli.console import console

EPILOG = """
[bold]Examples[/]

  ggslam doctor

  ggslam doctor --json > doctor.json      (to send along with a question)

  ggslam doctor --modes                   (what a GPU, real time, a rig or a limit of memory leave out)
"""

_MARKS = {"ok": ("ok", "green"), "missing": ("--", "dim"), "warning": ("!!", "yellow"), "broken": ("XX", "bold red")}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    modes: Annotated[bool, typer.Option("--modes", help="Print what runs of each kind leave out, and exit.")] = False,
    self_test: Annotated[
        bool, typer.Option("--self-test/--no-self-test", help="Also render an image and track two frames.")
    ] = True,
) -> None:
    """Check the installation: versions, compiled core, GPU, extras, weights. Exit code 1 if ggslam cannot work."""
    if modes:
        _print_modes()
        return
    from ggslam.jobs.doctor.checkup import examine, works

    findings = examine(self_test)
    good = works(findings)
    if as_json:
        typer.echo(json.dumps({"works": good, "findings": [asdict(finding) for finding in findings]}, indent=1))
        raise typer.Exit(0 if good else 1)
    section = ""
    for finding in findings:
        if finding.section != section:
            section = finding.section
            console.print(f"[bold]{section}[/]")
        word, style = _MARKS[finding.state]
        line = Text.assemble("  ", (word, style), f"  {finding.name}: {finding.detail}")
        console.print(line, soft_wrap=True)
        if finding.advice:
            console.print(Text(f"      -> {finding.advice}"), soft_wrap=True)
    if good:
        console.print("ggslam works here.")
    else:
        console.print("[bold red]ggslam does not work here[/]: see the lines marked XX.")
    raise typer.Exit(0 if good else 1)


def _print_modes() -> None:
    from rich.table import Table

    from ggslam.slam.modes import table

    heading, *rows = table()
    printed = Table(*heading)
    for row in rows:
        printed.add_row(*row)
    console.print("What runs can do, besides a synchronous run of one camera on the CPU with all of the map in memory:")
    console.print(printed)
