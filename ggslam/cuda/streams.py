# SPDX-License-Identifier: Apache-2.0
"""Streams of work on a device, and how far the host may be ahead of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def side_stream(device: torch.device) -> Iterator[None]:
    """Within, this thread starts its work on a stream of its own: after what was started on the current one before,
    beside what is started there meanwhile, which it precedes where both wait for room on the device. The host waits for
    all of it at the end. Does nothing without a GPU.

    Memory goes with the stream that it was allocated on: what is made within must not be used elsewhere before the host
    has waited for it, and what was made before must not be given back within; see `let_go`."""
    if device.type != "cuda":
        yield
        return
    before = torch.cuda.current_stream(device)
    stream = torch.cuda.Stream(device, priority=-1)
    stream.wait_stream(before)
    try:
        with torch.cuda.stream(stream):
            yield
    finally:
        stream.synchronize()  # memory of this stream may be used on others from now on


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
        self._on_gpu, self._ahead = device.type == "cuda", ahead
        self._ends: deque[torch.cuda.Event] = deque()

    def piece_ends(self) -> None:
        """A piece of work has been started. Waits for the one `ahead` pieces before."""
        if not self._on_gpu:
            return
        end = torch.cuda.Event()
        end.record()
        self._ends.append(end)
        if len(self._ends) > self._ahead:
            before = self._ends.popleft()
            if not before.query():
                before.synchronize()
