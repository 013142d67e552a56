# SPDX-License-Identifier: Apache-2.0
"""Writes the ctypes mirrors of the C++ interface headers, and the C++ tables that the mirrors are checked against.

    python scripts/tools/make_native_mirrors.py           # after every change of a header in ggslam/interface
    python scripts/tools/make_native_mirrors.py --check   # fails where a file is not up to date

For each header `ggslam/interface/<side>/<part>.hpp` it writes `<part>.py` (structures, enumerations, whole-number
constants, functions with the types of their arguments) and `<part>_layout.cpp` (sizes and offsets as the compiler has
them). A header holds nothing but

- `struct Name { ... };` of numbers, arrays of numbers, pointers, and structures of the same or an included header;
- `enum Name { ... };` and `constexpr int kName = ...;` of whole numbers;
- `GGSLAM_EXPORT result function(arguments);` outside all namespaces;

with `//` comments. The comment above a structure becomes its docstring, that at the top of the header the module's.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path

INTERFACE = Path(__file__).parents[2] / "ggslam" / "interface"
LINE = 120
INDENT = "    "
NUMBERS = {
    "float": "c_float", "double": "c_double", "int": "c_int", "size_t": "c_size_t",
    **{f"{sign}int{bits}_t": f"c_{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip
SPACE = re.compile(r"\s+")
DECLARATION = re.compile(
    r"struct (?:alignas\((?P<alignment>\d+)\) )?(?P<struct>\w+) \{(?P<fields>[^}]*)\};"
    r"|enum (?P<enum>\w+)(?: : \w+)? \{(?P<values>[^}]*)\};"
    r"|constexpr int (?P<constant>k\w+) = (?P<value>[^;]+);"
    r"|namespace (?P<namespace>[\w:]+) \{"
    r"|(?P<end>\})"
    r"|GGSLAM_EXPORT (?P<result>[^(]*?)(?P<function>\w+)\((?P<arguments>[^)]*)\);"
)


class HeaderError(Exception):
    """Something in a header that has no mirror."""


@dataclass
class Structure:
    """A structure's mirror.

    Attributes:
        fields: name and ctypes expression of each.
        qualified: its name in C++.
    """

    name: str
    qualified: str
    comment: str
    fields: list[tuple[str, str]]


@dataclass
class Header:
    """What a header declares, in its order.

    Attributes:
        path: relative to the folder of the interface.
        imported: names used from other headers, by module.
    """

    path: str
    sha256: str
    comment: str
    constants: dict[str, int] = field(default_factory=dict)
    enums: dict[str, dict[str, int]] = field(default_factory=dict)
    structures: dict[str, Structure] = field(default_factory=dict)
    functions: dict[str, tuple[str, list[str]]] = field(default_factory=dict)
    included: list[Header] = field(default_factory=list)
    imported: dict[str, set[str]] = field(default_factory=dict)

    @property
    def module(self) -> str:
        """Dotted name of its mirror."""
        return "ggslam.interface." + self.path.removesuffix(".hpp").replace("/", ".")

    def find_structure(self, name: str) -> bool:
        """Whether this is the name of a structure here or in an included header, which is then imported."""
        name = name.split("::")[-1]
        if name in self.structures:
            return True
        for other in self.included:
            if name in other.structures:
                self.imported.setdefault(other.module, set()).add(name)
                return True
        return False

    def evaluate(self, expression: str) -> int:
        """A whole number of digits, constants and + - * ( )."""
        known = {**self.constants, **{n: v for values in self.enums.values() for n, v in values.items()}}
        if not re.fullmatch(r"[\w\s+\-*()]+", expression):
            raise HeaderError(f"{self.path}: {expression.strip()!r} is no sum or product of whole numbers")
        try:
            return int(eval(expression, {"__builtins__": {}}, known))  # noqa: S307
        except (NameError, SyntaxError) as error:
            raise HeaderError(f"{self.path}: {expression.strip()!r}: {error}") from None


# --- reading ---------------------------------------------------------------------------------------------------------


def read_header(path: Path, known: dict[Path, Header]) -> Header:
    """Reads a header and those that it includes.

    Raises:
        HeaderError: it holds something that has no mirror.
    """
    if path in known:
        return known[path]
    text = path.read_text()
    header = Header(path.relative_to(INTERFACE).as_posix(), hashlib.sha256(text.encode()).hexdigest(), "")
    known[path] = header
    for name in re.findall(r'#include "interface/([\w/]+\.hpp)"', text):
        if name != "export.hpp":
            header.included.append(read_header(INTERFACE / name, known))
    _, *lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if not line.startswith("//")), len(lines))
    header.comment = _words(lines[:first])
    _read_declarations(header, [line for line in lines[first:] if not line.startswith("#")])
    return header


def _words(lines: list[str]) -> str:
    return " ".join(line.strip().removeprefix("//").strip() for line in lines).strip()


def _read_declarations(header: Header, lines: list[str]) -> None:
    namespaces: list[str] = []
    comment: list[str] = []
    pending = ""
    for line in lines:
        code, _, remark = line.partition("//")
        if not pending and not code.strip():
            comment = [*comment, line] if remark else []
            continue
        pending = SPACE.sub(" ", f"{pending} {code}").strip()
        match = DECLARATION.fullmatch(pending)
        if match is None:
            continue
        _take_declaration(header, match, namespaces, _words(comment))
        pending, comment = "", []
    if pending or namespaces:
        raise HeaderError(f"{header.path}: there is no mirror of: {pending[:200] or 'a namespace without end'}")


def _take_declaration(header: Header, match: re.Match[str], namespaces: list[str], comment: str) -> None:
    if match["struct"]:
        qualified = "::".join([*namespaces, match["struct"]])
        fields = _read_fields(header, match["fields"])
        header.structures[match["struct"]] = Structure(match["struct"], qualified, comment, fields)
    elif match["enum"]:
        values = header.enums[match["enum"]] = {}
        next_value = 0
        for entry in filter(None, map(str.strip, match["values"].split(","))):
            name, _, expression = map(str.strip, entry.partition("="))
            values[name] = header.evaluate(expression) if expression else next_value
            next_value = values[name] + 1
    elif match["constant"]:
        header.constants[match["constant"]] = header.evaluate(match["value"])
    elif match["namespace"]:
        namespaces.append(match["namespace"])
    elif match["end"]:
        namespaces.pop()
    else:
        if namespaces:
            raise HeaderError(f"{header.path}: {match['function']} is declared within a namespace")
        arguments = [a for a in map(str.strip, match["arguments"].split(",")) if a]
        types = [_argument_type(header, re.sub(r"\w+$", "", a)) for a in arguments]
        header.functions[match["function"]] = (_result_type(header, match["result"]), types)


def _read_fields(header: Header, text: str) -> list[tuple[str, str]]:
    fields = []
    for statement in filter(None, map(str.strip, text.split(";"))):
        base = re.match(r"(const )?(?:std::)?([\w:]+)\s*(?=[\s*])", statement)
        if base is None:
            raise HeaderError(f"{header.path}: there is no mirror of the field {statement!r}")
        for declarator in statement[base.end() :].split(","):
            found = re.fullmatch(r"\s*(\**)\s*(?:const )?(\w+)((?:\[[^\]]+\])*)\s*", declarator)
            if found is None:
                raise HeaderError(f"{header.path}: there is no mirror of the field {statement!r}")
            stars, name, lengths = found.groups()
            kind = "c_void_p" if stars else _value_type(header, base[2])
            for length in reversed(re.findall(r"\[([^\]]+)\]", lengths)):
                kind += f" * {header.evaluate(length)}"
            fields.append((name, kind))
    return fields


def _value_type(header: Header, name: str) -> str:
    name = name.removeprefix("std::")
    if name in NUMBERS:
        return NUMBERS[name]
    if header.find_structure(name):
        return name.split("::")[-1]
    raise HeaderError(f"{header.path}: {name} is neither a number nor a structure of this or an included header")


def _argument_type(header: Header, text: str) -> str:
    words = text.replace("const", "").replace(" ", "")
    if words.endswith("*"):
        name = words.rstrip("*")
        mirrored = words.count("*") == 1 and header.find_structure(name)
        return f"POINTER({name.split('::')[-1]})" if mirrored else "c_void_p"
    return _value_type(header, words)


def _result_type(header: Header, text: str) -> str:
    words = text.replace(" ", "")
    if words == "void":
        return "None"
    if words == "constchar*":
        return "c_char_p"
    return "c_void_p" if words.endswith("*") else _value_type(header, words)


# --- writing ---------------------------------------------------------------------------------------------------------


def python_name(name: str) -> str:
    """kMaxDepth -> MAX_DEPTH."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.removeprefix("k")).upper()


def _docstring(text: str, indent: str) -> list[str]:
    lines, line = [], f'{indent}"""'
    for word in text.split():
        separator = "" if line.endswith('"""') or line == indent else " "
        if len(line) + len(separator) + len(word) > LINE - 3:
            lines.append(line)
            line, separator = indent, ""
        line += separator + word
    return [*lines, f'{line}"""']


def _entries(opening: str, entries: list[str], closing: str) -> list[str]:
    """`opening entries closing` on one line if there is room, else on as many as it takes."""
    whole = f"{opening}{', '.join(entries)}{closing}"
    if len(whole) <= LINE:
        return [whole]
    lines, line = [opening], ""
    inner = " " * (len(opening) - len(opening.lstrip())) + INDENT
    for entry in entries:
        if line and len(line) + len(entry) + 2 > LINE:
            lines.append(line)
            line = ""
        line = f"{line} {entry}," if line else f"{inner}{entry},"
    return [*lines, line, f"{' ' * (len(inner) - len(INDENT))}{closing.strip()}"]


def _import(module: str, names: set[str]) -> list[str]:
    def place(name: str) -> tuple[bool, bool, list[str | int]]:
        numbers: list[str | int] = [int(word) if word.isdigit() else word for word in re.split(r"(\d+)", name)]
        return name[0].islower(), not name.isupper(), numbers

    ordered = sorted(names, key=place)
    line = f"from {module} import {', '.join(ordered)}"
    return [line] if len(line) <= LINE else [f"from {module} import (", *(f"{INDENT}{n}," for n in ordered), ")"]


def python_text(header: Header) -> str:
    """The mirror of a header."""
    body: list[str] = []
    for name, value in header.constants.items():
        body += [f"{python_name(name)} = {value}"]
    for name, values in header.enums.items():
        body += ["", "", f"class {name}(IntEnum):", f'{INDENT}"""Values of enum {name}."""', ""]
        body += [f"{INDENT}{python_name(n)} = {v}" for n, v in values.items()]
    for structure in header.structures.values():
        body += ["", "", f"class {structure.name}(Structure):"]
        body += _docstring(structure.comment or f"Mirror of struct {structure.qualified}.", INDENT)
        fields = [f'("{name}", {kind})' for name, kind in structure.fields]
        body += ["", *_entries(f"{INDENT}_fields_ = [", fields, "]")]
    names = [f"{name}," for name in header.structures] if len(header.structures) == 1 else list(header.structures)
    body += ["", "", *_entries("STRUCTURES: tuple[type[Structure], ...] = (", names, ")")]
    body += ["FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {"]
    for name, (result, arguments) in header.functions.items():
        body += _entries(f'{INDENT}"{name}": ({result}, [', arguments, "]),")
    body += ["}", '"""Result and arguments of each."""']
    text = "\n".join(body)
    used = set(re.findall(r"\b(POINTER|Structure|c_\w+)\b", text))
    imports = [line for module, found in sorted(header.imported.items()) for line in _import(module, found)]
    head = [
        "# SPDX-License-Identifier: Apache-2.0",
        f"# Written by scripts/tools/make_native_mirrors.py from {Path(header.path).name}; changes are lost.",
        *_docstring(header.comment, ""), "", "from __future__ import annotations", "",
        *_import("ctypes", used), *(["from enum import IntEnum"] if header.enums else []),
        "from typing import Any", *(["", *imports] if imports else []),
        "", f'HEADER = "{header.path}"', f'HEADER_SHA256 = "{header.sha256}"',
    ]  # fmt: skip
    return "\n".join([*head, text]) + "\n"


def layout_text(header: Header) -> str:
    """A C++ source with the sizes and offsets of a header's structures."""
    side, part = header.path.removesuffix(".hpp").split("/")
    rows = []
    for structure in header.structures.values():
        offsets = [f"offsetof({structure.name}, {name})" for name, _ in structure.fields]
        rows += _wrap([f"sizeof({structure.name})", *offsets])
    using = sorted({f"using {s.qualified};" for s in header.structures.values()})
    prefix = "ggslam_cuda" if side == "cuda" else "ggslam"
    return "\n".join([
        "// SPDX-License-Identifier: Apache-2.0",
        f"// Written by scripts/tools/make_native_mirrors.py from {part}.hpp; changes are lost. Size of each structure and",  # noqa: E501
        "// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.",
        "#include <cstddef>", "#include <cstdint>", "", f'#include "interface/{header.path}"', "", *using, "",
        "namespace {", "constexpr std::size_t kLayout[] = {", *rows, "};", "}  // namespace", "",
        f"GGSLAM_EXPORT const std::size_t* {prefix}_{part}_layout(int* count) {{",
        "  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));", "  return kLayout;", "}",
    ]) + "\n"  # fmt: skip


def _wrap(numbers: list[str]) -> list[str]:
    lines, line = [], "   "
    for number in numbers:
        if len(line) + len(number) + 2 > LINE:
            lines.append(line)
            line = "   "
        line += f" {number},"
    return [*lines, line]


def written_files() -> dict[Path, str]:
    """The text of every file that is made from the headers.

    Raises:
        HeaderError: a header holds something that has no mirror.
    """
    known: dict[Path, Header] = {}
    files = {}
    for path in sorted(INTERFACE.glob("*/*.hpp")):
        header = read_header(path, known)
        files[path.with_suffix(".py")] = python_text(header)
        if header.structures:
            files[path.with_name(f"{path.stem}_layout.cpp")] = layout_text(header)
    return files


def main() -> int:
    """Writes the files, or with --check names those that are not up to date."""
    parser = argparse.ArgumentParser(description="Writes the mirrors of the headers in ggslam/interface.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a file is not up to date")
    check = parser.parse_args().check
    try:
        files = written_files()
    except HeaderError as error:
        print(f"make_native_mirrors: {error}", file=sys.stderr)
        return 1
    old = [path for path, text in files.items() if not path.exists() or path.read_text() != text]
    for path in old:
        print(f"{'not up to date' if check else 'written'}: {path.relative_to(INTERFACE.parents[1])}")
        if not check:
            path.write_text(files[path])
    return int(check and bool(old))


if __name__ == "__main__":
    sys.exit(main())
