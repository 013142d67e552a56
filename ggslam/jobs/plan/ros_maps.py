# SPDX-License-Identifier: Apache-2.0
"""Reads maps of ROS's map_server: a yaml file and the image that it names."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.system.images import decode_image, find_damage
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import is_plain_name, read_untrusted, read_untrusted_text

_PGM: Final = re.compile(rb"P5(?:\s+#[^\n]*)*\s+(\d{1,9})(?:\s+#[^\n]*)*\s+(\d{1,9})(?:\s+#[^\n]*)*\s+(\d{1,5})\s")
_MODES: Final = ("trinary", "scale", "raw")
_THRESHOLDS: Final = {"occupied_thresh": 0.65, "free_thresh": 0.196}
_MOST_RAW: Final = 100
"""Largest occupancy in mode `raw`."""


class RosMapTuning(Tuning):
    """Limits of maps that are read."""

    max_pixels = 100_000_000
    """Most cells."""


@dataclass(frozen=True)
class RosMap:
    """A map of map_server.

    Attributes:
        occupied, free: bool [H, W], row 0 where y is smallest.
        resolution: edge of a cell, metres.
        origin: x, y (metres) and yaw (radians) of the lower left corner of the first cell.
    """

    occupied: np.ndarray
    free: np.ndarray
    resolution: float
    origin: tuple[float, float, float]


def read_ros_map(path: Path) -> RosMap:
    """Reads a map by map_server's rules: a pixel is as occupied as it is dark (`negate`: bright).

    Raises:
        FormatError: a file is missing, damaged, or no such map.
    """
    values = read_yaml(path)
    resolution, origin = _number(path, "resolution", values.get("resolution")), values.get("origin")
    if not isinstance(origin, list) or len(origin) != 3 or not 1e-4 <= resolution <= 1e3:
        raise FormatError(f"{path}: expected a resolution of 0.0001 to 1000 m and an origin of three numbers")
    x, y, yaw = (_number(path, "origin", value) for value in origin)
    limits = [_number(path, name, values.get(name, usual)) for name, usual in _THRESHOLDS.items()]
    occupied, free = (cells[::-1] for cells in _cells(path, values, *limits))
    return RosMap(occupied, free & ~occupied, resolution, (x, y, yaw))


def read_yaml(path: Path) -> dict[str, Any]:
    """Names and values of a YAML file. Raises FormatError if it has none."""
    try:
        values = parse_yaml(read_untrusted_text(path))
    except PlainYamlError as error:
        raise FormatError(f"{path}: cannot be read: {error}") from None
    if not isinstance(values, dict):
        raise FormatError(f"{path}: expected names and values, found {type(values).__name__}")
    return values


def _cells(path: Path, values: dict[str, Any], least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels are more occupied than `least`, and which less than `most`: bool [H, W] both; neither: unknown."""
    name, mode = values.get("image"), values.get("mode", "trinary")
    if not isinstance(name, str) or not is_plain_name(name):
        raise FormatError(f"{path}: image: expected the name of a file beside it, found {str(name)[:80]!r}")
    if mode not in _MODES:
        raise FormatError(f"{path}: mode: expected {', '.join(_MODES)}, found {str(mode)[:80]!r}")
    picture, white = _read_image(path.parent / name)
    # Of grey images the levels are looked at, in double precision as map_server does: a shade may be a threshold.
    plain = picture.ndim == 2
    grey = np.arange(256.0**picture.dtype.itemsize) if plain else picture[..., :3].mean(axis=2)
    known = np.ones(grey.shape, bool)
    shade = grey / white if values.get("negate", 0) not in (0, False) else 1 - grey / white
    if mode == "raw":
        shade, known = grey / _MOST_RAW, grey <= _MOST_RAW
    elif not plain and picture.shape[2] == 4:
        known = picture[..., 3] == white if mode == "scale" else picture[..., 3] > 0
    occupied, free = known & (shade > least), known & (shade < most)
    return (occupied[picture], free[picture]) if plain else (occupied, free)


def _read_image(path: Path) -> tuple[np.ndarray, int]:
    """Pixels [H, W] or [H, W, channels] and the value of white."""
    content = read_untrusted(path)
    if content[:2] == b"P5":
        return _read_pgm(path, content)
    damage = find_damage(content)
    if damage:
        raise FormatError(f"{path}: {damage}")
    picture = decode_image(path, content, cv2.IMREAD_UNCHANGED, RosMapTuning.max_pixels)
    return picture, int(np.iinfo(picture.dtype).max)


def _read_pgm(path: Path, content: bytes) -> tuple[np.ndarray, int]:
    header = _PGM.match(content)
    if header is None:
        raise FormatError(f"{path}: no PGM image: its header cannot be read")
    width, height, white = (int(number) for number in header.groups())
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    if not 0 < width * height <= RosMapTuning.max_pixels or not 0 < white < 65536:
        raise FormatError(f"{path}: claims {width}x{height} pixels; 1 to {RosMapTuning.max_pixels:,} are read")
    if len(content) - header.end() < width * height * kind.itemsize:
        raise FormatError(f"{path}: cut off: {width}x{height} pixels need more bytes than it has")
    return np.frombuffer(content, kind, width * height, header.end()).reshape(height, width), white


def _number(path: Path, name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise FormatError(f"{path}: {name}: expected a number, found {str(value)[:80]!r}")
    return float(value)
