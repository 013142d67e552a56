# SPDX-License-Identifier: Apache-2.0
"""Counts what the host does in a run on a pretended GPU, for bench_host.py. `tests` must be on the search path: it has
`device_watch`, by which is counted and whose own work is left out."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import FrameType
from typing import Any

import torch
from device_watch import DeviceTensor, DeviceWatch
from torch.utils._pytree import tree_flatten

from ggslam.abi.cuda import AlignResult, PointsHeader, TrackJob

TOOLS = ("/device_watch/", "/torch/utils/_python_dispatch.py", "/torch/overrides.py", "/weakref.py", "host_counts.py")
"""Code that only watches (by weak references, which memory is given back): neither it nor what it calls is counted, but
for a call of what it stands in for."""
STANDS_IN = ("stand_ins.py", "watch.py")
ON_HOST = ("_bytes", "_room", "_pairs", "_plan", "_create", "_destroy", "_counts", "_error_text")
"""How functions of the library end that start nothing."""
NO_OPERATIONS = {"device", "is_pinned"}


class CallCounter:
    """Within, counts calls of Python and of C functions, in this thread and in all that are started."""

    def __init__(self, found: Counter[str]) -> None:
        self._found, self._inside = found, threading.local()

    def profile(self, frame: FrameType, event: str, argument: object) -> None:
        """What `sys.setprofile` asks for."""
        depth: int = getattr(self._inside, "depth", 0)
        if event == "call":
            path = frame.f_code.co_filename
            if depth or any(tool in path for tool in TOOLS):
                self._inside.depth = depth + 1
                if not depth and path.endswith(STANDS_IN) and not frame.f_code.co_name.startswith("__torch"):
                    self._found["Python calls"] += 1
                return
            self._found["Python calls"] += 1
        elif event == "return":
            self._inside.depth = max(0, depth - 1)
        elif event == "c_call" and not depth:
            self._found["C calls"] += 1

    def __enter__(self) -> None:
        threading.setprofile(self.profile)
        sys.setprofile(self.profile)

    def __exit__(self, *_error: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]


class KernelThread:
    """Makes the calls of a kernels' library in a thread of its own on the last processor, and copies that the caller
    need not wait for beside it: what the host finds in its caches after a call is then what it left there, as with a
    GPU, and not what seconds of emulated kernels left.

    Args:
        functions: as `CudaLibrary.functions`.
    """

    def __init__(self, functions: Any) -> None:
        self._functions, self._main = functions, threading.get_ident()
        self._thread = ThreadPoolExecutor(1, "kernels", self._to_last_processor)
        self._copy = torch.Tensor.copy_
        self.wall = self.cpu = 0.0
        """Seconds within calls and such copies of the thread that made this: by the clock, and of its processor."""
        self.leaves_out = False
        """Calls that compute, and such copies, are not made: results are those of the calls before, but alignments'."""
        self.alignment: ctypes.Array[ctypes.c_double] | None = None
        """What the last alignment found, and what those find that are left out."""

    @staticmethod
    def _to_last_processor() -> None:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._functions, name)

        def called(*arguments: Any) -> Any:
            if name.endswith(ON_HOST):
                return function(*arguments)
            status = self._there(function, *arguments)
            if name == "ggslam_cuda_track_wait":
                self._align(arguments[0]._obj)
            return status

        self.__dict__[name] = called
        return called

    def _align(self, job: TrackJob) -> None:
        results = (ctypes.c_double * AlignResult.ALIGN_RESULTS).from_address(job.results)
        if not self.leaves_out:
            self.alignment = type(results).from_buffer_copy(results)
        elif self.alignment is not None:
            results[:] = self.alignment[:]
            header = PointsHeader.from_address(job.points.out.header)
            header.count = min(int(results[AlignResult.POINT_COUNT]), job.points.columns * job.points.rows)

    def _there(self, function: Any, *arguments: Any) -> Any:
        if self.leaves_out:
            return 0
        wall, cpu = time.perf_counter(), time.thread_time()
        calling = self._thread.submit(function, *arguments)
        while not calling.done():
            time.sleep(0)  # a processor that rests loses its caches, too
        if threading.get_ident() == self._main:
            self.wall += time.perf_counter() - wall
            self.cpu += time.thread_time() - cpu
        return calling.result()

    @contextmanager
    def copying(self) -> Iterator[None]:
        """Within, copies that need not be waited for are the device's."""
        copy, there = self._copy, self._there

        def copied(tensor: torch.Tensor, source: torch.Tensor, non_blocking: bool = False) -> torch.Tensor:
            if non_blocking:
                there(copy, tensor, source)
                return tensor
            return copy(tensor, source)

        torch.Tensor.copy_ = copied  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            torch.Tensor.copy_ = copy  # type: ignore[method-assign]


class CountedFunctions:
    """The functions of a library of kernels; notes how often they are called.

    Args:
        functions: as `CudaLibrary.functions`.
        found: where "library calls" are counted.
    """

    def __init__(self, functions: Any, found: Counter[str]) -> None:
        self._functions, self._found = functions, found

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._functions, name)
        if name == "ggslam_cuda_error_text":
            return function

        def counted(*arguments: Any) -> Any:
            self._found["library calls"] += 1
            return function(*arguments)

        self.__dict__[name] = counted
        return counted


def count_operations(watch: DeviceWatch, found: Counter[str]) -> None:
    """From now on the watch counts operations of torch, tensors they allocate on the device, and page-locked ones."""
    dispatch = watch.dispatch

    def counted(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        name = func.overloadpacket.__name__
        result = dispatch(func, args, kwargs)
        if name in NO_OPERATIONS:
            return result
        found["torch operations"] += 1
        found["pinned allocations"] += bool(kwargs.get("pin_memory")) or name == "_pin_memory"
        given = {_place(value) for value in tree_flatten((args, kwargs))[0] if isinstance(value, DeviceTensor)}
        made = [value for value in tree_flatten(result)[0] if isinstance(value, DeviceTensor)]
        found["allocations"] += sum(_place(value) not in given for value in made)
        return result

    watch.dispatch = counted  # type: ignore[method-assign]


def _place(tensor: DeviceTensor) -> int:
    return tensor.host.untyped_storage().data_ptr()


def take_records(watch: DeviceWatch, found: Counter[str]) -> Counter[str]:
    """What was counted since the last time, records of the watch with it; all begins anew."""
    found["waits"] = len(watch.waits)
    found["downloads"], found["uploads"] = len(watch.downloads), len(watch.uploads)
    found["blocking uploads"] = sum(upload.blocking for upload in watch.uploads)
    found["bytes up"] = sum(upload.bytes for upload in watch.uploads)
    found["bytes down"] = sum(download.bytes for download in watch.downloads)
    taken = Counter(found)
    found.clear()
    watch.forget()
    return taken
