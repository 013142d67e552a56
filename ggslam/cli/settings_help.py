# SPDX-License-Identifier: Apache-2.0
"""`ggslam run --help-settings`: what can be set, printed."""

from __future__ import annotations

import shutil
import textwrap
from typing import Annotated

import typer

from ggslam.errors import ConfigError


def _print_basic(wanted: bool) -> None:
    if wanted:
        print_settings(None)
        raise typer.Exit()


def _print_named(part: str | None) -> None:
    if part is not None:
        print_settings("" if part == "all" else part)
        raise typer.Exit()


HelpSettings = Annotated[
    bool,
    typer.Option(
        "--help-settings",
        callback=_print_basic,
        is_eager=True,
        help="Print the settings worth knowing for --set, and exit.",
    ),
]
HelpSetting = Annotated[
    str | None,
    typer.Option(
        "--help-setting", metavar="NAME|all", callback=_print_named, is_eager=True,
        help="Print the settings with NAME in their names, or all of them, and exit.",
    ),
]  # fmt: skip


def print_settings(part: str | None) -> None:
    """Prints settings with default, range and text.

    Args:
        part: of their names; None: the basic ones.

    Raises:
        ConfigError: no setting has such a name.
    """
    from ggslam.slam.config import Config  # imports torch: only when needed
    from ggslam.system.settings import walk_public

    known = walk_public(Config)
    chosen = [one for one in known if (one.declaration.basic if part is None else part.lower() in one.path)]
    if not chosen:
        raise ConfigError(f"--help-setting {part}: no setting has this in its name")
    width = max(60, min(120, shutil.get_terminal_size().columns))
    for one in chosen:
        values = one.values()
        default = str(one.default).lower() if isinstance(one.default, bool) else one.default
        typer.echo(f"{one.path}={default}" + f"   ({values})" * bool(values))
        typer.echo(textwrap.fill(one.text, width, initial_indent="    ", subsequent_indent="    "))
    if part is None:
        typer.echo(f"\nThese are {len(chosen)} of {len(known)}; --help-setting all prints all of them.")
