# SPDX-License-Identifier: Apache-2.0
"""Cameras in plain text: K.txt (a matrix, or fx fy cx cy) and COLMAP's cameras.txt."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.camera_files.matrices import intrinsics_of_matrix
from ggslam.system.csv_text import is_number

Entries = dict[str, Any]

COLMAP_MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", ""),
    "PINHOLE": ("fx fy cx cy", ""),
    "SIMPLE_RADIAL": ("f cx cy k1", "opencv"),
    "RADIAL": ("f cx cy k1 k2", "opencv"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "opencv"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "opencv"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "fisheye"),
}
"""COLMAP's model -> its parameters in order, and the lens model that they are of."""
COEFFICIENTS = {"opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
COLMAP_CORNER: Final = 0.5
"""COLMAP's pixel coordinates start at the image's corner; here the centre of the first pixel is 0."""


def from_text(place: object, text: str) -> Entries:
    """Entries of a camera.yaml for the camera of a text file: those of its size are lacking in K.txt.

    Raises:
        SequenceError: it is neither a matrix nor a table of cameras.
    """
    rows = [line.replace(",", " ").split() for line in text.splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    if rows and len(rows[0]) > 4 and not is_number(rows[0][1]):
        return _of_colmap(place, rows)
    words = [word.strip("[];") for row in rows for word in row]
    words = [word for word in words if word]
    if not words or not all(map(is_number, words)) or len(words) not in (4, 9, 12, 16):
        raise SequenceError(
            f"{place}: expected a camera: a matrix of 3x3 or 4x4 numbers, 'fx fy cx cy', or COLMAP's cameras.txt; "
            f"found {_description(words)}"
        )
    numbers = np.array(words, float)
    if not np.isfinite(numbers).all():
        raise SequenceError(f"{place}: expected finite numbers of a camera, found {' '.join(words)[:60]}")
    if numbers.size == 4:
        return dict(zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True))
    return intrinsics_of_matrix(place, numbers)


def _description(words: list[str]) -> str:
    other = next((word for word in words if not is_number(word)), None)
    return "nothing" if not words else f"{len(words)} numbers" if other is None else f"'{other[:40]}'"


def _of_colmap(place: object, rows: list[list[str]]) -> Entries:
    """The camera of cameras.txt: rows CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS; several that differ are refused."""
    if len({tuple(row[1:]) for row in rows}) > 1:
        raise SequenceError(f"{place}: holds {len(rows)} cameras; keep only the right one in the file")
    _, model, *words = rows[0]
    if model not in COLMAP_MODELS:
        raise SequenceError(f"{place}: COLMAP's model {model} is not supported; known are {', '.join(COLMAP_MODELS)}")
    names, lens = COLMAP_MODELS[model][0].split(), COLMAP_MODELS[model][1]
    if len(words) != 2 + len(names) or not all(map(is_number, words)):
        wanted = f"width, height and {', '.join(names)}"
        raise SequenceError(f"{place}: expected {wanted} of {model}, found {' '.join(words)[:80]}")
    width, height, *numbers = map(float, words)
    values = dict(zip(names, numbers, strict=True))
    found: Entries = {
        "width": width, "height": height, "fx": values.get("fx", values.get("f")),
        "fy": values.get("fy", values.get("f")), "cx": values["cx"] - COLMAP_CORNER, "cy": values["cy"] - COLMAP_CORNER,
    }  # fmt: skip
    if lens:
        coefficients = [values.get(name, 0.0) for name in COEFFICIENTS[lens]]
        used = coefficients if lens == "fisheye" or any(coefficients[5:]) else coefficients[:5]
        found |= {"distortion": used, "distortion_model": lens}
    return found
