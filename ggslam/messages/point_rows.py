# SPDX-License-Identifier: Apache-2.0
"""Points and Gaussians as rows of a packed table, the content of point clouds in ROS 2 and Foxglove.

Gaussians are written as 3DGS's PLY files have them, so that who reads those reads these: `x y z`, `scale_0..2`
(natural logarithm of metres), `rot_0..3` (quaternion w x y z), `opacity` (logit), `f_dc_0..2` and `f_rest_*` (colour
by spherical harmonics, all of red first), and `id`. A colour in front lets viewers of plain clouds show them, too.
"""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import numpy as np

from ggslam.messages.contents import Points, Splats
from ggslam.messages.sound_content import plain_text
from ggslam.system.tuning import Tuning

Colors = Literal["packed", "columns"]
"""How colours are written: one number `rgb` of 0x00RRGGBB as float32, as rviz wants it, or four columns of uint8 as
Foxglove wants it."""

RESERVED: Final = ("x", "y", "z", "rgb", "red", "green", "blue", "alpha")
"""Columns that values cannot be called by."""
C0: Final = 1 / math.sqrt(4 * math.pi)
"""The harmonic of degree 0."""


class SplatRowTuning(Tuning):
    """Gaussians as rows."""

    least_opacity = 1e-6
    """Opacities are kept this far from 0 and 1, whose logit is infinite."""
    least_scale_m = 1e-9
    """Least scale in metres, whose logarithm is written."""


def point_rows(points: Points, colors: Colors) -> np.ndarray:
    """Rows [N] of a structured type: x, y, z, colours if there are any, and the values by name."""
    values = {plain_text(name): column for name, column in points.values.items() if name not in RESERVED}
    kinds = {name: "<u2" if column.dtype == np.uint16 else "<f4" for name, column in values.items()}
    rows = _table(points.xyz, points.rgb, None, colors, kinds)
    for name, column in values.items():
        rows[name] = column
    return rows


def splat_rows(splats: Splats, colors: Colors) -> np.ndarray:
    """Rows [N] of a structured type, as 3DGS writes Gaussians."""
    count = splats.sh.shape[1]
    opacity = np.clip(splats.opacities, SplatRowTuning.least_opacity, 1 - SplatRowTuning.least_opacity)
    rgb = np.clip((splats.sh[:, 0] * C0 + 0.5) * 255 + 0.5, 0, 255).astype(np.uint8)
    columns = {f"scale_{k}": np.log(np.maximum(splats.scales[:, k], SplatRowTuning.least_scale_m)) for k in range(3)}
    columns |= {f"rot_{k}": splats.quaternions[:, k] for k in range(4)}
    columns["opacity"] = np.log(opacity / (1 - opacity))
    columns |= {f"f_dc_{k}": splats.sh[:, 0, k] for k in range(3)}
    rest = [(channel, k) for channel in range(3) for k in range(1, count)]
    columns |= {f"f_rest_{i}": splats.sh[:, k, channel] for i, (channel, k) in enumerate(rest)}
    alpha = (splats.opacities * 255 + 0.5).clip(0, 255).astype(np.uint8)
    rows = _table(splats.means, rgb, alpha, colors, {**dict.fromkeys(columns, "<f4"), "id": "<u2"})
    for name, column in columns.items():
        rows[name] = column
    rows["id"] = splats.ids
    return rows


def _table(
    xyz: np.ndarray, rgb: np.ndarray | None, alpha: np.ndarray | None, colors: Colors, kinds: dict[str, str]
) -> np.ndarray:
    """Rows with places and colours filled in, and columns for values by name and type."""
    kind = [(name, "<f4") for name in "xyz"]
    if rgb is not None:
        kind += [("rgb", "<u4")] if colors == "packed" else [(n, "u1") for n in ("red", "green", "blue", "alpha")]
    rows = np.empty(len(xyz), np.dtype([*kind, *kinds.items()]))
    for k, name in enumerate("xyz"):
        rows[name] = xyz[:, k]
    if rgb is not None and colors == "packed":
        red, green, blue = (rgb[:, k].astype(np.uint32) for k in range(3))
        rows["rgb"] = red << 16 | green << 8 | blue
    elif rgb is not None:
        for k, name in enumerate(("red", "green", "blue")):
            rows[name] = rgb[:, k]
        rows["alpha"] = 255 if alpha is None else alpha
    return rows


def columns_of(rows: np.ndarray) -> list[tuple[str, str, int]]:
    """Name, numpy's word for the type, and offset in bytes of each column of rows."""
    fields: Any = rows.dtype.fields or {}
    return [(name, fields[name][0].str, fields[name][1]) for name in rows.dtype.names or ()]
