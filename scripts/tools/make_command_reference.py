# SPDX-License-Identifier: Apache-2.0
"""Writes docs/commands.md: every command with its options and examples, from the command line itself.

python scripts/tools/make_command_reference.py           # writes the page
python scripts/tools/make_command_reference.py --check   # fails if it is not up to date
"""

from __future__ import annotations

import re
import sys
import typing
from collections import Counter
from enum import Enum
from pathlib import Path
from typing import Any

import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from ggslam.cli.export_command import ExportCommand  # noqa: E402
from ggslam.cli.main import _COMMANDS, app  # noqa: E402
from ggslam.cli.old_names import OLD_NAMES  # noqa: E402

PAGE = Path(__file__).parents[2] / "docs" / "commands.md"
HEAD = """# Commands

Every command has `--help`, which says the same as this page. An option means the same in all commands: `--out` is what
to write, `--set NAME=VALUE` overrides a [setting](settings.md), `--config` names a [preset](presets.md) or a YAML file.

Exit codes: 0 done, 2 something in the input is wrong (one line says what and where), 1 ggslam or the machine is at
fault, or a run lost most of its frames, 3 a run that `--strict` finds bad or a plan without a path, 130 interrupted.
Where output is no terminal, long commands print a line of progress every 10 seconds.
"""
TABLE = "| argument or option | meaning | default |\n|---|---|---|"
_SHARED = 3
"""Commands that have the same option from which it is explained once."""
_GROUPS = {
    "Make a map": ("run", "inspect", "synth", "doctor"),
    "Look and score": ("view", "render", "report", "eval", "compare"),
    "Use a map": ("edit", "export", "volumes", "plan", "encode", "decode", "localize", "serve", "submaps", "refine"),
}


def main() -> None:
    text = page()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text)
    elif not PAGE.is_file() or PAGE.read_text() != text:
        sys.exit(f"{PAGE.name} is not up to date: run python scripts/tools/make_command_reference.py")


def page() -> str:
    """The page's Markdown."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    rest = sorted(set(commands) - {name for names in _GROUPS.values() for name in names})
    groups = {**_GROUPS, **({"More": tuple(rest)} if rest else {})}
    options = [rows(name, command).items() for name, command in commands.items()]
    counts = Counter(row for found in options for option, row in found if option.startswith("--"))
    shared = {row for row, count in counts.items() if count >= _SHARED}
    parts = [HEAD, "## Shared options\n", TABLE, *sorted(shared), ""]
    for title, names in groups.items():
        parts.append(f"## {title}\n")
        parts += [section(name, commands[name], shared) for name in names]
    return "\n".join(parts)


def rows(name: str, command: Any) -> dict[str, str]:
    """Arguments and options of a command, each as a row of a table, by name."""
    if isinstance(command, ExportCommand):
        command.name_formats()
    kinds = typing.get_type_hints(_COMMANDS[name][0])
    shown = [p for p in command.params if p.param_type_name == "argument"]
    shown += [p for p in command.params if p.param_type_name == "option" and not p.hidden]
    return {p.opts[0]: f"| {names(p, kinds[p.name])} | {cell(p.help or '')} | {default(p)} |" for p in shown}


def section(name: str, command: Any, shared: set[str]) -> str:
    """One command: what it does, examples, arguments and options; of those in `shared` only the names."""
    every = rows(name, command)
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    usage = " ".join([f"ggslam {name}", *(p.metavar or p.name.upper() for p in arguments), "[OPTIONS]"])
    lines = [f"### ggslam {name}\n", f"{cell(command.help)}\n", "```text", usage, "```\n"]
    before, _, shown = command.epilog.partition("[bold]Examples[/]")
    lines += [f"{cell(before)}\n"] if before.strip() else []
    examples = [re.sub(r"\s{2,}\(", "   # (", line.strip()) for line in shown.splitlines() if line.strip()]
    lines += ["```bash", *examples, "```\n"]
    lines += [TABLE, *(row for row in every.values() if row not in shared)]
    if others := [f"`{option}`" for option, row in every.items() if row in shared]:
        lines += [f"\n[Shared](#shared-options): {', '.join(others)}."]
    old = [f"`{before}` is the old name of `{now}`" for before, now in OLD_NAMES.get(name, {}).items()]
    return "\n".join([*lines, *([f"\n{'; '.join(old)}."] if old else []), ""])


def names(parameter: Any, kind: Any) -> str:
    """How a parameter is written."""
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`".replace("|", "\\|")
    flags = ", ".join(f"`{option}`" for option in [*parameter.opts, *parameter.secondary_opts])
    if parameter.is_flag:
        return flags
    return f"{flags} `{parameter.metavar or value_name(kind)}`".replace("|", "\\|")


def value_name(kind: Any) -> str:
    """What stands for a value: its choices, or its type."""
    kinds = [k for k in (typing.get_args(kind) or (kind,)) if k is not type(None)]
    if issubclass(kinds[0], Enum):
        return "|".join(choice.value for choice in kinds[0])
    return {int: "INTEGER", float: "NUMBER", Path: "PATH"}.get(kinds[0], "TEXT")


def default(parameter: Any) -> str:
    """The default where it says more than the meaning does."""
    value = parameter.default
    if parameter.required or value is None or callable(value) or isinstance(value, bool) or value == ():
        return ""
    return f"`{getattr(value, 'value', value)}`"


def cell(text: str) -> str:
    """Help text for a table: one line, without the markup of the terminal."""
    plain = re.sub(r"\[/?(?:bold|dim|italic)?\]", "", " ".join(text.split()))
    return re.sub(r"\b([A-Z_]+)_([A-Z]+)\b", r"`\1_\2`", plain).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    main()
