# SPDX-License-Identifier: Apache-2.0
"""Writes docs/settings.md: every setting with its default, range and meaning, as the settings classes declare them.

    python scripts/tools/make_settings_reference.py            # writes the page
    python scripts/tools/make_settings_reference.py --check    # exit code 1 if the page is not up to date
"""

from __future__ import annotations

import inspect
import sys
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ggslam.jobs.localize.settings import LocalizeSettings
from ggslam.slam.config import Config, presets
from ggslam.system.settings import Known, group_of, walk

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"

_INTRODUCTION = """# Settings

*This page is made from the code by `python scripts/tools/make_settings_reference.py`.*

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

Names that do not exist and values out of their range are refused before a run begins, with their path:
`tracking.photometric.shrink: expected 1 to 16, found 0`. Every run writes all settings, with their values, to
`config.yaml` in its folder. `ggslam run --help-settings` prints the table below, `--help-setting all` every setting,
`--help-setting depth` those with "depth" in their names. In Python: `Config(mapping={{"iterations_per_frame": 8}})`.
"""


_STORED = """# Settings of stored maps

`ggslam localize` takes these with `--set`, and `tracking.*` as above; `ggslam submaps` takes `submaps.*`. Lengths of
`submaps` that are not set are the store's own, and of a new store, or of a cloud, what suits the sensor.
"""


def cell(text: str) -> str:
    """Text as it stands in a cell of a table."""
    return text.replace("|", "\\|")


def type_name(kind: Any) -> str:
    """`int`, `float`, `DepthNoise or None`..."""
    parts = typing.get_args(kind) if type(None) in typing.get_args(kind) else (kind,)
    names = [part.__name__ if isinstance(part, type) and not typing.get_args(part) else str(part) for part in parts]
    return " or ".join(f"`{name.replace('NoneType', 'None')}`" for name in names)


def values_of(setting: Known) -> str:
    """What a setting may be: its choices, its range, or its type."""
    if setting.kind is bool:
        return "`true`, `false`"
    if setting.choices:
        return ", ".join(f"`{value}`" for value in setting.choices)
    return setting.range() or type_name(setting.kind)


def default_of(setting: Known) -> str:
    """Its default as YAML has it."""
    text = str(setting.default)
    return f"`{text.lower() if setting.kind is bool else text}`" if text else "none"


def table(settings: Iterable[Known]) -> str:
    """Rows of settings."""
    rows = [
        f"| `{one.path}` | {default_of(one)} | {values_of(one)} | {cell(one.text)} |"
        for one in settings
    ]
    return "\n".join(["| setting | default | values | meaning |", "|---|---|---|---|", *rows, ""])


def groups(kind: type, path: str = "") -> Iterator[tuple[str, str]]:
    """Path and one line of text of each group of settings."""
    yield path, " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())
    for name, declared in typing.get_type_hints(kind).items():
        group = group_of(declared)
        if group is not None:
            yield from groups(group, f"{path}{name}.")


def sections(kind: type, known: list[Known]) -> list[str]:
    """A heading, a text and a table for each group of settings."""
    parts = []
    for path, text in groups(kind):
        if inside := [one for one in known if one.path.rpartition(".")[0] == path.rstrip(".")]:
            parts += [f"## {path.rstrip('.') or 'General'}", "", text, "", table(inside)]
    return parts


def page() -> str:
    """The whole page."""
    known = list(walk(Config))
    stored = [one for one in walk(LocalizeSettings) if not one.path.startswith("tracking.")]
    parts = [_INTRODUCTION.format(presets=", ".join(f"`{name}`" for name in presets()))]
    parts += ["## The ones to know", "", table(one for one in known if one.declaration.basic)]
    parts += ["Those below are for experts, all of them by their groups.", ""]
    parts += sections(Config, known)
    parts += [_STORED, *sections(LocalizeSettings, stored)]
    return "\n".join(parts)


def main() -> None:
    """Writes or checks the page."""
    if "--check" in sys.argv[1:]:
        if not PAGE.is_file() or PAGE.read_text() != page():
            sys.exit(f"{PAGE} is not up to date: run python scripts/tools/make_settings_reference.py")
        return
    PAGE.write_text(page())
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
