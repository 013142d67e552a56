# SPDX-License-Identifier: Apache-2.0
"""Compiles the CUDA sources to a shared library, once per GPU architecture, and keeps it in the user's cache folder."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

from ggslam.abi import cuda as abi
from ggslam.abi.binding import cuda_hash
from ggslam.errors import MissingDependency
from ggslam.system.tuning import Tuning

KERNELS = Path(__file__).parent / "kernels"
"""Folder of the CUDA sources."""
ABI = KERNELS.parents[1] / "abi"
"""Folder of the headers that say what callers see."""
FORMULAS = KERNELS.parents[1] / "native" / "formulas"
"""Folder of the headers that the kernels share with the compiled core."""

_FLAGS = ("-O3", "-std=c++17", "-ftz=true", "-shared", "-Xcompiler", "-fPIC,-fvisibility=hidden", "--threads", "0")


class CompilerTuning(Tuning):
    """What is told of a failed compilation."""

    error_lines = 12
    """Lines of the compiler's output that an error quotes."""


_USUAL_HOME = "/usr/local/cuda"


def find_nvcc() -> Path | None:
    """The compiler: `GGSLAM_NVCC` in the environment, then the search path, `CUDA_HOME`, `/usr/local/cuda`, and the
    packages of the extra [cuda]."""
    chosen = os.environ.get("GGSLAM_NVCC")
    if chosen:
        return Path(chosen) if Path(chosen).exists() else None
    found = shutil.which("nvcc")
    if found:
        return Path(found)
    homes = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), _USUAL_HOME]
    candidates = [Path(home) / "bin" / "nvcc" for home in homes if home]
    packages = importlib.util.find_spec("nvidia")  # a namespace that many packages share
    for folder in packages.submodule_search_locations or () if packages is not None else ():
        candidates += sorted(Path(folder).glob("cu*/bin/nvcc"), reverse=True)
    return next((path for path in candidates if path.exists()), None)


def cache_folder() -> Path:
    """Where compiled libraries are kept: `GGSLAM_CACHE` in the environment, else ggslam in the user's cache folder.

    Raises:
        MissingDependency: the user has no home.
    """
    if os.environ.get("GGSLAM_CACHE"):
        return Path(os.environ["GGSLAM_CACHE"])
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "ggslam"
    except RuntimeError as error:  # nobody knows the user
        raise MissingDependency(f"the cuda backend: {error} Set GGSLAM_CACHE to a folder for its kernels") from None


@lru_cache(maxsize=4)
def compiler_version(nvcc: Path) -> str:
    """What `nvcc --version` says.

    Raises:
        MissingDependency: it cannot be run.
    """
    try:
        run = subprocess.run([str(nvcc), "--version"], capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise MissingDependency(f"the cuda backend: {nvcc} cannot be run: {error}") from error
    return run.stdout.strip()


def source_files() -> list[Path]:
    """All sources and headers."""
    return [*sorted(KERNELS.rglob("*.cu*")), *sorted(ABI.rglob("*.hpp")), *sorted(FORMULAS.glob("*.hpp"))]


def translation_units() -> list[Path]:
    """Those of them that the compiler is given."""
    return sorted(KERNELS.rglob("*.cu"))


def common_arguments() -> list[str]:
    """What every compiler of these sources is told: where headers are, and version and structures of the interface."""
    structures = ",".join(abi.DECLARED.structures)
    definitions = [f"-DGGSLAM_ABI_HASH={cuda_hash()}", f"-DGGSLAM_STRUCTURES={structures}"]
    return ["-I", str(KERNELS), "-I", str(ABI.parent), *definitions]


def library_path(nvcc: Path, architecture: str) -> Path:
    """The file in the cache for these sources, this compiler and an architecture such as "90"."""
    digest = hashlib.sha256()
    for source in source_files():
        digest.update(f"{source.parent.name}/{source.name}".encode() + b"\0" + source.read_bytes() + b"\0")
    digest.update("\0".join([compiler_version(nvcc), *_FLAGS]).encode())
    return cache_folder() / f"kernels_sm{architecture}_{digest.hexdigest()[:20]}.so"


def compile_command(nvcc: Path, architecture: str, output: Path) -> list[str]:
    """The command that compiles all sources for one architecture."""
    target = f"-gencode=arch=compute_{architecture},code=sm_{architecture}"
    # nvcc takes a comma for the beginning of another definition.
    common = [word.replace(",", r"\,") if word.startswith("-D") else word for word in common_arguments()]
    return [str(nvcc), *_FLAGS, *common, target, *map(str, translation_units()), "-o", str(output)]


def compiled_library(architecture: str) -> Path:
    """The compiled library; compiles it (a minute) if it is not in the cache.

    Args:
        architecture: compute capability without the point, such as "90".

    Raises:
        MissingDependency: no nvcc, it fails, or the cache folder cannot be written.
    """
    nvcc = find_nvcc()
    if nvcc is None:
        named = os.environ.get("GGSLAM_NVCC")
        remedy = "put it on PATH, set CUDA_HOME or GGSLAM_NVCC, or pip install 'ggslam[cuda]'"
        if named:
            remedy = f"there is no {named} (GGSLAM_NVCC)"
        raise MissingDependency(
            f"the cuda backend is compiled when first used and needs nvcc of the CUDA toolkit: {remedy}"
        )
    path = library_path(nvcc, architecture)
    if path.exists():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # beside the target: renaming is atomic
            output = Path(folder) / path.name
            _run(compile_command(nvcc, architecture, output))
            output.replace(path)
    except OSError as error:
        raise MissingDependency(f"the cuda backend: {path.parent} cannot be written: {error}") from error
    return path


def _run(command: list[str]) -> None:
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        lines = (run.stderr + run.stdout).strip().splitlines() or [f"exit status {run.returncode}"]
        reason = "\n".join(lines[: CompilerTuning.error_lines])
        raise MissingDependency(f"the cuda backend: compiling failed: {reason}\nthe command: {shlex.join(command)}")
