# SPDX-License-Identifier: Apache-2.0
"""The mirrors of the C++ headers: made anew after every change, checked against what the compiler laid out."""

from __future__ import annotations

import ctypes
import importlib.util
import sys
from ctypes import c_double, c_float, c_int32, c_void_p
from pathlib import Path
from types import ModuleType

import pytest

from ggslam.errors import NativeCoreError
from ggslam.interface import binding
from ggslam.interface.core import rendering
from ggslam.native.loader import load_library

SCRIPT = Path(__file__).parents[2] / "scripts" / "tools" / "make_native_mirrors.py"
HEADER = """// SPDX-License-Identifier: Apache-2.0
// A part.
#pragma once
#include <cstdint>

#include "interface/export.hpp"

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


@pytest.fixture
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_native_mirrors", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_native_mirrors"] = module  # for its dataclasses
    spec.loader.exec_module(module)
    return module


def mirror(generator: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> dict:
    """What the mirror of a header defines."""
    (folder / "core").mkdir()
    (folder / "core" / "part.hpp").write_text(text)
    monkeypatch.setattr(generator, "INTERFACE", folder)
    names: dict = {}
    exec(generator.written_files()[folder / "core" / "part.py"], names)
    return names


def test_the_mirrors_are_those_of_the_headers(generator: ModuleType) -> None:
    old = [str(path) for path, text in generator.written_files().items() if path.read_text() != text]
    assert not old, "run python scripts/tools/make_native_mirrors.py"


def test_a_header_is_mirrored(generator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = mirror(generator, tmp_path, monkeypatch, HEADER)
    assert part["__doc__"] == "A part." and part["MOST_ROWS"] == 4
    assert {kind.name: kind.value for kind in part["Kind"]} == {"NONE": 0, "SOME": 7, "ALL": 8}
    row, table = part["STRUCTURES"]
    assert row.__doc__ == "One row." and ctypes.sizeof(row) == 56
    assert [name for name, _ in row._fields_] == ["first", "second", "kind", "values"]
    assert [kind for _, kind in row._fields_[:3]] == [c_void_p, c_void_p, c_int32]
    assert row._fields_[3][1] is c_double * 4 and table._fields_[0][1] is row
    assert table._fields_[1][1] is ctypes.c_uint8 * 2 * 3
    result, arguments = part["FUNCTIONS"]["ggslam_part_count"]
    assert result is ctypes.c_int64
    assert arguments == [c_void_p, ctypes.POINTER(table), ctypes.c_size_t, c_void_p]
    assert part["FUNCTIONS"]["ggslam_part_name"] == (ctypes.c_char_p, [])
    assert part["FUNCTIONS"]["ggslam_part_clear"] == (None, [c_void_p])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("std::int32_t kind;", "std::string kind;", "string is neither a number nor a structure"),
        ("void* rest;", "int size() const { return 3; }", "no mirror"),
        ("values[kMostRows]", "values[kMost]", "kMost"),
        ("}  // namespace ggslam::part\n", "", "within a namespace"),
        ("GGSLAM_EXPORT void", "void", "no mirror"),
    ],
)
def test_what_has_no_mirror_is_refused(
    generator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, message: str
) -> None:
    with pytest.raises(generator.HeaderError, match=rf"core/part\.hpp: .*{message}"):
        mirror(generator, tmp_path, monkeypatch, HEADER.replace(old, new, 1))


def test_another_layout_is_named() -> None:
    class Pair(ctypes.Structure):
        _fields_ = [("first", c_float), ("second", c_double)]

    binding.check_layout("library", [Pair], [16, 0, 8])
    for found, message in (
        ([8, 0, 4], "size is 8, expected 16"), ([16, 0, 4], "offset of second is 4, expected 8"),
        ([16, 0], "offset of second is None"), ([16, 0, 8, 4], "more structures than the 1"),
    ):  # fmt: skip
        with pytest.raises(NativeCoreError, match=message):
            binding.check_layout("library", [Pair], found)


def test_a_core_of_other_headers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    library = ctypes.CDLL(load_library()._name)
    binding.bind_core(library)
    monkeypatch.setattr(rendering, "HEADER_SHA256", "0" * 64)
    with pytest.raises(NativeCoreError, match=r"interface has version [0-9a-f]+, expected [0-9a-f]{12}: run"):
        binding.bind_core(library)


def test_a_library_without_a_version_is_refused() -> None:
    with pytest.raises(NativeCoreError, match="has no version, expected"):
        binding.bind_core(ctypes.CDLL(None))


def test_functions_take_the_arguments_of_the_headers() -> None:
    library = load_library()
    with pytest.raises(TypeError, match="at least 5"):
        library.ggslam_rasterizer_forward(None, None, None)
    with pytest.raises(ctypes.ArgumentError):
        library.ggslam_rasterizer_forward(None, rendering.CameraView(), None, None, 0)
