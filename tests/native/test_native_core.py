# SPDX-License-Identifier: Apache-2.0
"""Where the compiled core is looked for."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ggslam.native.loader import load_library

CHECKOUT = Path(__file__).parents[2]
LOAD = "from ggslam.native.loader import load_library; print(load_library()._name)"


def loaded(checkout: Path) -> subprocess.CompletedProcess[str]:
    """What a checkout without a core of its own loads where a package is installed."""
    installed = Path(load_library()._name).parents[3]
    paths = os.pathsep.join([str(checkout), str(installed)])
    return subprocess.run(
        [sys.executable, "-c", LOAD], cwd=checkout, env={**os.environ, "PYTHONPATH": paths}, capture_output=True,
        text=True,
    )  # fmt: skip


@pytest.mark.skipif("GGSLAM_CORE" in os.environ, reason="another core was asked for")
def test_a_checkout_takes_the_installed_core_of_its_own_sources_alone(tmp_path: Path) -> None:
    native = tmp_path / "ggslam" / "native"
    for folder in ("native", "abi", "system"):
        ignored = shutil.ignore_patterns("_lib", "__pycache__")
        shutil.copytree(CHECKOUT / "ggslam" / folder, native.with_name(folder), ignore=ignored)
    for name in ("__init__.py", "errors.py"):
        shutil.copy(CHECKOUT / "ggslam" / name, tmp_path / "ggslam" / name)
    found = loaded(tmp_path)
    assert found.stdout.strip() == load_library()._name, found.stderr
    with (native / "src" / "context.cpp").open("a") as file:
        file.write("// changed since\n")
    other = loaded(tmp_path)
    assert other.returncode == 1 and "compiled core is missing" in other.stderr
