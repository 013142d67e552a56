# SPDX-License-Identifier: Apache-2.0
"""Arrays as the compiled code takes them."""

from __future__ import annotations

import numpy as np
import torch


def address(array: np.ndarray | torch.Tensor | None) -> int | None:
    """Address of the first element, which the caller keeps alive and contiguous; None stays None (a null pointer)."""
    if isinstance(array, np.ndarray):
        return array.__array_interface__["data"][0]  # array.ctypes.data makes objects of Python
    return None if array is None else array.data_ptr()
