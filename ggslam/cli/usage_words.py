# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a command line, in one sentence of ours: typer's frames and its libraries' words are not shown."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Any, Final, get_args

import typer

from ggslam.errors import ConfigError
from ggslam.system.tuning import Tuning

UsageError: Final[Any] = typer.BadParameter.__mro__[1]
"""Typer's class of all such errors: its own copy of click's in new versions, click's in older ones."""


class UsageTuning(Tuning):
    """When an option or a command is proposed."""

    closeness = 0.6
    """Likeness, 0 to 1, of a name that is proposed in place of an unknown one."""
    shown_length = 80
    """Characters that are shown of what was typed."""


def in_own_words(error: Any, words: Sequence[str] = ()) -> Exception:
    """The error to raise in place of one of typer's.

    Args:
        error: typer's; the one that only shows a command's help is given back.
        words: of the command line, for what was typed.
    """
    context = error.ctx
    if type(error).__name__ == "NoArgsIsHelpError":  # it shows the help
        return error
    name = "ggslam" if context is None or context.parent is None else f"ggslam {context.info_name}"
    return ConfigError(f"{_sentence(error, context, list(words))}; see `{name} --help`")


def _sentence(error: Any, context: Any, words: list[str]) -> str:
    kind, parameter = type(error).__name__, getattr(error, "param", None)
    if kind == "NoSuchOption":
        typed = str(error.option_name)
        return f"there is no option {typed[:UsageTuning.shown_length]}{_near(typed, _options(context))}"
    if kind == "MissingParameter" and parameter is not None:
        return f"{_name(parameter)} is missing"
    if kind == "BadOptionUsage":
        return f"{getattr(error, 'option_name', 'an option')} needs a value"
    if kind == "BadParameter" and parameter is not None:
        value = _value_of(parameter, words)
        found = "" if value is None else f", found {value[:UsageTuning.shown_length]!r}"
        wanted = _expectation(parameter)
        return f"{_name(parameter)}: {error.message}" if wanted is None else f"{_name(parameter)}: {wanted}{found}"
    if kind == "NoSuchCommand" or str(error).startswith("No such command"):
        typed = words[0] if words else ""
        commands = [] if context is None else context.command.list_commands(context)
        return f"there is no command {typed[:UsageTuning.shown_length]!r}{_near(typed, commands)}"
    if "extra argument" in str(error):
        extra = str(error).rpartition("(")[2].rstrip(")")
        return f"more arguments than the command takes: {extra[:UsageTuning.shown_length]}"
    return str(error.message).rstrip(".")


def _options(context: Any) -> list[str]:
    return [] if context is None else [name for p in context.command.params for name in p.opts if name[:2] == "--"]


def _near(typed: str, known: Iterable[str]) -> str:
    """A known name that is nearly what was typed: by likeness, or the only one that it begins."""
    names = list(known)
    began = [name for name in names if len(typed) > 3 and name.startswith(typed)]
    found = began[:1] or difflib.get_close_matches(typed, names, 1, UsageTuning.closeness)
    return f"; did you mean {found[0]}?" if found else ""


def _name(parameter: Any) -> str:
    if parameter.param_type_name == "option":
        return str(max(parameter.opts, key=len))
    return str(parameter.metavar or parameter.name).upper()


def _value_of(parameter: Any, words: list[str]) -> str | None:
    """The value that was given for an option."""
    for place, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name in parameter.opts:
            count = max(1, getattr(parameter, "nargs", 1))
            return value if equals else " ".join(words[place + 1 : place + 1 + count]) or None
    return None


def _expectation(parameter: Any) -> str | None:
    """What values of a parameter are; None: of any text.

    New versions of typer keep Python's type of it, older ones click's."""
    own = getattr(parameter, "type", None)
    kinds = _kinds(parameter.type_descriptor.annotation) if own is None else ()
    source = parameter if own is None else own
    choices = [member.value for kind in kinds if issubclass(kind, Enum) for member in kind]
    choices += getattr(own, "choices", None) or []
    if choices:
        return f"expected one of {', '.join(str(getattr(choice, 'value', choice)) for choice in choices)}"
    name = str(getattr(own, "name", ""))
    whole, number = int in kinds or "int" in name, float in kinds or "float" in name
    if not whole and not number:
        return None
    low, high = getattr(source, "min", None), getattr(source, "max", None)
    count, kind = max(1, getattr(parameter, "nargs", 1)), "whole number" if whole else "number"
    wanted = f"expected a {kind}" if count == 1 else f"expected {count} {kind}s"
    if low is not None and high is not None:
        return f"{wanted}, {low:g} to {high:g}"
    if low is not None:
        return f"{wanted}, {low:g} or more"
    return wanted + ("" if high is None else f", at most {high:g}")


def _kinds(annotation: Any) -> tuple[type, ...]:
    """The classes in an annotation, as of `list[int] | None`."""
    parts = get_args(annotation)
    if parts:
        return tuple(kind for part in parts for kind in _kinds(part))
    return (annotation,) if isinstance(annotation, type) else ()
