# SPDX-License-Identifier: Apache-2.0
"""What wheels are linked with suits old systems, and `scripts/tools/check_wheel_file.py` notices what does not."""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ggslam.native.loader import load_library

ROOT = Path(__file__).parents[1]
PORTABLE = ROOT / "ggslam" / "native" / "portable"
sys.path.insert(0, str(ROOT / "scripts" / "tools"))
import check_wheel_file as check  # noqa: E402

MACHINE = platform.machine()
pytestmark = [
    pytest.mark.skipif(not PORTABLE.is_dir(), reason="not in a checkout"),
    pytest.mark.skipif(MACHINE not in check.MACHINES, reason="no wheels for this processor"),
    pytest.mark.skipif(not shutil.which("g++") or not shutil.which("readelf"), reason="needs g++ and readelf"),
]
SOURCE = """
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>
extern "C" __attribute__((visibility("default"))) int ggslam_sum(int n) try {
  auto total = std::make_shared<std::vector<int>>(1);
  std::thread([total, n] { for (int i = 0; i < n; ++i) (*total)[0] += i; }).join();
  if ((*total)[0] > 100) throw std::length_error("too much");
  return (*total)[0];
} catch (const std::exception&) {
  return -1;
}
"""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library of one function with a thread, a shared pointer and an exception, linked as cores of wheels are."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "sum.cpp").write_text(SOURCE)
    cmake = (ROOT / "CMakeLists.txt").read_text()
    options = re.search(r"target_link_options\(ggslam_core PRIVATE (-static.*?)\)", cmake, re.S)
    assert options is not None
    flags = options[1].replace("${PORTABLE_DIR}", str(PORTABLE)).split()
    subprocess.run(
        ["g++", "-std=c++17", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-o", folder / "core.so",
         folder / "sum.cpp", PORTABLE / "old_glibc.cpp", *flags], check=True,
    )  # fmt: skip
    return folder / "core.so"


def pack(folder: Path, core: Path, name: str, said: str) -> Path:
    """A wheel of a core and metadata alone."""
    path = folder / name
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.write(core, check.CORE)
        about = ["Metadata-Version: 2.4", "Name: ggslam", "Version: 1.2", "Requires-Python: >=3.10",
                 "License-Expression: Apache-2.0", ""]  # fmt: skip
        wheel.writestr("ggslam-1.2.dist-info/METADATA", "\n".join(about))
        wheel.writestr("ggslam-1.2.dist-info/WHEEL", f"Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: {said}\n")
    return path


def test_a_core_for_wheels_runs_and_suits_glibc_2_28(core: Path, tmp_path: Path) -> None:
    tag = f"py3-none-manylinux_2_28_{MACHINE}"
    assert check.problems_of(pack(tmp_path, core, f"ggslam-1.2-{tag}.whl", tag)) == []
    function = ctypes.CDLL(str(core)).ggslam_sum
    assert (function(10), function(100)) == (45, -1)


def test_names_and_metadata_must_agree(core: Path, tmp_path: Path) -> None:
    tag = f"py3-none-manylinux_2_28_{MACHINE}"
    other = "aarch64" if MACHINE == "x86_64" else "x86_64"
    for name in (f"ggslam-1.2-cp311-cp311-manylinux_2_28_{MACHINE}.whl", f"ggslam-1.2-py3-none-linux_{MACHINE}.whl"):
        assert "the name is not" in check.problems_of(pack(tmp_path, core, name, tag))[0]
    found = check.problems_of(pack(tmp_path, core, f"ggslam-1.2-{tag}.whl", f"py3-none-linux_{MACHINE}"))
    assert found == [f"Tag is py3-none-linux_{MACHINE}, not {tag}"]
    foreign = f"py3-none-manylinux_2_28_{other}"
    found = check.problems_of(pack(tmp_path, core, f"ggslam-1.2-{foreign}.whl", foreign))
    assert f"the core is not for {other}" in found


def test_what_old_systems_lack_is_named(core: Path, tmp_path: Path) -> None:
    tag = f"py3-none-manylinux_2_1_{MACHINE}"
    found = check.problems_of(pack(tmp_path, core, f"ggslam-1.2-{tag}.whl", tag))
    assert any("pthread_create" in problem for problem in found), found
    usual = check.read_elf(Path(load_library()._name), "--file-header", "--dynamic", "--version-info", "--dyn-syms")
    if "libstdc++" in usual:  # built for this machine alone
        found = check.library_problems(usual, MACHINE, 28)
        assert any(problem == "the core needs libstdc++.so.6" for problem in found), found
        assert any(re.match(r"the core needs GLIBCXX_[\d.]+: _Z", problem) for problem in found), found
    strangers = check.library_problems(usual.replace(" ggslam_", " other_"), MACHINE, 28)
    assert any("not ggslam's" in problem for problem in strangers), strangers
