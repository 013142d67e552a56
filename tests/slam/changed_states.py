# SPDX-License-Identifier: Apache-2.0
"""States of a run as somebody else may have written them: one thing in them is changed, whatever it is."""

from __future__ import annotations

import copy
import random
from collections import defaultdict
from typing import Any

import numpy as np

INTEGERS = (-1, -2, 0, 1, 2, 7, 100, 10**6, 2**31 - 1, 2**31, -(2**31), 2**32, 2**63 - 1, -(2**63), 2**64, 10**30)
FLOATS = (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e38, -1.0, 0.0, 1e-300)
OTHERS: tuple[Any, ...] = (
    None, "", "x" * 1000, "\0", True, False, [], [1], {"t": []}, {"d": []}, {"s": []}, {"z": []}, {"d": [[1, 2]]},
    {"r": 0}, {"r": -1}, {"a": 0}, {"a": -1}, {"o": ["ggslam.scene.camera.Camera", {}]}, {"o": ["nothing", {}]},
)  # fmt: skip
DTYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "<u2", "|b1", "<f2")

Place = tuple[Any, Any]
"""A list or dictionary of the tree, and where in it something stands."""


def places_of(tree: Any) -> dict[str, list[Place]]:
    """Everything in a tree (`ggslam.system.object_tree`) by the class and attribute that it is in."""
    found: dict[str, list[Place]] = defaultdict(list)
    waiting: list[tuple[Any, str]] = [(tree, "")]
    while waiting:
        here, name = waiting.pop()
        if isinstance(here, dict) and len(here) == 1:
            ((letter, _),) = here.items()
            found[f"{name}:{letter}"].append((here, letter))
        for container, key, where in _inside(here, name):
            found[where].append((container, key))
            waiting.append((container[key], where))
    return dict(found)


def _inside(here: Any, name: str) -> list[tuple[Any, Any, str]]:
    """What stands directly in a node: container, place in it, name. A node that was changed may hold anything."""
    if isinstance(here, list):
        return [(here, k, f"{name}[]") for k in range(len(here))]
    if not isinstance(here, dict) or len(here) != 1:
        return []
    ((letter, content),) = here.items()
    if not isinstance(content, list):
        return []
    if letter == "o" and len(content) == 2 and isinstance(content[1], dict):
        return [(content[1], attribute, f"{content[0]}.{attribute}") for attribute in content[1]]
    if letter == "d":
        return [(pair, k, f"{name}:d{k}") for pair in content if isinstance(pair, list) for k in range(len(pair))]
    return [(content, k, f"{name}:{letter}[]") for k in range(len(content))] if letter in ("s", "t", "z") else []


def changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Of another type, another shape, or with numbers that cannot be."""
    kind, out = rng.randrange(7), np.array(array)
    with np.errstate(all="ignore"):
        if kind == 0:
            return out.astype(rng.choice(DTYPES))
        if kind == 1 and out.ndim:
            return out[: rng.randrange(len(out) + 1)]
        if kind == 2 and out.ndim and out.size < 10**6:
            return np.concatenate([out, out])
        if kind == 3:
            return out.reshape(-1) if rng.random() < 0.5 else out[None]
        limits = np.iinfo(out.dtype) if out.dtype.kind in "iu" else None
        values = FLOATS if limits is None else (limits.max, limits.min, limits.max // 2, 1, 0)
        if kind < 6 or not out.size:
            out[...] = rng.choice(values)
        else:
            out.reshape(-1)[rng.randrange(out.size)] = rng.choice(values)
    return out


def changed(tree: Any, arrays: list[np.ndarray], rng: random.Random) -> tuple[Any, list[np.ndarray], str]:
    """A copy in which one to three things are changed, and what they are."""
    tree, arrays, told = copy.deepcopy(tree), list(arrays), []
    for _ in range(rng.choice((1, 1, 1, 1, 2, 3))):
        places = places_of(tree)
        name = rng.choice(sorted(places))
        container, key = rng.choice(places[name])
        old = container[key]
        if name.endswith((":a", ":T")) and rng.random() < 0.85:
            number = old["p"] if isinstance(old, dict) else old
            if type(number) is int and 0 <= number < len(arrays):
                arrays[number] = changed_array(arrays[number], rng)
                told.append(f"{name}: {arrays[number].dtype} {list(arrays[number].shape)}")
            continue
        way = rng.randrange(8)
        if way == 0:
            del container[key]
        elif way == 1 and isinstance(container, list):
            container.insert(key, copy.deepcopy(old))
        elif way < 5 and type(old) in (int, float):
            container[key] = rng.choice(INTEGERS if type(old) is int else FLOATS)
        elif way < 5 and type(old) is list and old:
            container[key] = old[: rng.randrange(len(old))]
        else:
            container[key] = copy.deepcopy(rng.choice((*OTHERS, *INTEGERS, *FLOATS)))
        told.append(f"{name}: {way} {str(container[key] if way else None)[:60]}" if way else f"{name}: gone")
    return tree, arrays, "; ".join(told)
