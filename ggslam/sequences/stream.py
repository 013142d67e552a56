# SPDX-License-Identifier: Apache-2.0
"""Reads frames ahead in one background thread, a few at a time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Generic, TypeVar

from ggslam.errors import InputError

Item = TypeVar("Item")


class _Buffer(Generic[Item]):
    """A bounded queue between the reading thread and the iterator. Its lock is re-entrant (Condition's default), so
    that a garbage collection inside the thread may close it."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._items: deque[Item | BaseException | None] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def wait_for_room(self) -> bool:
        """Blocks until one more item fits; false once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or len(self._items) < self._capacity)
            return not self._closed

    def put(self, item: Item | BaseException | None) -> None:
        with self._changed:
            if not self._closed:
                self._items.append(item)
                self._changed.notify_all()

    def take(self) -> Item | BaseException | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._items))
            if self._closed:
                return None
            item = self._items.popleft()
            self._changed.notify_all()
            return item

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._items.clear()
            self._changed.notify_all()


def _read_ahead(read: Callable[[int], Item], count: int, buffer: _Buffer[Item]) -> None:
    for i in range(count):
        if not buffer.wait_for_room():
            return
        try:
            buffer.put(read(i))
        except BaseException as error:  # handed to the consumer, at the place of the item
            buffer.put(error)
            return
    buffer.put(None)


class ReadAhead(Iterator[Item]):
    """Iterates over read(0), read(1), ..., read(count - 1) in order, with at most `prefetch` results waiting.

    An error in `read` is raised where its item would have come. The thread ends when the iterator is used up, closed,
    left as a context, or garbage collected.
    """

    def __init__(self, read: Callable[[int], Item], count: int, prefetch: int) -> None:
        if prefetch < 1:
            raise InputError(f"prefetch must be at least 1, found {prefetch}")
        self._buffer: _Buffer[Item] = _Buffer(prefetch)
        # The thread gets the buffer, not this object: only then can this object be collected while the thread waits.
        self._thread = threading.Thread(
            target=_read_ahead, args=(read, count, self._buffer), name="ggslam-read-ahead", daemon=True
        )
        self._thread.start()

    def __iter__(self) -> ReadAhead[Item]:
        return self

    def __next__(self) -> Item:
        item = self._buffer.take()
        if item is None:
            self.close()
            raise StopIteration
        if isinstance(item, BaseException):
            self.close()
            raise item
        return item

    def close(self) -> None:
        """Ends the thread; the iterator is then used up."""
        self._buffer.close()
        self._thread.join()

    def __enter__(self) -> ReadAhead[Item]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        buffer = getattr(self, "_buffer", None)
        if buffer is not None:
            buffer.close()
