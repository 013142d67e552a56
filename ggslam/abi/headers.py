# SPDX-License-Identifier: Apache-2.0
"""Reads the C++ headers that say what crosses between Python and compiled code, as ctypes structures and functions.

A header holds nothing but

- `struct Name { ... };` of numbers, arrays of numbers, pointers, and structures declared above it;
- `enum Name { ... };` and `constexpr int kName = ...;`, whose values are sums of numbers and names declared above them;
- `GGSLAM_EXPORT result function(arguments);`

with `//` comments, in namespaces. Names of values lose their k: kMostRows becomes MOST_ROWS.
"""

from __future__ import annotations

import ctypes
import hashlib
import re
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

from ggslam.errors import NativeCoreError

_INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
_NUMBERS: dict[str, Any] = {
    "float": ctypes.c_float, "double": ctypes.c_double, "int": ctypes.c_int, "size_t": ctypes.c_size_t,
    **{f"{name}_t": getattr(ctypes, f"c_{name}") for name in _INTEGERS},
}  # fmt: skip
_RESULTS: dict[str, Any] = {"void": None, "char*": ctypes.c_char_p}
_SKIPPED = re.compile(r"//[^\n]*|^#(?:pragma once|include)\b[^\n]*", re.MULTILINE)
_DECLARATION = re.compile(
    r"\s*(?:struct (?:alignas\(\d+\) )?(?P<struct>\w+) \{(?P<fields>[^}]*)\};"
    r"|enum (?P<enum>\w+)(?: : int)? \{(?P<values>[^}]*)\};"
    r"|constexpr int (?P<constant>k\w+) = (?P<value>[^;]+);"
    r"|namespace [\w:]+ \{|\}"
    r"|GGSLAM_EXPORT (?P<result>[^(]*?)(?P<function>\w+)\((?P<arguments>[^)]*)\);)\s*"
)
_TYPE = re.compile(r"(?:const )?([\w:]+)\s*(?=[\s*])")
_FIELD = re.compile(r"\s*(\*?)\s*(\w+)((?:\[\w+\])*)\s*")


class Declarations:
    """What the headers of a folder declare.

    Args:
        folder: of the headers.
        names: of the headers, without suffix, in the order in which they are read.
        structures: those of other headers that these include.

    Attributes:
        structures: by name, without namespace, in the order of the headers.
        functions: result and arguments of each.
        values: enumerations by name, and constants.
        lines: path and SHA-256 of each header, as CMakeLists.txt writes them.

    Raises:
        NativeCoreError: a header cannot be read, or holds something else.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], structures: Mapping[str, type[ctypes.Structure]] | None = None
    ) -> None:
        self.structures: dict[str, type[ctypes.Structure]] = {}
        self.functions: dict[str, tuple[Any, list[Any]]] = {}
        self.values: dict[str, Any] = {}
        self.lines: list[str] = []
        self._types: dict[str, Any] = {**(structures or {}), **_NUMBERS}
        self._numbers: dict[str, int] = {}
        self._module = f"ggslam.abi.{folder.name}"
        for path in (folder / f"{name}.hpp" for name in names):
            try:
                data = path.read_bytes()
            except OSError as error:
                raise NativeCoreError(f"{path}: {error.strerror}") from error
            self.lines.append(f"{folder.name}/{path.name} {hashlib.sha256(data).hexdigest()}\n")
            try:
                self._read(_SKIPPED.sub("", data.decode()))
            except ValueError as error:
                raise NativeCoreError(f"{path}: {error}") from error

    @property
    def names(self) -> dict[str, Any]:
        """Structures, enumerations and constants by name."""
        return {**self.structures, **self.values}

    def _read(self, text: str) -> None:
        place = 0
        while place < len(text):
            found = _DECLARATION.match(text, place)
            if found is None:
                raise ValueError(f"expected a declaration, found {text[place:].strip()[:80]!r}")
            place = found.end()
            if name := found["struct"]:
                fields = [field for each in found["fields"].split(";") if each.strip() for field in self._fields(each)]
                contents = {"_fields_": fields, "__module__": self._module}
                self.structures[name] = self._types[name] = type(name, (ctypes.Structure,), contents)
            elif name := found["enum"]:
                self.values[name] = IntEnum(name, self._enumerate(found["values"]), module=self._module)
            elif name := found["constant"]:
                self._numbers[name] = self.values[_python_name(name)] = self._sum(found["value"])
            elif name := found["function"]:
                arguments = [self._argument(each) for each in found["arguments"].split(",") if each.strip()]
                self.functions[name] = self._result(found["result"]), arguments

    def _fields(self, statement: str) -> list[tuple[str, Any]]:
        """Fields of a statement such as `const float *image, *depth`."""
        base = _TYPE.match(statement := statement.strip())
        if base is None:
            raise ValueError(f"expected fields, found {statement!r}")
        fields = []
        for each in statement[base.end() :].split(","):
            found = _FIELD.fullmatch(each)
            if found is None:
                raise ValueError(f"expected fields, found {statement!r}")
            kind = ctypes.c_void_p if found[1] else self._type(base[1])
            for length in reversed(re.findall(r"\w+", found[3])):
                kind = kind * self._sum(length)
            fields.append((found[2], kind))
        return fields

    def _enumerate(self, text: str) -> dict[str, int]:
        values, following = {}, 0
        for entry in filter(None, map(str.strip, text.split(","))):
            name, _, value = entry.partition("=")
            number = self._numbers[name.strip()] = self._sum(value) if value else following
            values[_python_name(name.strip())], following = number, number + 1
        return values

    def _sum(self, text: str) -> int:
        terms = [term.strip() for term in text.split("+")]
        try:
            return sum(int(term) if term.isdecimal() else self._numbers[term] for term in terms)
        except KeyError as error:
            raise ValueError(f"expected a sum of known numbers, found {text.strip()!r}") from error

    def _type(self, name: str) -> Any:
        try:
            return self._types[name.split("::")[-1]]
        except KeyError:
            raise ValueError(f"expected a number or a structure declared above, found {name!r}") from None

    def _argument(self, text: str) -> Any:
        words = re.sub(r"\bconst\b|\w+$", "", text.strip()).replace(" ", "")
        name = words.rstrip("*").split("::")[-1]
        if not words.endswith("*"):
            return self._type(name)
        is_structure = words.count("*") == 1 and name in self._types and name not in _NUMBERS
        return ctypes.POINTER(self._types[name]) if is_structure else ctypes.c_void_p

    def _result(self, text: str) -> Any:
        words = re.sub(r"\bconst\b|\s", "", text)
        if words in _RESULTS:
            return _RESULTS[words]
        return ctypes.c_void_p if words.endswith("*") else self._type(words)


def _python_name(name: str) -> str:
    """kMaxDepth -> MAX_DEPTH."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.removeprefix("k")).upper()
