# SPDX-License-Identifier: Apache-2.0
"""The C++ headers as Python reads them, against what a compiler makes of them."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
from ctypes import c_double, c_int32, c_void_p
from pathlib import Path
from types import ModuleType

import pytest

from ggslam.abi import binding, core, cuda
from ggslam.abi.headers import Declarations
from ggslam.errors import NativeCoreError
from ggslam.native.loader import load_library

HEADER = """// SPDX-License-Identifier: Apache-2.0
// A part.
#pragma once
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::part {

constexpr int kMostRows = 4;

enum Kind : int { kNone, kSome = kMostRows + 3, kAll };

// One row.
struct alignas(16) Row {
  const float *first, *second;  // [n]
  std::int32_t kind;
  double values[kMostRows];
};

struct Table {
  Row row;
  std::uint8_t pairs[3][2];
  void* rest;
};

}  // namespace ggslam::part

// Counts.
GGSLAM_EXPORT std::int64_t ggslam_part_count(void* part, const ggslam::part::Table* table, std::size_t size,
                                             const void* const* more);
GGSLAM_EXPORT const char* ggslam_part_name();
GGSLAM_EXPORT void ggslam_part_clear(void* part);
"""


def read(folder: Path, text: str) -> Declarations:
    (folder / "part.hpp").write_text(text)
    return Declarations(folder, ["part"])


def test_a_header_is_read(tmp_path: Path) -> None:
    part = read(tmp_path, HEADER)
    assert part.names["MOST_ROWS"] == 4
    assert {kind.name: kind.value for kind in part.names["Kind"]} == {"NONE": 0, "SOME": 7, "ALL": 8}
    row, table = part.structures.values()
    assert [name for name, _ in row._fields_] == ["first", "second", "kind", "values"]
    assert [kind for _, kind in row._fields_[:3]] == [c_void_p, c_void_p, c_int32]
    assert row._fields_[3][1] is c_double * 4 and table._fields_[0][1] is row
    assert table._fields_[1][1] is ctypes.c_uint8 * 2 * 3
    result, arguments = part.functions["ggslam_part_count"]
    assert result is ctypes.c_int64
    assert arguments == [c_void_p, ctypes.POINTER(table), ctypes.c_size_t, c_void_p]
    assert part.functions["ggslam_part_name"] == (ctypes.c_char_p, [])
    assert part.functions["ggslam_part_clear"] == (None, [c_void_p])


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("std::int32_t kind;", "std::string kind;", "string"),
        ("void* rest;", "int size() const { return 3; }", "struct Table"),
        ("values[kMostRows]", "values[kMost]", "kMost"),
        ("GGSLAM_EXPORT void", "void", "void ggslam_part_clear"),
        ("double values", "double values = 3, more", "values"),
        ("kMostRows = 4", "kMostRows = 4 * 2", "4 \\* 2"),
        ("// One row.", "#if GGSLAM_ROWS", "#if GGSLAM_ROWS"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(NativeCoreError, match=rf"part\.hpp: .*{named}"):
        read(tmp_path, HEADER.replace(old, new, 1))


def full_names(folder: Path) -> list[str]:
    """The structures of headers with their namespaces."""
    names = []
    line = re.compile(r"^namespace ([\w:]+) \{|^struct (?:alignas\(\d+\) )?(\w+)", re.MULTILINE)
    for path in sorted(folder.glob("*.hpp")):
        for space, structure in line.findall(path.read_text()):
            if space:
                inside = space
            else:
                names.append(f"{inside}::{structure}")
    return names


def compiled_layouts(tmp_path: Path, name: str, declared: Declarations) -> list[int]:
    """Size of every structure and offset of each of its fields, as a C++ compiler lays them out."""
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    package = Path(binding.__file__).parents[1]
    folder = Path(binding.__file__).parent / name
    lines = ["#include <cstddef>", "#include <cstdio>"]
    lines += [f'#include "{path}"' for path in sorted(folder.glob("*.hpp"))]
    lines.append("int main() {")
    for structure, mirror in zip(full_names(folder), declared.structures.values(), strict=True):
        lines.append(f'std::printf("%zu\\n", sizeof({structure}));')
        lines += [f'std::printf("%zu\\n", offsetof({structure}, {field}));' for field, *_ in mirror._fields_]
    source, program = tmp_path / "layouts.cpp", tmp_path / "layouts"
    source.write_text("\n".join([*lines, "}"]) + "\n")
    includes = [f"-I{package}", f"-I{package / 'native' / 'src'}"]
    done = subprocess.run([compiler, "-std=c++20", *includes, source, "-o", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [int(line) for line in subprocess.run([program], capture_output=True, text=True).stdout.split()]


@pytest.mark.parametrize(("name", "declared"), [("core", core.DECLARED), ("cuda", cuda.DECLARED)])
def test_every_field_stands_where_the_compiler_puts_it(tmp_path: Path, name: str, declared: Declarations) -> None:
    ours: list[int] = []
    for mirror in declared.structures.values():
        ours += [ctypes.sizeof(mirror), *(getattr(mirror, field).offset for field, *_ in mirror._fields_)]
    assert len(declared.structures) >= 10
    assert ours == compiled_layouts(tmp_path, name, declared)


@pytest.mark.parametrize("side", [core, cuda])
def test_all_headers_are_listed_in_the_order_of_their_hash(side: ModuleType) -> None:
    folder = Path(str(side.__file__)).parent
    assert list(side.HEADERS) == sorted(path.stem for path in folder.glob("*.hpp"))


def test_a_missing_header_is_named(tmp_path: Path) -> None:
    with pytest.raises(NativeCoreError, match=r"part\.hpp: No such file"):
        Declarations(tmp_path, ["part"])


def test_another_size_is_named() -> None:
    class Pair(ctypes.Structure):
        _fields_ = [("first", ctypes.c_float), ("second", c_double)]

    binding.check_sizes("library", {"Pair": Pair}, [16])
    for size in (8, 24):
        with pytest.raises(NativeCoreError, match=f"library: Pair.* 16 .* {size}"):
            binding.check_sizes("library", {"Pair": Pair}, [size])
    with pytest.raises(NativeCoreError, match="library.* 1 .* 2"):
        binding.check_sizes("library", {"Pair": Pair}, [16, 8])


def test_a_core_of_other_headers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    library = ctypes.CDLL(load_library()._name)
    binding.bind_core(library)
    monkeypatch.setattr(core.DECLARED, "lines", [*core.DECLARED.lines, "core/more.hpp 0\n"])
    with pytest.raises(NativeCoreError, match=r"version [0-9a-f]+, expected [0-9a-f]{12}.*build_native"):
        binding.bind_core(library)


def test_a_library_without_a_version_is_refused() -> None:
    with pytest.raises(NativeCoreError, match="no version"):
        binding.bind_core(ctypes.CDLL(None))


def test_functions_take_the_arguments_of_the_headers() -> None:
    library = load_library()
    with pytest.raises(TypeError, match="at least 5"):
        library.ggslam_rasterizer_forward(None, None, None)
    with pytest.raises(ctypes.ArgumentError):
        library.ggslam_rasterizer_forward(None, core.CameraView(), None, None, 0)


def test_a_name_that_no_header_declares_is_not_there() -> None:
    with pytest.raises(AttributeError, match="Nothing"):
        _ = core.Nothing
