# SPDX-License-Identifier: Apache-2.0
"""Names of objects in texts and in file names."""

from __future__ import annotations

import re


def object_label(id: int, name: str | None) -> str:
    """An object's name and id, or the id alone."""
    return f"{name} ({id})" if name else f"object {id}"


def object_file_name(id: int, name: str | None) -> str:
    """`7_mug.ply`, in characters that every file system takes."""
    plain = re.sub(r"[^A-Za-z0-9-]+", "_", name or "").strip("_")[:64]
    return f"{id}_{plain}.ply" if plain else f"{id}.ply"
