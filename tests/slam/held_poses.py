# SPDX-License-Identifier: Apache-2.0
"""Every pose that an object holds, however deep, found by walking through its attributes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

PLAIN = (str, bytes, int, float, bool, type(None), type)


def held_poses(root: Any) -> dict[str, np.ndarray]:
    """Copies of all rigid motions below an object, [4, 4] or [n, 4, 4], by the path of attributes to them. What is
    reached on two paths stands under the first."""
    return {path: pose.copy() for path, pose in _walk(root, "", set())}


def _walk(value: Any, path: str, seen: set[int]) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, PLAIN) or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        if are_rigid(value):
            yield path, value
        return
    for name, item in _parts(value):
        yield from _walk(item, f"{path}{name}", seen)


def _parts(value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, Mapping):
        return [(f"[{key}]", item) for key, item in value.items()]
    if isinstance(value, (list, tuple, set, frozenset)) or type(value).__name__ == "deque":
        return [(f"[{number}]", item) for number, item in enumerate(value)]
    if type(value).__module__.startswith("ggslam."):
        slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
        names = [*getattr(value, "__dict__", {}), *(name for name in slots if hasattr(value, name))]
        return [(f".{name}", getattr(value, name)) for name in names]
    return []


def are_rigid(array: np.ndarray) -> bool:
    """Whether an array holds rigid motions."""
    if array.shape[-2:] != (4, 4) or array.ndim > 3 or not array.size or array.dtype.kind != "f":
        return False
    T = array.reshape(-1, 4, 4).astype(float)
    square = T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    return bool(np.allclose(square, np.eye(3), atol=1e-4) and np.allclose(T[:, 3], [0, 0, 0, 1], atol=1e-6))
