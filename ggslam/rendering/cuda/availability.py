# SPDX-License-Identifier: Apache-2.0
"""Whether the CUDA rasterizer can be used here."""

from __future__ import annotations

from functools import lru_cache

from ggslam.errors import MissingDependency
from ggslam.rendering.cuda.library import library_for_device


@lru_cache(maxsize=1)
def cuda_backend_problem() -> str | None:
    """Why the backend "cuda" cannot be used on the current device; None if it can. Compiles it if that was not done
    yet; the answer is remembered."""
    try:
        library_for_device()
    except MissingDependency as error:
        return str(error)
    return None
