# SPDX-License-Identifier: Apache-2.0
"""Loads functions and classes of the user by name: `module:function` or `path/to/file.py:function`."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

_FILES = "_file_of_"
"""Begins the names of modules that are files, so that they hide no module of their name."""


def load_named(name: str) -> object:
    """What a name stands for. Its module is run: never load a name that a file of somebody else gives.

    Raises:
        ValueError: there is no such file, module or attribute, or importing it fails; the message says which.
    """
    place, _, attribute = name.rpartition(":")
    if not place or not attribute.isidentifier():
        raise ValueError("expected module:function or path/to/file.py:function")
    try:
        module = _module_in(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    except Exception as error:
        raise ValueError(f"{place} cannot be imported: {tell_with_line(error)}") from error
    if not hasattr(module, attribute):
        named = vars(module).items()
        own = [n for n, v in named if callable(v) and getattr(v, "__module__", "") == module.__name__]
        raise ValueError(f"{place} has no {attribute}; it has {', '.join(own) or 'no functions'}")
    return getattr(module, attribute)


def tell_with_line(error: Exception) -> str:
    """An error of the user's code for people: its type, its text, and the line that it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "importlib" not in f.filename and f.filename != __file__]
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return f"{type(error).__name__}: {error}{place}"


def _module_in(path: Path) -> ModuleType:
    """The module that a file holds; it can import modules beside it."""
    path = path.resolve()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    name = _FILES + path.stem
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look there
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    spec.loader.exec_module(module)
    return module
