# SPDX-License-Identifier: Apache-2.0
"""Classes that declare what of them is saved, and those that do not."""

from __future__ import annotations

import ast
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from ggslam.errors import FormatError
from ggslam.system.object_tree import describe, restore
from ggslam.system.savable import Rule, savable, savable_classes

PACKAGE = Path(__file__).parents[2] / "ggslam"


@dataclass
class Undeclared:
    inner: int = 1


@dataclass
class Held:
    handle: object = None
    numbers: list[int] = field(default_factory=list)
    other: tuple[int, None] | list[Undeclared] | None = None
    doubled: int = 0

    def check(self) -> None:
        if len(self.numbers) > 3:
            raise ValueError("more than three numbers")

    def count_again(self) -> None:
        self.doubled = 2 * len(self.numbers)


def rules() -> dict[type, Rule]:
    """As the decorator would register it, without leaving a class of the tests among the package's."""
    before = dict(savable_classes)
    try:
        assert savable(not_saved="handle doubled", growing="numbers", after="count_again", check="check")(Held) is Held
        return {Held: savable_classes[Held]}
    finally:
        if Held not in before:
            sys.modules["ggslam.system.savable"]._RULES.pop(Held)  # type: ignore[attr-defined]


def test_an_object_comes_back_as_its_class_declares() -> None:
    tree, arrays = describe(Held(object(), [1, 2], (3, None), 17), rules(), None)
    handle = object()
    there = Held(handle)
    assert restore(tree, rules(), arrays, None, into=there) is there
    assert there == Held(handle, [1, 2], (3, None), 4)


def test_a_class_is_made_from_the_name_that_it_had() -> None:
    tree, arrays = describe(Held(None, [1, 2]), rules(), None)
    known = {Held: replace(rules()[Held], formerly="ggslam.before.Held")}
    assert tree["o"][0] == describe(Held(), known, None)[0]["o"][0]
    tree["o"][0] = "ggslam.before.Held"
    assert restore(tree, known, arrays, None, into=Held()).numbers == [1, 2]
    with pytest.raises(FormatError):
        restore(tree, rules(), arrays, None, into=Held())


def test_a_check_that_fails_refuses_the_state() -> None:
    tree, arrays = describe(Held(None, [1, 2, 3, 4]), rules(), None)
    with pytest.raises(FormatError, match="more than three numbers"):
        restore(tree, rules(), arrays, None, into=Held())


def test_a_class_that_declares_nothing_is_named_with_its_place() -> None:
    with pytest.raises(TypeError) as caught:
        describe(Held(other=[Undeclared()]), rules(), None)
    assert "state.other" in str(caught.value) and f"{__name__}.Undeclared" in str(caught.value)


@pytest.mark.parametrize("name", ["Undeclared", "Sub"])
def test_a_class_that_declares_nothing_is_never_made(name: str) -> None:
    class Sub(Held):
        """Subclasses declare themselves, too."""

    with pytest.raises(FormatError):
        restore({"o": [f"{__name__}.{name}", {}]}, rules(), [], None)
    assert Sub not in rules() and Undeclared not in savable_classes


def test_a_method_that_is_missing_is_found_when_the_class_is_declared() -> None:
    with pytest.raises(AttributeError):
        savable(after="nowhere")(Undeclared)
    assert Undeclared not in savable_classes


def test_every_class_that_declares_itself_is_known_to_a_fresh_program() -> None:
    """One that is imported on its first use only would be unknown to a program that resumes."""
    declared = {
        ".".join([*path.relative_to(PACKAGE.parent).with_suffix("").parts, node.name])
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
        for decorator in node.decorator_list
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "savable"
    }
    program = (
        "import ggslam.slam.rig_slam, ggslam.slam.saved_state\n"
        "from ggslam.slam.filter_chain import filter_classes\n"
        "filter_classes()  # which every run calls before a state is restored\n"
        "from ggslam.system.savable import savable_classes as known\n"
        "print(*(f'{kind.__module__}.{kind.__qualname__}' for kind in known))"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert set(said.split()) == declared and len(declared) > 50
