# SPDX-License-Identifier: Apache-2.0
"""The C interface of the CUDA kernels: structures as in kernels/contract.cuh, functions of kernels/*.cu."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path

import torch

from ggslam.errors import MissingDependency, RenderError
from ggslam.rendering import _native
from ggslam.rendering.cuda.compiler import compiled_library

VERSION = 2
_pointer = ctypes.c_void_p
_int32 = ctypes.c_int32
_int64 = ctypes.c_int64


class Rendering(ctypes.Structure):
    """What to render, where to, and the device memory to work in."""

    _fields_ = [
        ("gaussians", _native.GaussianArrays), ("view", _native.View), ("targets", _native.RenderTargets),
        ("gaussian_workspace", _pointer), ("pair_workspace", _pointer), ("pixel_workspace", _pointer),
        ("pair_capacity", _int64), ("gaussian_sorting_bytes", _int64), ("pair_sorting_bytes", _int64),
        ("stream", _pointer), ("device", _int32),
    ]  # fmt: skip


class Sizes(ctypes.Structure):
    """Bytes of the memory that a rendering works in."""

    _fields_ = [(name, _int64) for name in ("gaussian_workspace", "pair_workspace", "pixel_workspace", "gradient_rows")]


class CudaLibrary:
    """A compiled library.

    Args:
        path: the shared library.
        device_type: of the tensors it works on: "cuda", or "cpu" for the emulation that the tests compile.

    Raises:
        MissingDependency: it cannot be loaded or is of another version.
    """

    def __init__(self, path: Path, device_type: str = "cuda") -> None:
        self.device_type = device_type
        try:
            self.functions = ctypes.CDLL(str(path))
            version = self.functions.ggslam_cuda_version()
        except (OSError, AttributeError) as error:
            raise MissingDependency(f"the cuda backend: {path} cannot be loaded: {error}") from error
        if version != VERSION:
            raise MissingDependency(f"the cuda backend: {path} has interface version {version}, expected {VERSION}")
        functions = self.functions
        functions.ggslam_cuda_error_text.restype = ctypes.c_char_p
        functions.ggslam_cuda_counter_create.argtypes = [ctypes.c_int, _pointer]
        functions.ggslam_cuda_counter_destroy.argtypes = [_pointer]
        functions.ggslam_cuda_counter_destroy.restype = None
        functions.ggslam_cuda_plan.argtypes = [_pointer] * 2
        functions.ggslam_cuda_project.argtypes = [_pointer] * 2
        functions.ggslam_cuda_wait.argtypes = [_pointer] * 2
        functions.ggslam_cuda_composite.argtypes = [_pointer]
        functions.ggslam_cuda_backward.argtypes = [_pointer] * 5
        functions.ggslam_cuda_image_loss.argtypes = [_pointer]
        functions.ggslam_cuda_image_loss_bytes.argtypes = [_pointer]
        functions.ggslam_cuda_image_loss_bytes.restype = _int64

    def call(self, name: str, *arguments: object) -> None:
        """Calls ggslam_cuda_<name>.

        Raises:
            RenderError: it reports an error of the CUDA runtime.
        """
        status = getattr(self.functions, f"ggslam_cuda_{name}")(*arguments)
        if status != 0:
            text = self.functions.ggslam_cuda_error_text(status).decode()
            raise RenderError(f"rendering failed: CUDA reports {text!r} in {name}")

    def whole_device(self, device: torch.device | None) -> torch.device:
        """The device with its number; None: the current one."""
        if device is not None and (device.type != "cuda" or device.index is not None):
            return device
        return torch.device("cuda", torch.cuda.current_device()) if self.device_type == "cuda" else torch.device("cpu")

    def stream(self, device: torch.device) -> int | None:
        """Handle of torch's current stream on the device."""
        return torch.cuda.current_stream(device).cuda_stream if self.device_type == "cuda" else None


@lru_cache(maxsize=8)
def library_for(architecture: str) -> CudaLibrary:
    """The library for an architecture such as "90", compiled if need be.

    Raises:
        MissingDependency: as `compiled_library` and `CudaLibrary`.
    """
    return CudaLibrary(compiled_library(architecture))


def library_for_device(device: torch.device | int | None = None) -> CudaLibrary:
    """The library for a CUDA device; None: the current one.

    Raises:
        MissingDependency: no CUDA device, or as `library_for`.
    """
    if not torch.cuda.is_available():
        raise MissingDependency("the cuda backend needs an NVIDIA GPU and a CUDA build of torch; torch finds none")
    major, minor = torch.cuda.get_device_capability(device)
    if major < 8:  # sums over a warp in one instruction
        raise MissingDependency(f"the cuda backend needs a GPU of compute capability 8.0, found {major}.{minor}")
    return library_for(f"{major}{minor}")
