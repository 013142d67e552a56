# SPDX-License-Identifier: Apache-2.0
"""What is told of a map, before anybody writes it as messages. Lengths in metres, times in seconds since 1970 (or of
the recording), poses T_frame_thing; arrays are not changed after they were handed over."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ggslam.scene.camera import Camera

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Transforms:
    """Edges of the tree of frames: (parent, child, T_parent_child float64 [4, 4]). `fixed`: for good, /tf_static."""

    edges: tuple[tuple[str, str, np.ndarray], ...]
    fixed: bool = False


@dataclass(frozen=True)
class Pose:
    """Where something is: T_frame_thing float64 [4, 4]."""

    frame: str
    T: np.ndarray


@dataclass(frozen=True)
class Path:
    """Where something was: poses float64 [N, 4, 4], stamps float64 [N]."""

    frame: str
    poses: np.ndarray
    stamps: np.ndarray


@dataclass(frozen=True)
class Picture:
    """Colour uint8 [H, W, 3] RGB, or depth float32 [H, W] in metres (0: none). `compressed`: as JPEG, depth as PNG of
    millimetres."""

    frame: str
    image: np.ndarray
    compressed: bool = True


@dataclass(frozen=True)
class Lens:
    """The camera of pictures, without distortion."""

    frame: str
    camera: Camera


@dataclass(frozen=True)
class Points:
    """Points float32 [N, 3]; `rgb` uint8 [N, 3] or None; `values`: more columns by name, [N] of float32 or uint16,
    such as ids or distances."""

    frame: str
    xyz: np.ndarray
    rgb: np.ndarray | None = None
    values: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Splats:
    """Gaussians: means float32 [N, 3], scales float32 [N, 3] (metres), quaternions float32 [N, 4] wxyz, opacities
    float32 [N] in [0, 1], sh float32 [N, K, 3] as 3DGS's coefficients, ids uint16 [N]."""

    frame: str
    means: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    ids: np.ndarray


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices float32 [N, 3], triangles int32 [M, 3], rgb uint8 [N, 3] or None. `part`: which part of a
    larger one this is; a part without triangles is gone."""

    frame: str
    vertices: np.ndarray
    triangles: np.ndarray
    rgb: np.ndarray | None = None
    part: str = ""


@dataclass(frozen=True)
class Grid:
    """Cells int8 [H, W] in a plane: -1 unknown, 0 free to 100 occupied; row 0 lies at the origin's y.

    Attributes:
        frame: that T_frame_origin, float64 [4, 4], is in: of the corner of cell [0, 0], x along columns.
        cell_m: size of a cell.
        at: (row, column) of cell [0, 0] in the whole grid, where this is a part of one; None: it is the whole.
    """

    frame: str
    T_frame_origin: np.ndarray
    cell_m: float
    cells: np.ndarray
    at: tuple[int, int] | None = None


@dataclass(frozen=True)
class Thing:
    """An object, mover or change: an oriented box T_frame_box with its size; `velocity` [3] m/s or None."""

    id: int
    name: str
    T: np.ndarray
    size: np.ndarray
    rgb: tuple[int, int, int] = (128, 128, 128)
    score: float = 1.0
    velocity: np.ndarray | None = None
    note: str = ""


@dataclass(frozen=True)
class Things:
    """All things of a kind that there are now: what is not among them is gone. `up`: the unit vector upwards in the
    frame, where names stand above the boxes; None: they stand in the boxes."""

    frame: str
    things: tuple[Thing, ...]
    up: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Verdict:
    """How something is doing: name, level, a sentence, and values for machines."""

    name: str
    level: Level
    text: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdicts:
    """Diagnostics."""

    verdicts: tuple[Verdict, ...]


Content = Transforms | Pose | Path | Picture | Lens | Points | Splats | Mesh | Grid | Things | Verdicts


@dataclass(frozen=True)
class Channel:
    """A topic of ours.

    Attributes:
        name: without namespace, such as `points`; with a slash first (`/tf`) it is in no namespace.
        kind: class of its contents.
        latched: who joins late gets the last one.
    """

    name: str
    kind: type
    latched: bool = False
