# SPDX-License-Identifier: Apache-2.0
"""JSON files: numbers of numpy and paths become plain values, NaN and infinity null."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.system.atomic import write_text
from ggslam.system.untrusted_files import read_untrusted_text


def json_ready(value: Any) -> Any:
    """Plain Python values: numpy numbers converted, NaN and infinity as None (JSON has no word for them)."""
    if isinstance(value, dict):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if isinstance(value, np.ndarray):
        return json_ready(value.tolist())
    if isinstance(value, np.generic):
        return json_ready(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def write_json(path: Path, values: Any, follow: bool = True) -> Path:
    """Writes a whole file of `json_ready` values; returns its path. See `atomic_write` for errors."""
    write_text(path, json.dumps(json_ready(values), indent=1) + "\n", follow=follow)
    return path


def read_json(path: Path) -> Any:
    """Content of a JSON file.

    Raises:
        RunFolderError: it is missing or damaged.
    """
    try:
        return json.loads(read_untrusted_text(path, RunFolderError))
    except ValueError as error:
        raise RunFolderError(f"{path}: cannot be read: {error}") from None
    except RecursionError:
        raise RunFolderError(f"{path}: cannot be read: nested too deeply") from None
