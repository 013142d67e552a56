# SPDX-License-Identifier: Apache-2.0
"""Imports run down the rooms only, as the plan of the house says, and nowhere in a circle."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "ggslam"
FLOORS = (
    {"cli"},
    {"jobs"},
    {"runs"},
    {"slam", "localization", "merging", "changes", "driving"},
    {"tracking", "mapping", "loops", "movers", "objects", "volumes", "submaps", "coding", "evaluation", "viewer",
     "reporting"},
    {"rendering", "sequences", "formats", "features", "synthetic", "geometry", "sight", "messages"},
    {"scene", "native", "cuda", "middleware"},
    {"system", "abi"},
    {"errors"},
)
"""From the top down. A room imports from floors below its own only."""
JOBS = (
    {"watch"},
    {"view", "serve"},
    {"export", "plan"},
    {"volumes"},
    {"run"},
    {"report"},
    {"update"},
    {"changes"},
    {"eval", "edit", "localize", "compare", "encode", "render", "doctor", "batch", "merge", "play",
     "refine"},
    {"stores"},
    {"submaps", "tasks"},
    {"progress"},
)
"""The order inside `jobs`, likewise."""
ROOT_MODULES = {"__init__", "__main__", "errors"}


@cache
def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


@cache
def imports(name: str, at_loading_only: bool = False) -> dict[str, int]:
    """Modules of the package that a module imports, with the line; those of functions and of type checking, too."""
    tree = ast.parse(modules()[name].read_text())
    found: dict[str, int] = {}
    for node in top_level(tree) if at_loading_only else ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name}:{node.lineno}: imports are written with the whole name"
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {n if n in modules() else str(node.module): node.lineno for n in whole}
        elif isinstance(node, ast.Import):
            found |= {alias.name: node.lineno for alias in node.names}
    return {n: line for n, line in found.items() if n.split(".")[0] == "ggslam" and n != name}


def top_level(tree: ast.Module) -> list[ast.AST]:
    """Statements that run when a module is loaded."""
    found: list[ast.AST] = []
    pending: list[ast.AST] = list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        found.append(node)
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            pending += ast.iter_child_nodes(node)
    return found


def level(order: tuple[set[str], ...], name: str) -> int:
    places = [i for i, names in enumerate(order) if name in names]
    assert places, f"{name} has no place in the plan of the house"
    return places[0]


def refuse_upward(order: tuple[set[str], ...], depth: int, name: str) -> None:
    """Every import of another room on one depth of the names has to lead down."""
    own = name.split(".")[depth]
    for other, line in imports(name).items():
        parts = other.split(".")
        if len(parts) <= depth or parts[:depth] != name.split(".")[:depth] or parts[depth] == own:
            continue
        up = level(order, parts[depth]) <= level(order, own)
        assert not up, f"{name}:{line}: {own} may not import {other}"


@pytest.mark.parametrize("name", [n for n in modules() if n.count(".") > 0])
def test_imports_run_downwards(name: str) -> None:
    if name.split(".")[1] != "__main__":
        refuse_upward(FLOORS, 1, name)
        if name.startswith("ggslam.jobs."):
            refuse_upward(JOBS, 2, name)


@pytest.mark.parametrize("name", [n for n in modules() if n.count(".") > 0])
def test_the_public_face_is_for_others(name: str) -> None:
    """It leads to every floor, so within the package only the version is taken from it; nor is a room imported by a
    text, which no check of directions sees."""
    for node in ast.walk(ast.parse(modules()[name].read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "ggslam":
            taken = {alias.name for alias in node.names} - {"__version__", "errors"}
            assert not taken or all(f"ggslam.{n}" in modules() for n in taken), f"{name}:{node.lineno}: {taken}"
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            assert not [t for t in texts if t.startswith("ggslam")], f"{name}:{node.lineno}: {texts}"


def test_no_circles() -> None:
    """Not between modules of one room either, and not by imports inside functions."""
    state: dict[str, int] = {}

    def visit(name: str, path: list[str]) -> None:
        if state.get(name) == 2:
            return
        assert state.get(name) != 1, "circle: " + " -> ".join([*path[path.index(name) :], name])
        state[name] = 1
        for other in imports(name):
            if other in modules() and other != "ggslam":  # the public face loads what it is asked for
                visit(other, [*path, name])
        state[name] = 2

    for name in modules():
        if name != "ggslam":
            visit(name, [])


def test_nothing_stands_at_the_root() -> None:
    assert {path.stem for path in ROOT.glob("*.py")} == ROOT_MODULES
    rooms = {path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()}
    assert rooms == set().union(*FLOORS) - {"errors"}


def test_heavy_packages_are_not_imported_at_start() -> None:
    """`ggslam --help` must not wait for torch: neither the command line nor what it loads at once may import it."""
    seen, pending = set(), ["ggslam.cli.main"]
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        tree = ast.parse(modules()[name].read_text())
        heavy = {a.name.split(".")[0] for n in top_level(tree) if isinstance(n, ast.Import) for a in n.names}
        heavy |= {(n.module or "").split(".")[0] for n in top_level(tree) if isinstance(n, ast.ImportFrom)}
        assert not heavy & {"torch", "cv2", "kornia"}, f"{name} imports {heavy}"
        pending += [n for n in imports(name, at_loading_only=True) if n in modules() and n != "ggslam"]


def test_the_check_finds_what_it_looks_for(tmp_path: Path) -> None:
    order = ({"above"}, {"below"})
    assert level(order, "above") < level(order, "below")
    with pytest.raises(AssertionError, match="no place"):
        level(order, "elsewhere")
