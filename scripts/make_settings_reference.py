# SPDX-License-Identifier: Apache-2.0
"""Writes docs/settings.md: every setting with its type, default and meaning, from the settings classes themselves.

    python scripts/make_settings_reference.py            # writes the page
    python scripts/make_settings_reference.py --check    # exit code 1 if the page is not up to date
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ggslam.slam.config import Config, presets

PAGE = Path(__file__).parents[1] / "docs" / "settings.md"

_INTRODUCTION = """# Settings

*This page is made from the code by `python scripts/make_settings_reference.py`.*

One set of defaults serves all recordings. What is changed is named by its path, on the command line or in a YAML file:

```bash
ggslam run SEQUENCE --set mapping.iterations_per_frame=8 --set loops.enabled=false
ggslam run SEQUENCE --config mine.yaml          # or the name of a preset: {presets}
```

```yaml
# mine.yaml: only what differs from the defaults
mapping:
  iterations_per_frame: 8
refine_iterations: 1000
```

Names that do not exist and values that cannot be are refused before a run begins. Every run writes all settings, with
their values, to `config.yaml` in its folder.
"""


def field_meanings(kind: type) -> dict[str, str]:
    """What the string below each field of a dataclass says; a field without one shares that of the next field."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    meanings: dict[str, str] = {}
    waiting: list[str] = []
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            waiting.append(node.target.id)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            meanings |= dict.fromkeys(waiting, one_line(node.value.value))
            waiting = []
        else:
            waiting = []
    return meanings


def one_line(text: str) -> str:
    """A docstring as it stands in a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def type_name(kind: Any) -> str:
    """`int`, `float`, ...; of a choice its values."""
    if typing.get_origin(kind) is typing.Literal:
        return ", ".join(f"`{value}`" for value in typing.get_args(kind))
    parts = typing.get_args(kind) if type(None) in typing.get_args(kind) else (kind,)
    names = [part.__name__ if isinstance(part, type) and not typing.get_args(part) else str(part) for part in parts]
    return " or ".join(f"`{name.replace('NoneType', 'None')}`" for name in names)


def optional_group(kind: Any) -> type | None:
    """The settings class in `Class | None`, if it is one."""
    return next((part for part in typing.get_args(kind) if dataclasses.is_dataclass(part)), None)


def sections(settings: Any, path: str = "") -> Iterator[str]:
    """A section for each group of settings."""
    kind = type(settings)
    types, meanings = typing.get_type_hints(kind), field_meanings(kind)
    fields = [(f.name, getattr(settings, f.name)) for f in dataclasses.fields(kind)]
    lines = [f"## {path.rstrip('.') or 'General'}", "", one_line((inspect.getdoc(kind) or "").split("\n\n")[0]), ""]
    rows = [
        f"| `{path}{name}` | {type_name(types[name])} | `{getattr(value, 'value', value)}` | {meanings.get(name, '')} |"
        for name, value in fields if not dataclasses.is_dataclass(value)
    ]  # fmt: skip
    if rows:
        yield "\n".join([*lines, "| setting | type | default | meaning |", "|---|---|---|---|", *rows, ""])
    for name, value in fields:
        group = optional_group(types[name])
        if dataclasses.is_dataclass(value) or group is not None:
            yield from sections(group() if group is not None else value, f"{path}{name}.")


def page() -> str:
    """The whole page."""
    names = ", ".join(f"`{name}`" for name in presets())
    return _INTRODUCTION.format(presets=names) + "\n" + "\n".join(sections(Config()))


def main() -> None:
    """Writes or checks the page."""
    if "--check" in sys.argv[1:]:
        if not PAGE.is_file() or PAGE.read_text() != page():
            sys.exit(f"{PAGE} is not up to date: run python scripts/make_settings_reference.py")
        return
    PAGE.write_text(page())
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
