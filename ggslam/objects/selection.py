# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians a selection holds: boxes, spheres, what was drawn on the screen, objects, one after the other.

The viewer's page states the same rules (`viewer/static/selection.js`); what a page selects is decided here, for the
page may show fewer Gaussians than the map has.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, cast

import numpy as np

from ggslam.errors import ConfigError
from ggslam.system.tuning import Tuning

Mode = Literal["set", "add", "remove", "intersect", "invert"]
MODES: Final = ("set", "add", "remove", "intersect", "invert")
"""What becomes of the Gaussians in a shape; intersect drops those outside it, invert takes those in it that were not
selected and drops those that were."""
DepthOf = Callable[["ScreenShape"], np.ndarray]
"""Gives the depth of the surfaces that a screen shows, float32 [h, w] of its mask's size, metres; 0: none."""


class SelectionTuning(Tuning):
    """Limits of selections, and which Gaussians are seen."""

    max_steps = 1000
    """Most steps of a selection."""
    max_mask_pixels = 1 << 22
    """Most pixels of what is drawn on the screen."""
    max_pixels_of_all = 1 << 28
    """Most pixels of all that is drawn in a selection: each drawing may need the map to be rendered."""
    seen_share = 0.05
    """A Gaussian is seen whose depth is beyond the surface there by at most this share of it ..."""
    seen_m = 0.03
    """... and so many metres."""


@dataclass(frozen=True)
class ScreenShape:
    """What was drawn on a screen.

    Attributes:
        T_camera_world: [4, 4].
        width, height: of the screen, in pixels; its middle lies on the optical axis.
        focal: focal length, in pixels of the screen.
        near: nearer Gaussians are not shown, in metres.
        mask: bool [h, w]: what was drawn, in another number of pixels.
        seen_only: whether Gaussians behind the surface there are left out.
        hidden: ids of objects that are not shown, and cover nothing.
    """

    T_camera_world: np.ndarray
    width: int
    height: int
    focal: float
    near: float
    mask: np.ndarray
    seen_only: bool
    hidden: frozenset[int] = frozenset()

    def rows(self, means: np.ndarray, depth_of: DepthOf | None) -> np.ndarray:
        """Which of the centres, float [N, 3], lie in what was drawn; bool [N]."""
        local = means.astype(np.float64) @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        ahead = local[:, 2] > max(self.near, 1e-9)
        z = np.where(ahead, local[:, 2], 1.0)
        h, w = self.mask.shape
        column = np.floor((local[:, 0] / z * self.focal + self.width / 2) * w / self.width)
        row = np.floor((local[:, 1] / z * self.focal + self.height / 2) * h / self.height)
        inside = ahead & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        index = np.flatnonzero(inside)
        column, row = column[index].astype(int), row[index].astype(int)
        found = self.mask[row, column]
        if self.seen_only and depth_of is not None:
            surface = depth_of(self)[row, column]
            found &= (surface > 0) & (z[index] <= (1 + SelectionTuning.seen_share) * surface + SelectionTuning.seen_m)
        result = np.zeros(len(means), bool)
        result[index] = found
        return result


@dataclass(frozen=True)
class Step:
    """A shape, what becomes of the Gaussians in it, and ids of objects that are hidden: it holds none of theirs."""

    mode: Mode
    shape: ScreenShape | _Sphere | _Box | _Objects | _All
    hidden: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Selection:
    """Steps, done one after the other to an empty selection."""

    steps: tuple[Step, ...]

    def rows(self, means: np.ndarray, owners: np.ndarray, depth_of: DepthOf | None = None) -> np.ndarray:
        """The Gaussians that are selected, bool [N].

        Args:
            means: centres, float [N, 3], metres, world frame.
            owners: object ids int [N]; 0: none.
            depth_of: for screens of which only what is seen counts; None: all counts.
        """
        selected = np.zeros(len(means), bool)
        for step in self.steps:
            shape = step.shape
            found = shape.rows(owners) if isinstance(shape, _Objects) else shape.rows(means, depth_of)
            if step.hidden:
                found &= ~np.isin(owners, list(step.hidden))
            if step.mode == "set":
                selected = found
            elif step.mode == "add":
                selected = selected | found
            elif step.mode == "remove":
                selected = selected & ~found
            elif step.mode == "invert":
                selected = selected ^ found
            else:
                selected = selected & found
        return selected

    def objects(self) -> list[int] | None:
        """The ids, if the selection is of whole objects and nothing else."""
        first = self.steps[0]
        if len(self.steps) != 1 or first.mode not in ("set", "add") or not isinstance(first.shape, _Objects):
            return None
        return sorted(first.shape.ids)


@dataclass(frozen=True)
class _All:
    def rows(self, means: np.ndarray, depth_of: DepthOf | None) -> np.ndarray:
        return np.ones(len(means), bool)


@dataclass(frozen=True)
class _Objects:
    ids: frozenset[int]

    def rows(self, owners: np.ndarray) -> np.ndarray:
        return cast(np.ndarray, np.isin(owners, list(self.ids)))


@dataclass(frozen=True)
class _Sphere:
    center: np.ndarray
    radius: float

    def rows(self, means: np.ndarray, depth_of: DepthOf | None) -> np.ndarray:
        return cast(np.ndarray, ((means.astype(np.float64) - self.center) ** 2).sum(1) <= self.radius**2)


@dataclass(frozen=True)
class _Box:
    center: np.ndarray
    axes: np.ndarray
    size: np.ndarray

    def rows(self, means: np.ndarray, depth_of: DepthOf | None) -> np.ndarray:
        local = (means.astype(np.float64) - self.center) @ self.axes.T
        return cast(np.ndarray, (np.abs(local) <= self.size / 2).all(1))


# --- reading ----------------------------------------------------------------------------------------------------------


def parse_selection(text: str) -> Selection:
    """A selection as JSON text, see `read_selection`.

    Raises:
        ConfigError: it is no selection.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigError("selection: expected JSON") from None
    return read_selection(values)


def read_selection(values: Any) -> Selection:
    """A selection: a list of {"mode": one of `MODES`, "shape": SHAPE}, where SHAPE is one of

        {"kind": "all"}
        {"kind": "objects", "ids": [...]}
        {"kind": "sphere", "center": [3], "radius": metres}
        {"kind": "box", "center": [3], "axes": three rows, "size": [3]}
        {"kind": "screen", "T_camera_world": [16] by rows, "width", "height", "focal", "near", "seen_only",
         "mask": {"width", "height", "runs": [so many not set, so many set, ...] by rows}}

    Each may have "hidden": ids of objects that were hidden, none of which it holds.

    Raises:
        ConfigError: it is something else; the message names the place.
    """
    if not isinstance(values, list) or not 0 < len(values) <= SelectionTuning.max_steps:
        raise ConfigError(f"selection: expected a list of 1 to {SelectionTuning.max_steps} steps")
    steps, pixels = list[Step](), 0
    for k, value in enumerate(values):
        steps.append(_step(f"selection[{k}]", value))
        shape = steps[-1].shape
        pixels += shape.mask.size if isinstance(shape, ScreenShape) else 0
        if pixels > SelectionTuning.max_pixels_of_all:
            raise ConfigError(f"selection: what is drawn has over {SelectionTuning.max_pixels_of_all:,} pixels in all")
    return Selection(tuple(steps))


def _step(where: str, value: Any) -> Step:
    if not isinstance(value, dict) or value.get("mode") not in MODES or not isinstance(value.get("shape"), dict):
        raise ConfigError(f"{where}: expected a mode ({', '.join(MODES)}) and a shape")
    shape = value["shape"]
    readers: dict[str, Callable[[str, Mapping[str, Any]], Any]] = {
        "all": lambda where, shape: _All(), "objects": _objects, "sphere": _sphere, "box": _box, "screen": _screen,
    }  # fmt: skip
    reader = readers.get(str(shape.get("kind")))
    if reader is None:
        raise ConfigError(f"{where}: expected a shape of the kinds {', '.join(readers)}")
    return Step(value["mode"], reader(where, shape), _ids(where, {"hidden": [], **shape}, "hidden"))


def _objects(where: str, shape: Mapping[str, Any]) -> _Objects:
    return _Objects(_ids(where, shape, "ids"))


def _ids(where: str, shape: Mapping[str, Any], name: str) -> frozenset[int]:
    ids = shape.get(name)
    if not isinstance(ids, list) or len(ids) > 65536 or not all(type(i) is int and 0 <= i <= 65535 for i in ids):
        raise ConfigError(f"{where}: {name}: expected object ids, 0 to 65535")
    return frozenset(ids)


def _sphere(where: str, shape: Mapping[str, Any]) -> _Sphere:
    return _Sphere(_numbers(where, shape, "center", 3), _positive(where, shape, "radius"))


def _box(where: str, shape: Mapping[str, Any]) -> _Box:
    rows = shape.get("axes")
    nested = isinstance(rows, list) and all(isinstance(row, list) for row in rows)
    flat = [value for row in rows for value in row] if isinstance(rows, list) and nested else rows
    axes = _numbers(where, {"axes": flat}, "axes", 9).reshape(3, 3)
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
        raise ConfigError(f"{where}: axes: expected three unit vectors at right angles")
    size = _numbers(where, shape, "size", 3)
    if size.min() < 0:
        raise ConfigError(f"{where}: size: expected no negative numbers")
    return _Box(_numbers(where, shape, "center", 3), axes, size)


def _screen(where: str, shape: Mapping[str, Any]) -> ScreenShape:
    T = _numbers(where, shape, "T_camera_world", 16).reshape(4, 4)
    width, height = (round(_positive(where, shape, name)) for name in ("width", "height"))
    near = float(_numbers(where, {"near": [shape.get("near", 0.0)]}, "near", 1)[0])
    mask = _mask(where, shape.get("mask"))
    focal = _positive(where, shape, "focal")
    hidden = _ids(where, {"hidden": [], **shape}, "hidden")
    return ScreenShape(T, max(width, 1), max(height, 1), focal, near, mask, shape.get("seen_only") is True, hidden)


def _mask(where: str, values: Any) -> np.ndarray:
    found = values if isinstance(values, dict) else {}
    width, height, runs = _count(found.get("width")), _count(found.get("height")), found.get("runs")
    pixels = width * height
    if not 0 < pixels <= SelectionTuning.max_mask_pixels or not isinstance(runs, list):
        raise ConfigError(f"{where}: mask: expected width, height and runs")
    if not all(type(run) is int and 0 <= run <= pixels for run in runs) or sum(runs) > pixels:
        raise ConfigError(f"{where}: mask: runs: expected lengths that fit into {width}x{height} pixels")
    flat = np.zeros(pixels, bool)
    ends = np.cumsum(np.array(runs, np.int64))
    for start, end in zip(ends[0::2], ends[1::2], strict=False):
        flat[start:end] = True
    return flat.reshape(height, width)


def _count(value: Any) -> int:
    """A whole number above 0; 0 of all else."""
    return value if type(value) is int and value > 0 else 0


def _numbers(where: str, values: Mapping[str, Any], name: str, count: int) -> np.ndarray:
    found: Any = values.get(name)
    numbers = isinstance(found, Sequence) and len(found) == count and all(type(v) in (int, float) for v in found)
    if not numbers or not all(abs(v) <= 1e9 for v in found):  # of whole numbers, too, that no float holds
        raise ConfigError(f"{where}: {name}: expected {count} finite number{'s' * (count > 1)}, at most 1e9")
    return np.array(found, np.float64)


def _positive(where: str, values: Mapping[str, Any], name: str) -> float:
    number = float(_numbers(where, {name: [values.get(name)]}, name, 1)[0])
    if number <= 0:
        raise ConfigError(f"{where}: {name}: expected a positive number, found {number:g}")
    return number
