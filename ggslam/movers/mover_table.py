# SPDX-License-Identifier: Apache-2.0
"""The movers that a run found: when and where each of them was seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ggslam.system.array_forms import Pose, Vector3
from ggslam.system.savable import savable

Kind = Literal["rigid", "not rigid", "unknown"]


@savable(formerly="ggslam.movers.mover_table.MoverSight")
@dataclass(frozen=True)
class MoverSight:
    """A mover in a frame.

    Attributes:
        frame: `Frame.index`.
        T_camera_mover: float64 [4, 4]: relative to the camera, whose pose may be corrected later.
        low, high: corners of the box about it in its own frame, [3] metres.
        share: of the image that shows it; 0: of what was kept of it.
    """

    frame: int
    T_camera_mover: Pose
    low: Vector3
    high: Vector3
    share: float


@dataclass(frozen=True)
class FoundMover:
    """A mover of a run.

    Attributes:
        number: 1, 2, ...; that of the recording's masks where they tell.
        instance: its id in the recording's masks; None: they do not tell.
        kind: whether it keeps its shape.
        found: frame in which it was first seen to move; the masks of movers begin there.
        sights: frames in which it moves, in order; the first ones may be older than `found`, as found out later.
        before: where it stood before it moved, and...
        after: ...where it came to rest; None: not seen.
        scatter_m, scatter_deg: of the poses before and after, as far as single frames tell.
        points, colors: float32 [n, 3], its surface in its own frame, colours in [0, 1].
    """

    number: int
    instance: int | None
    kind: Kind
    found: int
    sights: list[MoverSight]
    before: MoverSight | None = None
    after: MoverSight | None = None
    scatter_m: float = 0.0
    scatter_deg: float = 0.0
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
