# SPDX-License-Identifier: Apache-2.0
"""The compiled CUDA kernels as a loaded library."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path

import torch

from ggslam.abi.binding import bind_cuda
from ggslam.cuda.compiler import compiled_library
from ggslam.errors import DeviceError, MissingDependency


class CudaLibrary:
    """A compiled library.

    Args:
        path: the shared library.
        device_type: of the tensors it works on: "cuda", or "cpu" for the emulation that the tests compile.

    Raises:
        MissingDependency: it cannot be loaded.
        NativeCoreError: it was compiled from other headers.
    """

    def __init__(self, path: Path, device_type: str = "cuda") -> None:
        self.device_type = device_type
        try:
            self.functions = ctypes.CDLL(str(path))
            bind_cuda(self.functions)
        except (OSError, AttributeError) as error:
            raise MissingDependency(f"the cuda backend: {path} cannot be loaded: {error}") from error

    def call(self, name: str, *arguments: object) -> None:
        """Calls ggslam_cuda_<name>.

        Raises:
            DeviceError: it reports an error of the CUDA runtime.
        """
        status = getattr(self.functions, f"ggslam_cuda_{name}")(*arguments)
        if status != 0:
            text = self.functions.ggslam_cuda_error_text(status).decode()
            raise DeviceError(f"CUDA reports {text!r} in {name}")

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


def library_and_device(
    device: torch.device | str | None = None, library: CudaLibrary | None = None
) -> tuple[CudaLibrary, torch.device]:
    """What a part that runs on a device works with: the kernels, and the device with its number.

    Args:
        device: CUDA device; None: the current one.
        library: the kernels; None: those of the device, compiled if need be.

    Raises:
        MissingDependency: as `library_for_device`.
    """
    chosen = None if device is None else torch.device(device)
    library = library or library_for_device(chosen)
    return library, library.whole_device(chosen)
