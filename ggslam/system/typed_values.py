# SPDX-License-Identifier: Apache-2.0
"""Whether what a file put into an object is what its class declares there, or what its constructor put there."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import torch

from ggslam.system.array_forms import Between, Form, NotFinite
from ggslam.system.tuning import Tuning

_LARGEST: Final = 2**53
"""Largest whole number that floats hold exactly; all counters, frames and versions are below."""


class NumberLimits(Tuning):
    """A limit on numbers in files."""

    max_number = 1e30
    """Largest other number: float32 holds it, with room for sums."""


Lengths = dict[str, int]


class AnyFloat(float):
    """Stands for floats that may also be NaN or infinite."""



@cache
def declared_types(kind: type) -> dict[str, Any]:
    """Attributes of a class and their declared types, with the forms of arrays; class variables are left out. Those
    whose default is NaN or infinite may be it, no others."""
    hints = typing.get_type_hints(typing.cast(type, kind), include_extras=True)
    hints = {name: hint for name, hint in hints.items() if typing.get_origin(hint) is not typing.ClassVar}
    return {name: AnyFloat if _is_no_number(getattr(kind, name, None)) else hint for name, hint in hints.items()}


def _is_no_number(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


@dataclass(frozen=True)
class Example:
    """What stood in an attribute before: only of its kind may follow. Float may follow whole numbers' place, never the
    other way round."""

    kind: type
    dtype: Any = None
    shape: tuple[int, ...] = ()

    @staticmethod
    def of(value: Any) -> Example | None:
        """None: nothing is known of it."""
        if value is None:
            return None
        if isinstance(value, np.ndarray | torch.Tensor):
            return Example(type(value), value.dtype, tuple(value.shape))
        if _is_no_number(value):
            return Example(AnyFloat)
        return Example(type(value))

    def problem(self, value: Any) -> str | None:
        """What is wrong with a value; None: nothing."""
        if self.kind in _NUMBERS:
            return problem(value, self.kind, {})
        if type(value) is not self.kind:
            return f"expected {self.kind.__name__}, found {type(value).__name__}"
        if not isinstance(value, np.ndarray | torch.Tensor):
            return None
        if value.dtype == self.dtype and value.ndim == len(self.shape) and tuple(value.shape[1:]) == self.shape[1:]:
            return None
        return f"expected {self.dtype} {list(self.shape)}, found {value.dtype} {list(value.shape)}"


def problem(value: Any, hint: Any, lengths: Lengths) -> str | None:
    """What is wrong with a value of a declared type; None: nothing, or the type says too little.

    Args:
        value: to look at.
        hint: its type, as annotations have it.
        lengths: of the axes of arrays of the same object, see `Form`.
    """
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        inner, *more = typing.get_args(hint)
        if any(isinstance(form, NotFinite) for form in more):
            inner = AnyFloat
        wrong = [problem(value, inner, lengths)]
        if wrong == [None]:  # or its form cannot be looked at
            wrong = [form.check(value, lengths) for form in more if isinstance(form, Form | Between)]
        return next(filter(None, wrong), None)
    if origin in (typing.Union, types.UnionType):
        return _of_union(value, typing.get_args(hint), lengths)
    if origin is typing.Literal:
        options = typing.get_args(hint)
        return None if value in options else f"expected one of {options}, found {value!r:.60}"
    if hint in _NUMBERS:
        return _NUMBERS[hint](value)
    if origin in _CONTAINERS:
        return _CONTAINERS[origin](value, typing.get_args(hint), lengths)
    if hint is None or hint is types.NoneType:
        return None if value is None else f"expected nothing, found {type(value).__name__}"
    kind = origin or hint
    if not isinstance(kind, type):
        return None  # a type variable or something to be called
    return None if isinstance(value, kind) else f"expected {kind.__name__}, found {type(value).__name__}"


def _of_union(value: Any, options: tuple[Any, ...], lengths: Lengths) -> str | None:
    if value is None and types.NoneType in options:
        return None
    found = [problem(value, option, lengths) for option in options if option is not types.NoneType]
    return None if None in found else found[0]


def _whole(value: Any) -> str | None:
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        return f"expected a whole number, found {type(value).__name__}"
    return None if abs(int(value)) <= _LARGEST else f"expected a whole number within +-2^53, found {value:.3g}"


def _number(value: Any) -> str | None:
    if isinstance(value, float | np.floating):
        most = NumberLimits.max_number
        return None if abs(value) <= most else f"expected a number within +-{most:g}, found {value}"
    return _whole(value)


def _number_or_not(value: Any) -> str | None:
    return None if isinstance(value, float | np.floating) else _whole(value)


def _truth(value: Any) -> str | None:
    return None if isinstance(value, bool | np.bool_) else f"expected true or false, found {type(value).__name__}"


def _of_all(kind: type[Collection[Any]]) -> Callable[[Any, tuple[Any, ...], Lengths], str | None]:
    """Of a container whose items have one type."""

    def check(value: Any, inner: tuple[Any, ...], lengths: Lengths) -> str | None:
        if not isinstance(value, kind):
            return f"expected {kind.__name__}, found {type(value).__name__}"
        return next((found for item in value if (found := problem(item, inner[0], {}))), None)

    return check


def _of_dictionary(value: Any, inner: tuple[Any, ...], lengths: Lengths) -> str | None:
    if not isinstance(value, dict):
        return f"expected dict, found {type(value).__name__}"
    found = (problem(key, inner[0], {}) or problem(item, inner[1], {}) for key, item in value.items())
    return next(filter(None, found), None)


def _of_tuple(value: Any, inner: tuple[Any, ...], lengths: Lengths) -> str | None:
    if not isinstance(value, tuple):
        return f"expected tuple, found {type(value).__name__}"
    if len(inner) == 2 and inner[1] is Ellipsis:
        inner = (inner[0],) * len(value)
    if len(inner) != len(value):
        return f"expected {len(inner)} values, found {len(value)}"
    own: Lengths = {}
    return next((found for item, hint in zip(value, inner, strict=True) if (found := problem(item, hint, own))), None)


_NUMBERS: dict[Any, Callable[[Any], str | None]] = {
    int: _whole, float: _number, bool: _truth, AnyFloat: _number_or_not,
}  # fmt: skip
_CONTAINERS: dict[Any, Callable[[Any, tuple[Any, ...], Lengths], str | None]] = {
    list: _of_all(list), set: _of_all(set), frozenset: _of_all(frozenset), dict: _of_dictionary, tuple: _of_tuple,
}  # fmt: skip
