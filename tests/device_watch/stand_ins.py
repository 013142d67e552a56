# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for what torch.cuda and torch.Generator offer on a GPU."""

from __future__ import annotations

import contextlib
import itertools
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import torch

from device_watch.order import Clock
from device_watch.tensors import DEVICE, active_watch

if TYPE_CHECKING:
    from device_watch import DeviceWatch

HostGenerator = torch.Generator


class DeviceGenerator(HostGenerator):
    """A generator that says it is on `DEVICE`; its numbers are those of the CPU."""

    def __new__(cls, device: Any = None) -> DeviceGenerator:
        return super().__new__(cls, "cpu")

    @property
    def device(self) -> torch.device:
        return DEVICE


class _GeneratorMeta(type(HostGenerator)):  # type: ignore[misc]
    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, HostGenerator)


class Generator(HostGenerator, metaclass=_GeneratorMeta):
    """What takes the place of torch.Generator."""

    def __new__(cls, device: Any = "cpu") -> HostGenerator:  # type: ignore[misc]
        return DeviceGenerator() if torch.device(device).type == "cuda" else HostGenerator(device)


class Event:
    """torch.cuda.Event: knows which asynchronous copies were started before it."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self._before: int | None = None
        self._clock: Clock = {}

    def record(self, stream: Stream | None = None) -> None:
        watch = active_watch()
        self._before = watch.started
        self._clock = watch.order.now(watch.order.stream if stream is None else stream.number)

    def wait(self, stream: Stream | None = None) -> None:
        """The device waits, not the host."""
        order = active_watch().order
        order.wait(order.stream if stream is None else stream.number, self._clock)

    def query(self) -> bool:
        watch = active_watch()
        if watch.is_slow and not watch.order.is_known(self._clock):
            return False
        watch.order.host_waits(self._clock)
        if self._before is not None:
            watch.finish(self._before)
        return True

    def synchronize(self) -> None:
        active_watch().record_wait("Event.synchronize", self._before or 0, self._clock)

    def elapsed_time(self, end: Event) -> float:
        end.synchronize()
        return 0.0


class Stream:
    """torch.cuda.Stream: work is done when it is started. The watch knows what would be done when.

    Attributes:
        number: 0: of the one that all threads work on.
    """

    cuda_stream = 0
    device = DEVICE
    _numbers = itertools.count(1)

    def __init__(self, *_: Any, **__: Any) -> None:
        self.number = next(Stream._numbers)

    def wait_event(self, event: Event) -> None:
        event.wait(self)

    def wait_stream(self, stream: Stream) -> None:
        """The device waits, not the host."""
        order = active_watch().order
        order.wait(self.number, order.now(stream.number))

    def record_event(self, event: Event | None = None) -> Event:
        event = event or Event()
        event.record(self)
        return event

    def query(self) -> bool:
        watch = active_watch()
        clock = watch.order.now(self.number)
        if watch.is_slow and not watch.order.is_known(clock):
            return False
        watch.order.host_waits(clock)
        watch.finish()
        return True

    def synchronize(self) -> None:
        watch = active_watch()
        watch.record_wait("Stream.synchronize", clock=watch.order.now(self.number))


class Device(contextlib.nullcontext):
    """torch.cuda.device."""

    def __init__(self, *_: Any) -> None:
        super().__init__()


class StreamContext(contextlib.AbstractContextManager["StreamContext"]):
    """torch.cuda.stream."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def __enter__(self) -> StreamContext:
        active_watch().order.enter(self._stream.number)
        return self

    def __exit__(self, *_: object) -> None:
        active_watch().order.leave()


def replacements(watch: DeviceWatch) -> list[Any]:
    """Patches to enter: of torch.cuda, of torch.Generator, and of how ggslam finds its kernels."""
    default = Stream()
    default.number = 0
    streams = weakref.WeakValueDictionary({0: default})

    def make_stream(*_: Any, **__: Any) -> Stream:
        stream = Stream()
        streams[stream.number] = stream
        return stream

    functions: dict[str, Callable[..., Any] | type] = {
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda device: None,
        "get_device_capability": lambda device=None: (9, 0),
        "get_device_name": lambda device=None: "pretended",
        "synchronize": lambda device=None: watch.record_wait("torch.cuda.synchronize"),
        "current_stream": lambda device=None: streams[watch.order.stream],
        "default_stream": lambda device=None: default,
        "empty_cache": lambda: None,
        "memory_allocated": lambda device=None: 0,
        "max_memory_allocated": lambda device=None: 0,
        "memory_reserved": lambda device=None: 0,
        "reset_peak_memory_stats": lambda device=None: None,
        "stream": StreamContext, "device": Device, "Stream": make_stream, "Event": Event,
    }  # fmt: skip
    return [
        *(patch.object(torch.cuda, name, function) for name, function in functions.items()),
        patch.object(torch, "Generator", Generator),
        patch("ggslam.cuda.library.library_for", lambda architecture: watch.library),
    ]
