# SPDX-License-Identifier: Apache-2.0
"""The watch: its records, and the operations that run within it."""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import torch
from cuda_emulation import emulated_library
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only, tree_unflatten

from device_watch.guard import register_guard
from device_watch.order import Clock, WorkOrder
from device_watch.records import DeviceMixing, Record, here
from device_watch.rules import NO_WORK, check_mixing, check_type, host_indices, waits
from device_watch.stand_ins import DeviceGenerator, HostGenerator, replacements
from device_watch.tensors import DEVICE, DeviceMemory, DeviceTensor, _watches
from ggslam.cuda.library import CudaLibrary


class WatchedLibrary(CudaLibrary):
    """The emulated kernels, given tensors of the pretended device."""

    def __init__(self, watch: DeviceWatch) -> None:
        self.device_type = "cuda"
        self.functions = emulated_library().functions
        self._watch = weakref.ref(watch)

    def whole_device(self, device: torch.device | None) -> torch.device:
        return DEVICE if device is None or device.type == "cuda" else device

    def stream(self, device: torch.device) -> None:
        return None

    def call(self, name: str, *arguments: object) -> None:
        watch = self._watch()
        assert watch is not None
        watch.calls.append(Record(name, here(), stream=watch.order.stream))
        used: set[int] = set()
        for argument, following in zip(arguments, (*arguments[1:], None), strict=True):
            if isinstance(found := getattr(argument, "_obj", argument), ctypes.Structure):
                used |= watch.check_addresses(name, found)
            if isinstance(argument, ctypes.Array) and isinstance(following, int):  # structures, and how many
                for found in argument[:following]:
                    used |= watch.check_addresses(name, found)
        watch.order.start(name, set(), used)  # what is only read is not known
        if name.startswith("wait") or name.endswith("_wait"):
            watch.record_wait(f"ggslam_cuda_{name}")
        super().call(name, *arguments)


class _Operations(TorchDispatchMode):
    # With this key torch takes "cuda" as a device without starting CUDA.
    _mode_key = torch._C._TorchDispatchModeKey.FAKE

    def __init__(self, watch: DeviceWatch) -> None:
        super().__init__()
        self._watch = watch

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self._watch.dispatch(func, args, kwargs or {})


class _Generators(TorchFunctionMode):
    """Refuses a generator of one side where tensors of the other are made."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result, generator = func(*args, **(kwargs or {})), (kwargs or {}).get("generator")
        made = isinstance(generator, HostGenerator) and isinstance(result, torch.Tensor)
        if made and isinstance(generator, DeviceGenerator) != isinstance(result, DeviceTensor):
            raise DeviceMixing(f"{func.__name__}: generator on {generator.device}, result on {result.device}")
        return result


class DeviceWatch:
    """See `device_watch`.

    Args:
        is_slow: whether work seems to be done only when the host waits for it, instead of at once.

    Attributes:
        waits, uploads, downloads, calls, kept: what happened so far.
        library: kernels for tensors of the pretended device.
        started: number of asynchronous downloads so far.
    """

    def __init__(self, is_slow: bool = False) -> None:
        self.is_slow = is_slow
        self.waits: list[Record] = []
        self.uploads: list[Record] = []
        self.downloads: list[Record] = []
        self.calls: list[Record] = []
        self.kept: list[Record] = []
        self.started = 0
        self.library = WatchedLibrary(self)
        self.order = WorkOrder()
        self._memory = DeviceMemory(self.order.forget)
        self._page_locked: dict[int, torch.Tensor] = {}  # by address; kept, so that no other memory gets it
        self._under_way: list[tuple[int, torch.Tensor, torch.Tensor]] = []  # number, destination, values
        self._stack = ExitStack()

    def __enter__(self) -> DeviceWatch:
        register_guard()
        self._stack.callback(torch._C._set_only_lift_cpu_tensors, torch._C._only_lift_cpu_tensors())
        torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor makes its values on the host and then moves them
        for replacement in replacements(self):
            self._stack.enter_context(replacement)
        _watches.append(weakref.ref(self))
        self._stack.callback(_watches.pop)
        self._stack.enter_context(patch.object(threading.Thread, "run", self._watched(threading.Thread.run)))
        self._stack.enter_context(_Generators())
        self._stack.enter_context(_Operations(self))
        return self

    def _watched(self, run: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
        """What threads that are started within the watch do."""

        def watched_run(thread: threading.Thread) -> None:
            with _Generators(), _Operations(self):
                run(thread)

        return watched_run

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def forget(self) -> None:
        """Empties the records."""
        for records in (self.waits, self.uploads, self.downloads, self.calls, self.kept):
            records.clear()

    def read(self, tensor: torch.Tensor) -> torch.Tensor:
        """A copy on the CPU, not recorded; possible after the watch, too."""
        return (tensor.host if isinstance(tensor, DeviceTensor) else tensor).detach().clone()

    # --- records -----------------------------------------------------------------------------------------------------

    def record_wait(self, operation: str, before: int | None = None, clock: Clock | None = None) -> None:
        """The host waits, for all that is done by `clock`, None: for what the thread's stream was given; with that the
        first `before` asynchronous downloads have arrived, None: all."""
        self.waits.append(Record(operation, here()))
        self.order.host_waits(clock)
        self.finish(before)

    def note_kept(self) -> None:
        """A tensor was recorded on a stream."""
        self.kept.append(Record("record_stream", here()))

    def finish(self, before: int | None = None) -> None:
        """The first `before` asynchronous downloads arrive; None: all."""
        under_way, self._under_way = self._under_way, []
        for entry in under_way:
            if before is None or entry[0] < before:
                entry[1].copy_(entry[2])
            else:
                self._under_way.append(entry)

    def check_addresses(self, name: str, structure: ctypes.Structure) -> set[int]:
        """Where the tensors begin that the addresses in a structure lead into.

        Raises:
            DeviceMixing: an address but "stream" leads into no tensor that is alive.
        """
        found: set[int] = set()
        for field, kind, *_ in structure._fields_:  # type: ignore[misc]
            value = getattr(structure, field)
            if isinstance(value, ctypes.Structure):
                found |= self.check_addresses(f"{name}: {field}", value)
            elif kind is ctypes.c_void_p and value and field != "stream":
                place = self._memory.place_of(value)
                if place is None and not self._is_in_page_locked(value):
                    raise DeviceMixing(f"{name}: {field} is no address of device memory")
                found |= set() if place is None else {place}
        return found

    def _is_in_page_locked(self, address: int) -> bool:
        return any(
            start <= address < start + tensor.untyped_storage().nbytes()
            for start, tensor in self._page_locked.items()
        )  # fmt: skip

    # --- operations --------------------------------------------------------------------------------------------------

    def dispatch(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Runs an operation of torch on the CPU and records it."""
        name = func.overloadpacket.__name__
        special = getattr(self, f"_run_{name}", None)
        if special is not None:
            return special(func, args, dict(kwargs))
        flat, spec = tree_flatten((args, kwargs))
        tensors = [value for value in flat if isinstance(value, torch.Tensor)]
        check_mixing(func, tensors, args)
        check_type(func, tensors, kwargs.get("device"), kwargs.get("dtype"))
        for index in host_indices(name, args):
            self._record_upload(name, index, False)
        result = self._run(func, flat, spec, kwargs.get("device"))
        self._note_order(func, args, kwargs, result)
        if waits(func, args):
            self.record_wait(name)
        return result

    def _run(self, func: Any, flat: list[Any], spec: Any, device: torch.device | None) -> Any:
        if device is not None and device.type == "cuda" and device.index not in (None, 0):
            raise DeviceMixing(f"{func}: there is no {device}")
        wrappers = {id(value.host): value for value in flat if isinstance(value, DeviceTensor)}
        on_device = bool(wrappers) if device is None else device.type == "cuda"
        args, kwargs = tree_unflatten([_of_host(value) for value in flat], spec)
        page_locked = kwargs.pop("pin_memory", None)
        result = func(*args, **kwargs)
        if page_locked and not on_device:
            self._page_locked[result.untyped_storage().data_ptr()] = result
        if not on_device:
            return result
        return tree_map_only(
            torch.Tensor, lambda host: wrappers[id(host)] if id(host) in wrappers else self._memory.wrap(host), result
        )

    def _note_order(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any], result: Any) -> None:
        """An operation on tensors of the device, unless it looks at none of their values."""
        if func.is_view or func.overloadpacket.__name__ in NO_WORK:
            return
        reads, writes = set[int](), set[int]()
        for number, argument in enumerate(func._schema.arguments):
            value = args[number] if number < len(args) else kwargs.get(argument.name)
            changed = argument.alias_info is not None and argument.alias_info.is_write
            (writes if changed else reads).update(_places(value))
        writes |= _places(result) - reads
        if reads or writes:
            self.order.start(func.overloadpacket.__name__, reads, writes)

    def _run_device(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        return DEVICE  # of a DeviceTensor: torch asks no other

    def _run_is_pinned(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        return self._is_page_locked(args[0])

    def _run__pin_memory(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> torch.Tensor:
        copy = args[0].clone()
        self._page_locked[copy.untyped_storage().data_ptr()] = copy
        return copy

    def _run__to_copy(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        source, device, asynchronous = args[0], kwargs.get("device"), kwargs.pop("non_blocking", False)
        device = source.device if device is None else device
        self.order.start("to", _places(source), set())
        values = func(_of_host(source), **{**kwargs, "device": torch.device("cpu")})
        if device.type == "cuda":
            if not isinstance(source, DeviceTensor):
                self._record_upload("to", source, asynchronous)
            return self._memory.wrap(values)
        if isinstance(source, DeviceTensor) and device.type == "cpu":
            if asynchronous:
                self._page_locked[values.untyped_storage().data_ptr()] = values
                self._start_download("to", values, values.clone())
            else:
                self.record_wait("to")
        return values

    def _run_copy_(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> torch.Tensor:
        target, source = args[:2]
        asynchronous = args[2] if len(args) > 2 else kwargs.get("non_blocking", False)
        to_device, from_device = isinstance(target, DeviceTensor), isinstance(source, DeviceTensor)
        self.order.start("copy_", _places(source), _places(target))
        if to_device and not from_device:
            self._record_upload("copy_", source, asynchronous)
        if from_device and not to_device:
            if asynchronous and self._is_page_locked(target):
                self._start_download("copy_", target, torch.empty_like(target).copy_(source.host))
                return target
            self.record_wait("copy_")
        _of_host(target).copy_(_of_host(source))
        return target

    # --- copies ------------------------------------------------------------------------------------------------------

    def _is_page_locked(self, tensor: torch.Tensor) -> bool:
        return not isinstance(tensor, DeviceTensor) and tensor.untyped_storage().data_ptr() in self._page_locked

    def _record_upload(self, operation: str, source: torch.Tensor, asynchronous: bool) -> None:
        blocking = not (asynchronous and self._is_page_locked(source))
        self.uploads.append(Record(operation, here(), source.numel() * source.element_size(), blocking))
        if blocking:
            self.finish()

    def _start_download(self, operation: str, target: torch.Tensor, values: torch.Tensor) -> None:
        self.downloads.append(Record(operation, here(), values.numel() * values.element_size(), False))
        self._under_way.append((self.started, target, values))
        self.started += 1
        target.fill_(torch.nan if target.is_floating_point() else 85)  # not there yet


def _places(value: Any) -> set[int]:
    """Addresses of the memory of tensors of the device."""
    tensors = [part for part in tree_flatten(value)[0] if isinstance(part, DeviceTensor)]
    return {tensor.host.untyped_storage().data_ptr() for tensor in tensors}


def _of_host(value: Any) -> Any:
    if isinstance(value, DeviceTensor):
        return value.host
    return torch.device("cpu") if isinstance(value, torch.device) and value.type == "cuda" else value
