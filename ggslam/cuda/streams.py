# SPDX-License-Identifier: Apache-2.0
"""Streams of work on a device, and how far the host may be ahead of them."""

from __future__ import annotations

from collections import deque
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch


class SideStream(AbstractContextManager["SideStream"]):
    """Within, as often as it is entered, a thread starts its work on a stream of its own: beside what others start on
    the one that was current when this was made, and before that where both wait for room on the device. Does nothing
    without a GPU.

    Memory goes with the stream that it was allocated on: what was made elsewhere must not be given back within; see
    `let_go`.

    Args:
        device: where. Of its work, what was started before this was made precedes what is started within.
        host_waits: whether at each end the host waits for what was started within. Else the stream that is current
            outside waits, with all that is started there from then on; of this, nothing may be used within.
    """

    def __init__(self, device: torch.device, host_waits: bool = True) -> None:
        self._device, self._host_waits = device, host_waits
        self._stream: torch.cuda.Stream | None = None
        self._end: torch.cuda.Event | None = None
        if device.type == "cuda":
            self._stream, self._end = torch.cuda.Stream(device, priority=-1), torch.cuda.Event()
            self._stream.wait_stream(torch.cuda.current_stream(device))
        self._within: AbstractContextManager[object] = nullcontext()
        if self._stream is not None:
            self._within = torch.cuda.stream(self._stream)

    def __enter__(self) -> SideStream:
        self._within.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._within.__exit__(*error)
        if self._stream is None or self._end is None:
            return
        if self._host_waits:
            self._stream.synchronize()  # memory of this stream may be used on others from now on
        else:
            self._end.record(self._stream)
            torch.cuda.current_stream(self._device).wait_event(self._end)


def let_go(*tensors: torch.Tensor) -> None:
    """Of tensors that nobody will use any more, while work on the current stream may still read them: without this,
    memory that was allocated on another stream would be given to the next who asks there, before that work is done."""
    for tensor in tensors:
        if tensor.device.type == "cuda":
            tensor.record_stream(torch.cuda.current_stream(tensor.device))


class Pace:
    """Keeps the host from running far ahead of the device, so that what is urgent does not queue behind what is not.

    Args:
        device: whose current stream is meant.
        ahead: pieces of work that may be under way.
    """

    def __init__(self, device: torch.device, ahead: int = 2) -> None:
        self._device, self._ahead = device, ahead
        self._ends: deque[torch.cuda.Event] = deque()  # of the pieces under way, the oldest first
        self._passed: torch.cuda.Event | None = None

    def piece_ends(self) -> None:
        """A piece of work has been started. Waits for the one `ahead` pieces before."""
        if self._device.type != "cuda":
            return
        end = self._passed or torch.cuda.Event()
        end.record(torch.cuda.current_stream(self._device))  # a new thread may be on another device
        self._ends.append(end)
        if len(self._ends) > self._ahead:
            self._passed = self._ends.popleft()
            if not self._passed.query():
                self._passed.synchronize()
