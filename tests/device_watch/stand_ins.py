# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for what torch.cuda and torch.Generator offer on a GPU."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import torch

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

    def record(self, stream: object = None) -> None:
        self._before = active_watch().started

    def wait(self, stream: object = None) -> None:
        """The device waits, not the host."""

    def query(self) -> bool:
        if self._before is not None:
            active_watch().finish(self._before)
        return True

    def synchronize(self) -> None:
        active_watch().record_wait("Event.synchronize", self._before or 0)

    def elapsed_time(self, end: Event) -> float:
        end.synchronize()
        return 0.0


class Stream:
    """torch.cuda.Stream: work is done when it is started."""

    cuda_stream = 0
    device = DEVICE

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def wait_event(self, event: Event) -> None:
        event.wait(self)

    def wait_stream(self, stream: Stream) -> None:
        """The device waits, not the host."""

    def record_event(self, event: Event | None = None) -> Event:
        event = event or Event()
        event.record(self)
        return event

    def query(self) -> bool:
        active_watch().finish()
        return True

    def synchronize(self) -> None:
        active_watch().record_wait("Stream.synchronize")


class Device(contextlib.nullcontext):
    """torch.cuda.device and torch.cuda.stream."""

    def __init__(self, *_: Any) -> None:
        super().__init__()


def replacements(watch: DeviceWatch) -> list[Any]:
    """Patches to enter: of torch.cuda, of torch.Generator, and of how ggslam finds its kernels."""
    current = Stream()
    functions: dict[str, Callable[..., Any] | type] = {
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda device: None,
        "get_device_capability": lambda device=None: (9, 0),
        "get_device_name": lambda device=None: "pretended",
        "synchronize": lambda device=None: watch.record_wait("torch.cuda.synchronize"),
        "current_stream": lambda device=None: current,
        "default_stream": lambda device=None: current,
        "empty_cache": lambda: None,
        "memory_allocated": lambda device=None: 0,
        "max_memory_allocated": lambda device=None: 0,
        "memory_reserved": lambda device=None: 0,
        "reset_peak_memory_stats": lambda device=None: None,
        "stream": Device, "device": Device, "Stream": Stream, "Event": Event,
    }  # fmt: skip
    return [
        *(patch.object(torch.cuda, name, function) for name, function in functions.items()),
        patch.object(torch, "Generator", Generator),
        patch("ggslam.cuda.library.library_for", lambda architecture: watch.library),
    ]
