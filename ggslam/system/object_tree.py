# SPDX-License-Identifier: Apache-2.0
"""Objects as trees of plain values and arrays, and back: data, never code.

    tree = describe(slam, rules, keeper)           # {"o": ["Slam", {...}]}, ready for JSON; arrays beside it
    restore(tree, rules, arrays, kept, into=slam)  # fills objects that exist and makes those that do not

Only classes that have a rule (`savable`) are made, without calling them; their attributes get what was saved. Whatever
else an object holds (threads, native handles, settings of its own) stays as its constructor made it. Objects, lists and
arrays that two places share are shared again. Floats keep every bit, arrays their type and order in memory.

Tree: None, true, false, whole numbers, floats, text and lists stand for themselves; everything else is an object with
one letter: see `_Describer` and `_Restorer`, which mirror each other.
"""

from __future__ import annotations

import enum
from array import array as FlatArray
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.system.savable import Rule, Rules
from ggslam.system.typed_values import Example, declared_types, problem


class Keeper(Protocol):
    """Writes arrays that never change to another place, once."""

    def place(self, array: np.ndarray) -> list[int]:
        """Where an array is kept: numbers of file and array."""

    def find(self, array: np.ndarray) -> list[int] | None:
        """The same, None if it is not kept."""

    def parts(self, items: list[Any], describe: Callable[[Any, Callable[[np.ndarray], int]], Any]) -> list[list[int]]:
        """Where the parts of a list that grows are kept, numbers of file and part; `describe` makes an item's tree and
        is told how to place an array in the same file."""


class Kept(Protocol):
    """Reads what a `Keeper` wrote."""

    def array(self, file: int, number: int) -> np.ndarray:
        """An array; each time the same one."""

    def part(self, file: int, number: int) -> tuple[Any, Sequence[np.ndarray]]:
        """The trees of a part's items, and the arrays that they name."""

    def grew(self, items: list[Any], parts: list[list[int]]) -> None:
        """The items of these parts are this list now."""


def class_names(rules: Rules) -> dict[str, type]:
    """Classes by the names that trees have for them; the names of earlier versions come first."""
    formerly = {rule.formerly: kind for kind, rule in rules.items() if rule.formerly}
    return formerly | {f"{kind.__module__}.{kind.__qualname__}": kind for kind in rules}


def describe(value: Any, rules: Rules, keeper: Keeper | None) -> tuple[Any, list[np.ndarray]]:
    """The tree of a value, and the arrays that it names.

    Raises:
        TypeError: there is no rule for something in it; the message says where it is.
    """
    describer = _Describer(rules, keeper)
    return describer.describe(value, "state"), describer.arrays


def restore(tree: Any, rules: Rules, arrays: Sequence[np.ndarray], kept: Kept | None, into: Any = None) -> Any:
    """What `describe` was given; if `into` is of its class, that object is filled.

    Raises:
        FormatError: the tree does not fit the rules, or an attribute is not of its declared type (of attributes that
            are not declared: of the type that the object to be filled has there).
    """
    restorer = _Restorer(rules, arrays, kept)
    try:
        value = restorer.restore(tree, into)
        if into is not None and value is not into:
            raise ValueError(f"expected {type(into).__name__}, found {type(value).__name__}")
        restorer.check()
        for call in restorer.pending:
            call()
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, RuntimeError) as error:
        reason = error if type(error) is ValueError else repr(error)
        raise FormatError(f"not a state of this program: {reason}") from error
    return value


class _Describer:
    def __init__(self, rules: Rules, keeper: Keeper | None) -> None:
        self.arrays: list[np.ndarray] = []
        self._rules, self._keeper = rules, keeper
        self._names = {kind: name for name, kind in class_names(rules).items()}
        self._seen: dict[int, int] = {}
        self._held: list[Any] = []
        """Keeps what was made on the way alive: numbers of `_seen` are addresses."""

    def describe(self, value: Any, where: str, fixed: bool = False) -> Any:
        if value is None or value is True or value is False:
            return value
        kind = type(value)
        if kind in (int, float, str):
            return value
        if kind is tuple:
            return {"t": [self.describe(item, where) for item in value]}
        if isinstance(value, np.generic):
            return {"n": [value.dtype.str, value.item()]}
        if isinstance(value, enum.Enum):
            return {"e": [self._name(kind, where), value.name]}
        number = self._seen.get(id(value))
        if number is not None:
            return {"r": number}
        self._seen[id(value)] = len(self._seen)
        if kind is list:
            return [self.describe(item, where, fixed) for item in value]
        if kind is dict:
            return {"d": [[self.describe(k, where), self.describe(v, where, fixed)] for k, v in value.items()]}
        if kind in (set, frozenset):
            return {"s" if kind is set else "z": [self.describe(item, where) for item in sorted(value)]}
        if kind is np.ndarray:
            return {"a": self._array(value, fixed)}
        if isinstance(value, torch.Tensor):
            return {"T": self._array(value.detach().cpu().numpy(), False)}
        if kind is FlatArray:
            return {"y": [value.typecode, self._array(np.array(value), False)]}
        if kind is np.random.Generator:
            return {"g": _plain(value.bit_generator.state)}
        return self._object(value, where)

    def _object(self, value: Any, where: str) -> Any:
        kind = type(value)
        name, rule = self._name(kind, where), self._rules[kind]
        attributes, found = {}, vars(value) if rule.save is None else rule.save(value)
        self._held.append(found)
        for attribute, content in found.items():
            if attribute in rule.not_saved:
                continue
            place = f"{where}.{attribute}"
            if attribute in rule.growing and self._keeper is not None:
                attributes[attribute] = self._list_in_parts(content, place)
            else:
                attributes[attribute] = self.describe(content, place, attribute in rule.fixed)
        return {"o": [name, attributes]}

    def _name(self, kind: type, where: str) -> str:
        if kind not in self._names:
            name = f"{kind.__module__}.{kind.__qualname__}"
            raise TypeError(f"{where}: {name} does not declare what of it is saved (@savable)")
        return self._names[kind]

    def _list_in_parts(self, items: list[Any], where: str) -> Any:
        assert self._keeper is not None
        self._seen[id(items)] = len(self._seen)

        def part(item: Any, place: Callable[[np.ndarray], int]) -> Any:
            inner = _Describer(self._rules, None)
            inner._array = lambda array, fixed: _place_of(place(array), array)  # type: ignore[method-assign]
            return inner.describe(item, where)

        return {"l": self._keeper.parts(items, part)}

    def _array(self, array: np.ndarray, fixed: bool) -> Any:
        place = None
        if self._keeper is not None:
            place = self._keeper.place(array) if fixed else self._keeper.find(array)
        if place is not None:
            return _place_of(place, array)
        self.arrays.append(array)
        return _place_of(len(self.arrays) - 1, array)


def _place_of(place: Any, array: np.ndarray) -> Any:
    """Place of an array, and of one that is not in C order its strides: the last bits of products go with them."""
    return place if array.flags.c_contiguous else {"p": place, "strides": list(array.strides)}


def _plain(state: Any) -> Any:
    """State of a bit generator in what JSON can say."""
    if isinstance(state, dict):
        return {name: _plain(value) for name, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


class _Restorer:
    def __init__(self, rules: Rules, arrays: Sequence[np.ndarray], kept: Kept | None) -> None:
        self.pending: list[Callable[[], None]] = []
        self._rules, self._arrays, self._kept = rules, arrays, kept
        self._classes = class_names(rules)
        self._known: list[Any] = []
        self._filled: list[tuple[Any, dict[str, Example | None]]] = []
        """Objects, and what stood in their attributes before."""

    def check(self) -> None:
        """Raises ValueError if an object's attributes are not what its class declares, or do not fit together."""
        for value, before in self._filled:
            _check_attributes(value, before, self._rules[type(value)])
        for value, _ in self._filled:
            check = self._rules[type(value)].check
            if check is not None:
                check(value)

    def restore(self, tree: Any, there: Any) -> Any:
        if isinstance(tree, list):
            return self._list(tree, there)
        if not isinstance(tree, dict):
            return tree
        ((letter, content),) = tree.items()
        if letter == "r":
            return self._known[content]
        if letter == "t":
            return tuple(self.restore(item, None) for item in content)
        if letter == "n":
            return np.dtype(content[0]).type(content[1])
        if letter == "e":
            return self._classes[content[0]][content[1]]  # type: ignore[index]
        return self._object_or_array(letter, content, there)

    def _object_or_array(self, letter: str, content: Any, there: Any) -> Any:
        """What may be in more than one place."""
        if letter == "o":
            return self._object(content, there)
        if letter == "d":
            return self._dictionary(content, there)
        number = len(self._known)
        self._known.append(None)
        if letter in ("s", "z"):
            items = [self.restore(item, None) for item in content]
            value: Any = frozenset(items) if letter == "z" else set(items)
            if letter == "s" and type(there) is set:
                there.clear()
                there.update(value)
                value = there
        elif letter == "a":
            value = self._array(content)
        elif letter == "T":
            value = torch.from_numpy(self._array(content))
            value = value.to(there.device) if isinstance(there, torch.Tensor) else value
        elif letter == "y":
            value = FlatArray(content[0], self._array(content[1]).tobytes())
        elif letter == "g":
            value = _generator(content, there)
        elif letter == "l":
            value = self._list_in_parts(content, there)
        else:
            raise ValueError(f"unknown kind of value: {letter}")
        self._known[number] = value
        return value

    def _list(self, tree: list[Any], there: Any) -> list[Any]:
        """A list that exists is filled, and so are its objects, as far as both go."""
        value: list[Any] = there if type(there) is list else []
        before = list(value)
        value.clear()
        self._known.append(value)
        for number, item in enumerate(tree):
            value.append(self.restore(item, before[number] if number < len(before) else None))
        return value

    def _dictionary(self, content: Any, there: Any) -> dict[Any, Any]:
        value: dict[Any, Any] = there if type(there) is dict else {}
        before = dict(value)
        value.clear()
        self._known.append(value)
        for key_tree, item in content:
            key = self.restore(key_tree, None)
            value[key] = self.restore(item, before.get(key))
        return value

    def _object(self, content: Any, there: Any) -> Any:
        name, attributes = content
        kind = self._classes[name]
        rule = self._rules[kind]
        if rule.checked:
            number = len(self._known)
            self._known.append(None)
            made = self._known[number] = kind(**{k: self.restore(v, None) for k, v in attributes.items()})
            self._filled.append((made, {}))
            return made
        fill = type(there) is kind
        value = there if fill else object.__new__(kind)
        self._known.append(value)
        if not fill and rule.not_saved - attributes.keys() - set(_class_defaults(kind)):
            raise ValueError(f"{name}: no object to fill")
        if fill and rule.save is None and (missing := sorted(vars(value).keys() - rule.not_saved - attributes.keys())):
            raise ValueError(f"{kind.__name__}: {missing[0]} is missing")
        self._filled.append((value, {name: Example.of(old) for name, old in vars(value).items()} if fill else {}))
        found = {}
        for attribute, tree in attributes.items():
            if attribute in rule.not_saved:
                raise ValueError(f"{name}.{attribute}: is not saved")
            found[attribute] = self.restore(tree, vars(value).get(attribute))
            if rule.take is None:
                object.__setattr__(value, attribute, found[attribute])
        if rule.take is not None:
            rule.take(value, found)
        if rule.after is not None:
            after = rule.after
            self.pending.append(lambda: after(value))
        return value

    def _list_in_parts(self, content: Any, there: Any) -> list[Any]:
        kept = self._kept_files()
        value: list[Any] = there if type(there) is list else []
        value.clear()
        for file, number in content:
            trees, arrays = kept.part(file, number)
            for tree in trees:
                restorer = _Restorer(self._rules, arrays, None)
                value.append(restorer.restore(tree, None))
                self._filled += restorer._filled
        kept.grew(value, content)
        return value

    def _kept_files(self) -> Kept:
        if self._kept is None:
            raise ValueError("a kept part names arrays of other files")
        return self._kept

    def _array(self, content: Any) -> np.ndarray:
        strides = None
        if isinstance(content, dict):
            content, strides = content["p"], content["strides"]
        if isinstance(content, list):
            array = self._kept_files().array(*content)
        else:
            array = self._arrays[content]
        return array if strides is None else _with_strides(array, strides)


def _check_attributes(value: Any, before: Mapping[str, Example | None], rule: Rule) -> None:
    """Raises ValueError if one is missing, unknown, or of another type than it must be."""
    kind: type = type(value)
    hints, name = declared_types(kind), kind.__name__
    there = vars(value).keys() - rule.not_saved
    if rule.take is None:
        expected = (before.keys() or hints.keys()) - rule.not_saved
        if missing := sorted(expected - there):
            raise ValueError(f"{name}: {missing[0]} is missing")
        if strange := sorted(there - hints.keys() - before.keys()):
            raise ValueError(f"{name}: has no {strange[0]}")
    lengths: dict[str, int] = {}
    for attribute in sorted(there):
        example = before.get(attribute)
        if attribute in hints:
            found = problem(getattr(value, attribute), hints[attribute], lengths)
        else:
            found = None if example is None else example.problem(getattr(value, attribute))
        if found:
            raise ValueError(f"{name}.{attribute}: {found}")


def _class_defaults(kind: type) -> dict[str, Any]:
    return {name: value for base in kind.__mro__ for name, value in vars(base).items()}


def _generator(state: Any, there: Any) -> np.random.Generator:
    value: np.random.Generator = there if type(there) is np.random.Generator else np.random.default_rng(0)
    value.bit_generator.state = state
    return value


def _with_strides(array: np.ndarray, strides: list[int]) -> np.ndarray:
    """The array laid out in memory as it was."""
    span = array.itemsize + sum((n - 1) * s for n, s in zip(array.shape, strides, strict=True) if n)
    if min([0, *strides]) < 0 or span > 64 * array.nbytes + 4096:
        raise ValueError("strides that no array of this program has")
    out = np.ndarray(array.shape, array.dtype, np.empty(span, np.uint8), strides=strides)
    out[...] = array
    return out
