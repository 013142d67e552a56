# SPDX-License-Identifier: Apache-2.0
"""Nodes leave the network before the interpreter ends: threads of a library that outlive it would end in a crash, and
those of Zenoh, that Python waits for, would never end."""

from __future__ import annotations

import atexit
import contextlib
import threading
import weakref
from typing import Any, Final

_OPEN: Final[weakref.WeakSet[Any]] = weakref.WeakSet()
_LOCK: Final = threading.Lock()
_STARTED: Final = threading.Event()


def close_at_exit(node: Any) -> None:
    """Has `node.close()` called when the program ends, if nobody did; closing twice must do no harm."""
    with _LOCK:
        _OPEN.add(node)
        if not _STARTED.is_set():
            _STARTED.set()
            threading.Thread(target=_wait_for_end, name="leave the network", daemon=True).start()
            atexit.register(_close_all)


def _wait_for_end() -> None:
    """The main thread ends before Python waits for other threads; what is registered at exit comes only after."""
    threading.main_thread().join()
    _close_all()


def _close_all() -> None:
    with _LOCK:
        for node in list(_OPEN):
            with contextlib.suppress(Exception):
                node.close()
        _OPEN.clear()
