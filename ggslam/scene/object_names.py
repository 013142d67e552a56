# SPDX-License-Identifier: Apache-2.0
"""How objects are called before people."""

from __future__ import annotations


def object_label(id: int, name: str | None) -> str:
    """An object's name and id, or the id alone."""
    return f"{name} ({id})" if name else f"object {id}"
