# SPDX-License-Identifier: Apache-2.0
"""Packages that only some formats need, imported where they are."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from ggslam.errors import MissingDependency


def package_for(
    path: str | Path, module: str, extra: str, name: str = "", otherwise: str = "", verb: str = "write"
) -> ModuleType:
    """The package that reads or writes a file.

    Args:
        path: the file.
        module: what is imported.
        extra: the extra of ggslam that brings it.
        name: of the package, where it is not the module's.
        otherwise: what can be done without it.
        verb: what is done with the file.

    Raises:
        MissingDependency: it is not installed; says how to get it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        remedy = f"`pip install 'ggslam[{extra}]'`" + (f", or {otherwise}" if otherwise else "")
        raise MissingDependency(
            f"to {verb} {path} the package {name or module} is needed: {remedy} ({error})"
        ) from None
