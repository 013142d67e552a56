# SPDX-License-Identifier: Apache-2.0
"""An oriented box around a thing, as in files and pages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import pydantic

Number = Annotated[float, pydantic.Field(allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]


@dataclass(frozen=True)
class OrientedBox:
    """A box in any orientation.

    Attributes:
        center: metres, world frame.
        axes: three orthogonal unit vectors (right-handed), the directions of `size`; the longest spread first.
        size: metres along the axes.
    """

    center: Vector
    axes: tuple[Vector, Vector, Vector]
    size: Vector
