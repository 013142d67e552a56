# SPDX-License-Identifier: Apache-2.0
"""Imports run downwards only, as the plan of the house says."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "ggslam"
BOTTOM = {"scene", "native", "errors", "cuda"}
LOWER = {"rendering", "sequences", "formats", "features"}
MIDDLE = {"tracking", "mapping", "evaluation", "reporting", "loops", "objects", "volumes", "submaps", "coding"}
MIDDLE |= {"viewer"}


def room(path: Path) -> str:
    name = path.relative_to(ROOT).parts[0].removesuffix(".py")
    return "cli" if name == "__main__" else name


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        rooms |= {name.split(".")[1] for name in names if name.startswith("ggslam.")}
    return rooms


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_downwards(path: Path) -> None:
    own = room(path)
    others = imported_rooms(path) - {own}
    if own in BOTTOM:
        assert others <= BOTTOM, f"{own} imports {others}"
    elif own in LOWER:
        # formats hand out files that appear whole; sequences write some.
        assert others <= BOTTOM | ({"formats"} if own == "sequences" else set()), f"{own} imports {others}"
    elif own in MIDDLE:
        assert others <= BOTTOM | LOWER, f"{own} imports {others}"
    elif own != "cli":
        assert "cli" not in others


def test_heavy_packages_are_not_imported_at_start() -> None:
    """`ggslam --help` must not wait for torch."""
    for path in [ROOT / "cli" / "main.py", ROOT / "errors.py", ROOT / "cli" / "run_command.py"]:
        tree = ast.parse(path.read_text())
        top = {n.names[0].name for n in tree.body if isinstance(n, ast.Import)}
        top |= {n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module}
        assert not any(name.split(".")[0] in {"torch", "cv2", "kornia"} for name in top)
