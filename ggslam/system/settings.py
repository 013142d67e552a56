# SPDX-License-Identifier: Apache-2.0
"""Declares settings with their range, unit, level and text, and checks every value.

    @tuning_class(frozen=True)
    class PhotometricTuning:
        \"\"\"Numbers of the photometric alignment.\"\"\"

        surface_sigma: float = setting(0.002, 1e-5, 1, "m")
        \"\"\"Least noise of the geometry at 1 m.\"\"\"

    @settings_class(frozen=True)
    class PhotometricSettings(PhotometricTuning):
        \"\"\"The photometric part of the alignment.\"\"\"

        mode: Literal["never", "auto"] = "auto"
        \"\"\"When grey values are used.\"\"\"

Fields of a settings class are public: what a user turns, documented and kept. Fields of a tuning class are internal:
help and docs do not list them and a later version may drop them. Both are given and checked in the same way.

Such a class is a frozen dataclass that pydantic checks: the constructor, `dataclasses.replace` and the file of settings
refuse the same values with the same sentence. The string below a field is its text. Checks of several fields together
stay in `__post_init__` and raise `Conflict`.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import functools
import inspect
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from ggslam.errors import ConfigError

if TYPE_CHECKING:
    import pydantic_core  # loaded with the first settings that are made

T = TypeVar("T")

_UNKNOWN = "unknown setting"
_DECLARATION = "ggslam"
"""Key of the declaration in a field's metadata."""
_INTERNAL = "__internal_fields__"
"""Attribute of a tuning class: names of its fields."""


@dataclass(frozen=True)
class Declaration:
    """Range, unit, level and other properties of a field, beside its type and text.

    Attributes:
        low, high: closed range of a number; None: no number, or one without a range.
        unit: of the number: "m", "deg", "s"...; empty: a share, a count or a factor.
        basic: whether it is shown first; the others are for experts.
    """

    low: float | None = None
    high: float | None = None
    unit: str = ""
    basic: bool = False


def setting(
    default: T, low: float | None = None, high: float | None = None, unit: str = "", *, basic: bool = False
) -> T:
    """Declares a field of a settings class: its default, closed range and unit (see `Declaration`)."""
    bounds = {name: bound for name, bound in (("ge", low), ("le", high)) if bound is not None}
    declared: Any = dataclasses.field(
        default=default, metadata={**bounds, _DECLARATION: Declaration(low, high, unit, basic)}
    )
    return declared  # type: ignore[no-any-return]  # as `dataclasses.field` does: the type of the default


class Conflict(ValueError):
    """Raised in `__post_init__` of a settings class if a field contradicts others."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(reason)
        self.name = name


if TYPE_CHECKING:
    from dataclasses import dataclass as settings_class
    from dataclasses import dataclass as tuning_class
else:

    def settings_class(*, frozen: Literal[True]) -> Callable[[type[T]], type[T]]:
        """Makes a class a frozen dataclass whose values are checked against their declarations.

        Wrong values raise ConfigError, which names class and field (the dotted path alone, if the class has a true
        `is_root`). Dictionaries become the settings classes that they stand for; what they do not name keeps the
        default that it has in this class.
        """

        def declare(kind: type[T]) -> type[T]:
            checked = dataclass(frozen=frozen)(kind)
            checked.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}

            make = checked.__init__

            @functools.wraps(make)
            def initialise(self: Any, *arguments: Any, **values: Any) -> None:
                if not arguments and not values:  # defaults are good, see tests/slam/test_settings.py
                    return make(self)
                import pydantic_core

                validator, values = _validator(checked), _on_defaults(checked, values)
                try:
                    validator.validate_python(pydantic_core.ArgsKwargs(arguments, values), self_instance=self)
                except pydantic_core.ValidationError as error:
                    said = explain(error, checked)
                    if not getattr(checked, "is_root", False):
                        said = checked.__name__ + (": " if said.startswith(_UNKNOWN) else ".") + said
                    raise ConfigError(said) from None

            checked.__init__ = initialise
            return checked

        return declare

    def tuning_class(*, frozen: Literal[True]) -> Callable[[type[T]], type[T]]:
        """Makes a settings class whose own fields are internal; a settings class may inherit from it."""

        def declare(kind: type[T]) -> type[T]:
            made = settings_class(frozen=frozen)(kind)
            setattr(made, _INTERNAL, frozenset(inspect.get_annotations(kind)) | internal_fields(made))
            return made

        return declare


def internal_fields(kind: type) -> frozenset[str]:
    """Names of the fields of a class that come from tuning classes."""
    return frozenset().union(*(vars(base).get(_INTERNAL, ()) for base in kind.__mro__))


def _on_defaults(kind: type, values: dict[str, Any]) -> dict[str, Any]:
    """Values in which each group that is given as a dictionary is completed by its defaults in `kind`, which may differ
    from those of the group's class."""
    factories = {field.name: field.default_factory for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    complete = dict(values)
    for name, given in values.items():
        factory = factories.get(name, dataclasses.MISSING)
        usual = None if factory is dataclasses.MISSING else factory()
        if isinstance(given, dict) and dataclasses.is_dataclass(usual):
            complete[name] = _on_group(usual, given)
    return complete


def _on_group(usual: Any, given: dict[str, Any]) -> dict[str, Any]:
    complete = {field.name: getattr(usual, field.name) for field in dataclasses.fields(usual)}
    for name, value in given.items():
        group = complete.get(name)
        is_group = isinstance(value, dict) and dataclasses.is_dataclass(group)
        complete[name] = _on_group(group, value) if is_group else value
    return complete


@functools.cache
def _validator(kind: type) -> Any:
    """Pydantic's check of a settings class: compiled when its first object is made, not when it is imported."""
    import pydantic

    return pydantic.TypeAdapter(kind).validator


def explain(error: pydantic_core.ValidationError, kind: type) -> str:
    """The first of pydantic's findings as one line: the dotted path, what was expected, what was found."""
    first = error.errors(include_url=False)[0]
    path, found, problem = list(first["loc"]), first["input"], first.get("ctx", {}).get("error")
    if path and isinstance(path[0], int):  # an argument without a name
        names = [field.name for field in dataclasses.fields(kind)]
        path[0] = names[path[0]] if path[0] < len(names) else f"argument {path[0] + 1}"
    if isinstance(problem, Conflict):
        return f"{'.'.join(map(str, [*path, problem.name]))}: {problem}"
    name = ".".join(map(str, path))
    if first["type"] in ("unexpected_keyword_argument", "unexpected_positional_argument", "invalid_key"):
        return _unknown(path, kind)
    if first["type"] in ("dataclass_type", "dict_type"):
        return f"{name}: expected names with values, found {found!r}"
    expected = _values_at(path, kind) or first["msg"]
    if first["type"].startswith("int_"):
        expected = f"a whole number, {expected}"
    return f"{name}: expected {expected}, found {found!r}"


def _unknown(path: list[Any], kind: type) -> str:
    """That a setting does not exist, and which are near."""
    for name in path[:-1]:
        kind = group_of(typing.get_type_hints(kind)[name]) or kind
    prefix, name = "".join(f"{part}." for part in path[:-1]), str(path[-1])
    hidden = internal_fields(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.name not in hidden]  # type: ignore[arg-type]
    longer = sorted((k for k in known if len(name) > 3 and k.startswith(name)), key=len)
    near = longer or difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {prefix}{near[0]}?" if near else f"known: {', '.join(prefix + k for k in known)}"
    return f"{_UNKNOWN} {prefix}{name}" + f"; {hint}" * bool(known)


def _values_at(path: list[Any], kind: type) -> str:
    """What a setting may be, in words; empty where only its type can tell."""
    for known in walk(kind):
        if known.path.split(".") == path:
            return known.values()
    return ""


@dataclass(frozen=True)
class Known:
    """A setting as it is declared.

    Attributes:
        path: dotted.
        kind: its type.
        default: its default in the settings that were walked.
        text: what it does, one line.
        declaration: its range, unit and level.
        internal: whether it is tuning, which help and docs do not list.
    """

    path: str
    kind: Any
    default: Any
    text: str
    declaration: Declaration
    internal: bool = False

    @property
    def choices(self) -> tuple[Any, ...]:
        """Of a choice, its values without None."""
        parts = [self.kind, *typing.get_args(self.kind)]
        literals = [part for part in parts if typing.get_origin(part) is Literal]
        return tuple(value for part in literals for value in typing.get_args(part) if value is not None)

    @property
    def is_number(self) -> bool:
        """Whether it is one int or float, or None instead."""
        parts = () if typing.get_origin(self.kind) is tuple else typing.get_args(self.kind)
        return bool({int, float} & {self.kind, *parts})

    def range(self) -> str:
        """`1 to 16`, `0.001 to 10 m`; empty: no range."""
        d = self.declaration
        if d.low is None or d.high is None:
            return ""
        low, high = (str(bound) if isinstance(bound, int) else f"{bound:.12g}" for bound in (d.low, d.high))
        return f"{low} to {high} {d.unit}".rstrip()

    def values(self) -> str:
        """What it may be, in words; empty where only the type can tell."""
        if self.choices:
            *first, last = map(str, self.choices)
            return f"{', '.join(first)} or {last}" if first else last
        if self.kind is bool:
            return "true or false"
        return "text" if self.kind is str else self.range()


def group_of(kind: Any) -> type | None:
    """The settings class that a type is (`Class`, `Class | None`), if it is one."""
    parts = typing.get_args(kind) if type(None) in typing.get_args(kind) else (kind,)
    return next((part for part in parts if dataclasses.is_dataclass(part) and isinstance(part, type)), None)


def walk(kind: type, values: Any = None, prefix: str = "") -> Iterator[Known]:
    """All settings of a class and of the groups in it, internal ones among them, in their order.

    Args:
        kind: the class.
        values: whose values are the defaults; None: an object made without arguments.
        prefix: of the paths.
    """
    values = kind() if values is None else values
    types, texts, hidden = typing.get_type_hints(kind), texts_of(kind), internal_fields(kind)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        path, value, declared = prefix + field.name, getattr(values, field.name), types[field.name]
        group = group_of(declared)
        if not dataclasses.is_dataclass(value):
            declaration = field.metadata.get(_DECLARATION, Declaration())
            yield Known(path, declared, value, texts.get(field.name, ""), declaration, field.name in hidden)
        if group is not None:
            yield from walk(group, value, f"{path}.")


def walk_public(kind: type) -> list[Known]:
    """The settings that users turn, see `walk`."""
    return [one for one in walk(kind) if not one.internal]


def changed_tuning(settings: Any) -> list[str]:
    """Paths of the internal settings that differ from the defaults."""
    kind = type(settings)
    usual = {one.path: one.default for one in walk(kind)}
    return [one.path for one in walk(kind, settings) if one.internal and one.default != usual.get(one.path)]


def tuning_note(settings: Any) -> str:
    """What a user is told who has changed internal settings; empty: there are none."""
    if not (names := changed_tuning(settings)):
        return ""
    which, it = ("an internal setting", "it") if len(names) == 1 else ("internal settings", "them")
    return f"{which}, used as given, but a later version may drop {it}: {', '.join(names)}"


@functools.cache
def texts_of(kind: type) -> Mapping[str, str]:
    """What the string below each field of a class, or of one that it inherits from, says, by the field's name; one line
    each."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            texts |= _own_texts(base)
    return texts


@functools.cache
def _own_texts(kind: type) -> Mapping[str, str]:
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    texts: dict[str, str] = {}
    name = ""
    for node in body.body:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            if name:
                texts[name] = " ".join(node.value.value.split())
            name = ""
        else:
            name = node.target.id if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) else ""
    return texts
