# SPDX-License-Identifier: Apache-2.0
"""`ggslam doctor` tells what works, what is missing and what to do, and does not need what it looks for."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.errors import NativeCoreError
from ggslam.jobs.doctor import checkup as doctor
from ggslam.jobs.doctor import self_test
from ggslam.native import loader

PROJECT = Path(__file__).parents[2] / "pyproject.toml"


def ggslam_doctor(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["doctor", *arguments], env={"COLUMNS": "200"})


def findings(*arguments: str) -> tuple[bool, dict[str, dict[str, str]]]:
    result = ggslam_doctor("--json", *arguments)
    values = json.loads(result.output)
    assert result.exit_code == (0 if values["works"] else 1), result.output
    return values["works"], {f"{f['section']}/{f['name']}": f for f in values["findings"]}


def test_all_is_well_here() -> None:
    works, found = findings()
    assert works
    for name in loader.available_instruction_sets():
        assert found[f"self-test/render ({name})"]["state"] == "ok"
    assert "pose off by" in found["self-test/track two frames"]["detail"]
    assert found["core/instruction set"]["detail"].startswith(loader.NativeContext().instruction_set)
    shown = {name.removeprefix("extras/") for name in found if name.startswith("extras/")} - {"open3d"}
    assert shown == set(doctor.EXTRAS) - {"formats", "bench", "conformance", "browser", "docs"}  # of developers


def test_for_people() -> None:
    result = ggslam_doctor("--no-self-test")
    assert result.exit_code == 0 and "ggslam works here." in result.output and "self-test" not in result.output


def test_a_core_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise NativeCoreError("the compiled core is missing")

    monkeypatch.setattr(loader, "load_library", missing)
    works, found = findings()
    assert not works and "build_native.sh" in found["core/compiled core"]["advice"]
    assert not any(name.startswith("self-test/") for name in found)
    assert "does not work here" in ggslam_doctor().output


def test_a_core_that_computes_nonsense(monkeypatch: pytest.MonkeyPatch) -> None:
    still = self_test._frame(0)
    monkeypatch.setattr(self_test, "_frame", lambda index: replace(still, index=index))
    works, found = findings()
    assert not works and found["self-test/track two frames"]["state"] == "broken"


def test_packages_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kornia", None)
    works, found = findings()
    assert not works and "pip install" in found["packages/kornia"]["advice"]


def test_extras_and_weights_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "trimesh" else known(name, *a))
    monkeypatch.setenv("GGSLAM_LPIPS_WEIGHTS", "/nowhere/alexnet.ckpt")
    works, found = findings("--no-self-test")
    assert works
    assert found["extras/mesh"]["state"] == "missing" and "ggslam[mesh]" in found["extras/mesh"]["advice"]
    assert found["weights/LPIPS"]["state"] == "missing" and "/nowhere" in found["weights/LPIPS"]["detail"]


def test_every_extra_of_the_project_is_known() -> None:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    if not PROJECT.is_file():
        pytest.skip("not in a checkout")
    project = tomllib.loads(PROJECT.read_text())["project"]
    assert set(project["optional-dependencies"]) - {"test", "dev"} == set(doctor.EXTRAS)
    names = {requirement.split(">")[0].split("=")[0].strip() for requirement in project["dependencies"]}
    assert names == set(doctor.CORE_PACKAGES)


def test_nvcc_is_the_one_that_would_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GGSLAM_NVCC", str(tmp_path / "absent"))
    assert [(f.state, f.detail) for f in doctor._cuda_compiler()] == [("warning", f"there is no {tmp_path / 'absent'}")]
    script = tmp_path / "nvcc"
    script.write_text("#!/bin/sh\necho release 13.9\n")
    script.chmod(0o755)
    monkeypatch.setenv("GGSLAM_NVCC", str(script))
    assert [(f.state, f.detail) for f in doctor._cuda_compiler()] == [("ok", f"release 13.9 ({script})")]
    script.write_text("#!/bin/sh\nexit 1\n")
    assert [f.state for f in doctor._cuda_compiler()] == ["warning"]
