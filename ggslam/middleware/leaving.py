# SPDX-License-Identifier: Apache-2.0
"""Nodes leave the network before the interpreter ends: threads of a library that outlive it would end in a crash."""

from __future__ import annotations

import atexit
import contextlib
import weakref
from typing import Any, Final

_OPEN: Final[weakref.WeakSet[Any]] = weakref.WeakSet()


def close_at_exit(node: Any) -> None:
    """Has `node.close()` called when the interpreter ends, if nobody did; closing twice must do no harm."""
    if not _OPEN:
        atexit.unregister(_close_all)
        atexit.register(_close_all)
    _OPEN.add(node)


def _close_all() -> None:
    for node in list(_OPEN):
        with contextlib.suppress(Exception):
            node.close()
