# SPDX-License-Identifier: Apache-2.0
"""Finding nvcc, compiling the CUDA sources once, saying what is wrong. A script stands in for nvcc."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from rendering_scenes import CAMERA, make_scene

from ggslam.cuda import compiler
from ggslam.cuda.availability import describe_cuda_backend, kernels_to_compile
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import MissingDependency, RenderError
from ggslam.rendering import choose_backend, render

COMPILES = """#!/bin/sh
if [ "$1" = --version ]; then echo "nvcc {version}"; exit 0; fi
echo compiled >> "{log}"
while [ $# -gt 1 ]; do last=$2; shift; done
echo library > "$last"
"""
FAILS = """#!/bin/sh
if [ "$1" = --version ]; then echo "nvcc 1"; exit 0; fi
echo "api.cu(3): error: nonsense" >&2
exit 1
"""


def stand_in(folder: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = folder / "nvcc"
    script.write_text(text.format(version="1.0", log=folder / "log"))
    script.chmod(0o755)
    monkeypatch.setenv("GGSLAM_NVCC", str(script))
    monkeypatch.setenv("GGSLAM_CACHE", str(folder / "cache"))
    compiler.compiler_version.cache_clear()
    return script


def test_compiled_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, COMPILES, monkeypatch)
    first = compiler.compiled_library("90")
    assert compiler.compiled_library("90") == first and first.read_text() == "library\n"
    assert (tmp_path / "log").read_text().count("compiled") == 1
    assert compiler.compiled_library("80") != first
    assert sorted(path.name for path in first.parent.iterdir()) == sorted(
        [first.name, compiler.library_path(tmp_path / "nvcc", "80").name]
    )


def test_another_compiler_or_source_is_another_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = stand_in(tmp_path, COMPILES, monkeypatch)
    first = compiler.library_path(script, "90")
    script.write_text(script.read_text().replace("nvcc 1.0", "nvcc 2.0"))
    compiler.compiler_version.cache_clear()
    second = compiler.library_path(script, "90")
    kernels = tmp_path / "kernels"
    shutil.copytree(compiler.KERNELS, kernels)
    with (kernels / "rendering" / "tile.cuh").open("a") as source:
        source.write("//")
    monkeypatch.setattr(compiler, "KERNELS", kernels)
    assert len({first, second, compiler.library_path(script, "90")}) == 3


def test_a_failing_compiler_is_quoted_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, FAILS, monkeypatch)
    with pytest.raises(MissingDependency, match=r"api\.cu\(3\): error: nonsense\n.*nvcc -O3"):
        compiler.compiled_library("90")
    assert list((tmp_path / "cache").iterdir()) == []


def test_no_compiler_is_said_plainly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GGSLAM_NVCC", str(tmp_path / "absent"))
    with pytest.raises(MissingDependency, match=r"nvcc.*absent.*GGSLAM_NVCC"):
        compiler.compiled_library("90")
    assert describe_cuda_backend() == (False, "no nvcc to compile it with")


def test_nvcc_of_python_packages_is_found_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packaged = tmp_path / "nvidia" / "cu13" / "bin" / "nvcc"
    packaged.parent.mkdir(parents=True)
    packaged.write_text("")
    for name in ("GGSLAM_NVCC", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "nvidia", raising=False)
    monkeypatch.setattr(compiler, "_USUAL_HOME", str(tmp_path / "absent"))
    assert compiler.find_nvcc() == packaged
    home = tmp_path / "home" / "bin" / "nvcc"
    home.parent.mkdir(parents=True)
    home.write_text("")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    assert compiler.find_nvcc() == home


def test_compiling_is_announced_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, COMPILES, monkeypatch)
    assert not kernels_to_compile() or torch.cuda.is_available()
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda: (9, 0))
    assert kernels_to_compile()
    compiler.compiled_library("90")
    assert not kernels_to_compile()


def test_a_cache_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, COMPILES, monkeypatch)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GGSLAM_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(MissingDependency, match=str(tmp_path / "file" / "cache")):
        compiler.compiled_library("90")


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("GGSLAM_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", unknown)
    with pytest.raises(MissingDependency, match="GGSLAM_CACHE"):
        compiler.cache_folder()


def test_a_file_that_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "broken.so").write_text("library\n")
    with pytest.raises(MissingDependency, match="broken.so"):
        CudaLibrary(tmp_path / "broken.so")


def test_gaussians_on_the_cpu_are_not_for_the_cuda_backend() -> None:
    scene = make_scene(5)
    with pytest.raises(RenderError, match="CUDA.*torch.float32.*cpu"):
        render(scene, CAMERA, T_world_camera=torch.eye(4), backend="cuda")
    assert choose_backend(torch.device("cpu")) == "cpu"
    assert torch.equal(
        render(scene, CAMERA, T_world_camera=torch.eye(4), backend="auto").image,
        render(scene, CAMERA, T_world_camera=torch.eye(4)).image,
    )


def test_a_list_in_a_definition_is_one_definition_to_nvcc(tmp_path: Path) -> None:
    command = compiler.compile_command(tmp_path / "nvcc", "90", tmp_path / "rasterizer.so")
    lists = [word for word in command if word.startswith("-DGGSLAM_STRUCTURES=")]
    assert len(lists) == 1 and lists[0].count(",") == lists[0].count(r"\,") > 10


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["80", "90", "100"])
def test_nvcc_compiles_without_warnings_or_spills(tmp_path: Path, architecture: str) -> None:
    nvcc = compiler.find_nvcc()
    if nvcc is None:
        pytest.skip("no nvcc")
    command = compiler.compile_command(nvcc, architecture, tmp_path / "rasterizer.so")
    command += ["-Xptxas", "-v", "-Werror", "all-warnings", "-Xcompiler", "-Wall"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    ours = [part for part in run.stderr.split("Compiling entry function")[1:] if "ggslam" in part.split("\n")[0]]
    assert len(ours) >= 37
    for part in ours:
        assert " 0 bytes spill stores, 0 bytes spill loads" in part, part[:300]
