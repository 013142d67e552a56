# SPDX-License-Identifier: Apache-2.0
"""Each class declares what of its objects is saved; objects of other classes are never made from a file.

    @savable(not_saved="settings _helper", growing="events", check="check")
    class LoopCloser:

Attributes that the declaration does not name are saved, so a new attribute needs no thought unless it holds something
that a constructor has to make (threads, native handles, other parts).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


@dataclass(frozen=True)
class Rule:
    """How objects of a class are saved.

    Attributes:
        not_saved: attributes that the constructor, or `after`, makes.
        fixed: attributes that hold arrays (or lists of arrays) which never change once they are there.
        growing: attributes that hold lists which only grow, of values that never change.
        save: gives what is saved by name, instead of the attributes.
        take: gets that for an object to be filled, instead of its attributes being set.
        after: called for every object when all of them are there.
        checked: made by calling the class with its fields, which checks them; for settings.
        formerly: name, with its module, that states of earlier versions have for the class.
        check: raises ValueError if the attributes of an object do not fit together; called when all objects are there
            and their attributes are of the declared types, before `after`.
    """

    not_saved: frozenset[str] = frozenset()
    fixed: frozenset[str] = frozenset()
    growing: frozenset[str] = frozenset()
    save: Callable[[Any], dict[str, Any]] | None = None
    take: Callable[[Any, dict[str, Any]], None] | None = None
    after: Callable[[Any], None] | None = None
    checked: bool = False
    check: Callable[[Any], None] | None = None
    formerly: str = ""


Rules = Mapping[type, Rule]

_RULES: dict[type, Rule] = {}
savable_classes: Rules = MappingProxyType(_RULES)
"""The rule of every class that declared itself, by class; subclasses do not inherit it."""


def savable(
    *, not_saved: str = "", fixed: str = "", growing: str = "", save: str = "", take: str = "", after: str = "",
    check: str = "", checked: bool = False, formerly: str = "",
) -> Callable[[Class], Class]:  # fmt: skip
    """A decorator that registers the `Rule` of a class; it stands above `@dataclass`.

    Args:
        not_saved, fixed, growing: names of attributes with spaces between them, as `Rule` explains them.
        save, take, after, check: names of methods of the class.
        checked, formerly: see `Rule`.
    """

    def declare(kind: Class) -> Class:
        attributes = {"not_saved": not_saved, "fixed": fixed, "growing": growing}
        methods = {"save": save, "take": take, "after": after, "check": check}
        said: dict[str, Any] = {key: frozenset(names.split()) for key, names in attributes.items()}
        said |= {key: getattr(kind, name) for key, name in methods.items() if name}
        _RULES[kind] = Rule(**said, checked=checked, formerly=formerly)
        return kind

    return declare
