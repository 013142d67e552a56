# SPDX-License-Identifier: Apache-2.0
"""Tuning: numbers that cannot be changed by accident, and each has its sentence."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from ggslam.system.tuning import Tuning, overridden

PACKAGE = Path(__file__).parents[2] / "ggslam"


class ExampleTuning(Tuning):
    """An example."""

    near_m = 0.5
    """Distance up to which something is near, in metres."""


def test_a_number_is_fixed():
    with pytest.raises(AttributeError, match="near_m"):
        ExampleTuning.near_m = 1.0
    with pytest.raises(AttributeError, match="near_m"):
        del ExampleTuning.near_m
    assert ExampleTuning.near_m == 0.5


def test_a_block_overrides_and_restores():
    with pytest.raises(RuntimeError, match="inside"), overridden(ExampleTuning, near_m=2.0):
        assert ExampleTuning.near_m == 2.0
        raise RuntimeError("inside")
    assert ExampleTuning.near_m == 0.5


def test_a_field_that_does_not_exist_is_not_made():
    with pytest.raises(AttributeError, match="far_m"), overridden(ExampleTuning, far_m=2.0):
        pass
    assert not hasattr(ExampleTuning, "far_m")


def tuning_classes() -> Iterator[tuple[str, ast.ClassDef]]:
    """Every tuning class of the package, with the file it stands in."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "Tuning" for base in node.bases):
                yield f"{path.relative_to(PACKAGE)}: {node.name}", node


def test_every_number_has_its_sentence():
    for place, kind in tuning_classes():
        assert ast.get_docstring(kind), place
        for field, text in zip(kind.body[1:], [*kind.body[2:], None], strict=True):
            if isinstance(field, (ast.Assign, ast.AnnAssign)):
                name = ast.unparse(field.targets[0] if isinstance(field, ast.Assign) else field.target)
                says = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and text.value.value
                assert says and str(says).strip().endswith((".", ")", ":")), f"{place}.{name} has no sentence"
