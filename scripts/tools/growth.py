# SPDX-License-Identifier: Apache-2.0
"""What a newcomer meets, counted: files that one more format, filter, tracker or command touches, constants, words, and
subjects of commits. A part of house.py."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path

import test_imports as plan

HERE = Path(__file__).parents[2]
EXAMPLES = {
    "format": "ggslam.formats.splat_file", "filter": "ggslam.slam.filters.shutter_times",
    "tracker": "ggslam.tracking.edges_planes.tracker", "command": "ggslam.cli.doctor_command",
    "dataset": "ggslam.sequences.formats.tum",
}  # fmt: skip
"""A module of each kind: what one more of them touches is its file and those that import it."""


def files_touched() -> dict[str, list[str]]:
    """For each kind, the modules that one more of it touches: its own, and those that know it."""
    found = {}
    for kind, example in EXAMPLES.items():
        if example in plan.modules():
            found[kind] = [example, *sorted(name for name in plan.modules() if example in plan.imports(name))]
    return found


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    return isinstance(node, ast.Tuple) and bool(node.elts) and all(map(_is_number, node.elts))


def constants() -> Iterator[str]:
    """Numbers that modules name at their top, outside settings and tuning classes."""
    for name, path in plan.modules().items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Assign) and _is_number(node.value):
                for target in node.targets:
                    names = target.elts if isinstance(target, ast.Tuple) else [target]
                    yield from (f"{name}: {ast.unparse(one)}" for one in names)


def words_of_docs() -> int:
    """Words of the pages in the navigation."""
    return sum(len(page.read_text().split()) for page in sorted((HERE / "docs").glob("*.md")))


def longest_subject() -> str:
    """The longest subject of a commit; "" where there is no history."""
    log = subprocess.run(["git", "log", "--format=%s"], cwd=HERE, capture_output=True, text=True)
    return max(log.stdout.splitlines(), key=len, default="")
