# SPDX-License-Identifier: Apache-2.0
"""Gaussians as callers of the library give them."""

from __future__ import annotations

from typing import Any

from ggslam.errors import InputError
from ggslam.scene.gaussian_map import GaussianMap


def given_map(gaussians: Any) -> GaussianMap:
    """A map, or what a `GaussianModel` has learned as a map.

    Raises:
        InputError: it is neither.
    """
    if isinstance(gaussians, GaussianMap):
        return gaussians
    made = gaussians.to_map() if hasattr(gaussians, "to_map") else None
    if not isinstance(made, GaussianMap):
        raise InputError(f"gaussians: expected a GaussianMap or a GaussianModel, found {type(gaussians).__name__}")
    return made
