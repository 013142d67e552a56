# SPDX-License-Identifier: Apache-2.0
"""Writes docs/licences.md: what ggslam depends on, and under which licence, as the installed packages say.

    python scripts/tools/make_licence_table.py          # all extras should be installed
    python scripts/tools/make_licence_table.py --check  # says what is not allowed or not installed, writes nothing
"""

from __future__ import annotations

import argparse
import re
import sys
from importlib import metadata
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "licences.md"
BANNED = re.compile(r"\bA?GPL|GNU (Affero )?General|non-?commercial|CC-BY-NC", re.I)
LESSER = re.compile(r"LGPL|Lesser", re.I)
ONLY_TESTS = ("test", "dev", "docs", "bench", "browser")


WHEELS = [
    "The wheels of `scripts/build_wheels.sh` also hold parts of GCC's C++ library (libstdc++: GPL-3.0-or-later WITH",
    "GCC-exception-3.1). The exception lets compiled programs that contain it have any licence.",
]
"""Lines of the page on what is linked into the core."""


def requirements() -> dict[str, list[str]]:
    """Extra ("" for the core) -> packages it names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lists = {"": project["dependencies"], **project["optional-dependencies"]}
    return {
        extra: [re.split(r"[\[<>=!~; ]", text)[0] for text in texts if not text.startswith("ggslam")]
        for extra, texts in lists.items()
    }


def licence_of(name: str) -> str | None:
    """What a package says its licence is; None if it is not installed."""
    try:
        info = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return None
    said = info.get("License-Expression")
    if said:
        return str(said)
    classes = [c.split(" :: ")[-1] for c in info.get_all("Classifier") or [] if c.startswith("License ::")]
    short = (info.get("License") or "").strip().splitlines()
    return ", ".join(c for c in classes if c != "OSI Approved") or (short[0][:60] if short else "not said")


def rows() -> list[tuple[str, str, str]]:
    """(package, extra, licence), the core's first."""
    out = []
    for extra, names in requirements().items():
        for name in sorted(set(names)):
            out.append((name, extra or "core", licence_of(name) or "not installed here"))
    return out


def problems(table: list[tuple[str, str, str]]) -> list[str]:
    """Licences that a dependency may not have. Programs that only tests and documentation use may be LGPL."""
    return [
        f"{name} ({extra}): {licence}" for name, extra, licence in table
        if BANNED.search(licence) and not (LESSER.search(licence) and extra in ONLY_TESTS)
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args()
    table = rows()
    for problem in problems(table):
        print(f"not allowed: {problem}")
    if not given.check:
        lines = ["# Licences", "", "ggslam is under Apache-2.0. What it depends on, as the packages themselves say;",
                 "written by `scripts/tools/make_licence_table.py`.", "", "| package | needed by | licence |",
                 "|---|---|---|"]  # fmt: skip
        lines += [f"| {name} | {extra} | {licence} |" for name, extra, licence in table]
        PAGE.write_text("\n".join([*lines, "", *WHEELS, ""]))
        print(f"{PAGE}: {len(table)} packages")
    sys.exit(1 if problems(table) else 0)


if __name__ == "__main__":
    main()
