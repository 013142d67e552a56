# SPDX-License-Identifier: Apache-2.0
"""The robot's body as the command line tells it: boxes, or a URDF file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.driving.body import Body, BodyShape
from ggslam.driving.urdf import read_urdf
from ggslam.errors import ConfigError


def read_body(texts: Sequence[str], frame: str | None = None) -> Body | None:
    """A body of all parts that are told; None: of none.

    Args:
        texts: each "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX", a box in the sensor's frame in metres, or the name of a URDF file.
        frame: link of the sensor in the URDF files.

    Raises:
        ConfigError: a text is neither, or `frame` is missing or needless.
        FormatError: a file is damaged, see `read_urdf`.
    """
    boxes = [_box(text) for text in texts]
    files = [text for text, box in zip(texts, boxes, strict=True) if box is None]
    if files and frame is None:
        raise ConfigError(f"`body` {files[0]}: `body_frame` has to name the sensor's link in it")
    if frame is not None and not files:
        raise ConfigError("`body_frame` names a link of a URDF file, and `body` names no file")
    shapes = [box for box in boxes if box is not None]
    for file in files:
        shapes += read_urdf(file, str(frame))
    return Body(tuple(shapes)) if shapes else None


def _box(text: str) -> BodyShape | None:
    """The box of six numbers; None where the text is something else."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        return None
    if len(values) != 6 or not np.isfinite(values).all() or not (values[:3] < values[3:]).all():
        raise ConfigError(
            f'`body`: expected a box "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX" in metres, the lower corner first, found {text!r}'
        )
    T = np.eye(4)
    T[:3, 3] = (values[:3] + values[3:]) / 2
    x, y, z = ((values[3:] - values[:3]) / 2).tolist()
    return BodyShape("box", (x, y, z), T)
