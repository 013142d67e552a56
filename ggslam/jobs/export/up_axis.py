# SPDX-License-Identifier: Apache-2.0
"""Which axis of an exported file points up."""

from __future__ import annotations

from enum import Enum


class UpAxis(str, Enum):
    """The axis of a file that points up."""

    y = "y"
    minus_y = "-y"
    z = "z"
