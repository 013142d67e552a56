# SPDX-License-Identifier: Apache-2.0
"""What the numbers in depth images mean: distance along the optical axis or the ray, inverse depth, and which number
means "not measured"."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ggslam.errors import SequenceError

Measure = Literal["z", "ray", "inverse"]

SIDES = ("mirrored", "flipped", "mirrored,flipped")
WORDS = "z, ray, inverse or inverse:NUMBER, mirrored, flipped, none:CODE"


@dataclass(frozen=True)
class DepthKind:
    """How depth images are stored.

    Attributes:
        measure: "z": distance along the optical axis; "ray": distance from the camera's centre, along the ray of the
            pixel; "inverse": what grows towards the camera, as disparity does.
        inverse_units: with "inverse", what the stored number is at 1 m: z = inverse_units / stored; None: the
            recording's depth scale.
        mirrored, flipped: whether left and right, or top and bottom, are exchanged against colour.
        none: stored numbers that mean "nothing measured" beside 0.
        told: whether a user says what the measure is.
    """

    measure: Measure = "z"
    inverse_units: float | None = None
    mirrored: bool = False
    flipped: bool = False
    none: tuple[float, ...] = ()
    told: bool = field(default=False, compare=False)

    def with_words(self, word: str) -> str:
        """What says this and one word more."""
        words = [] if self.measure == "z" or word.startswith(("ray", "inverse")) else [self.measure_word]
        words += [name for name in ("mirrored", "flipped") if getattr(self, name) != (name in word.split(","))]
        words += [] if word in SIDES else [word]
        words += [f"none:{code:g}" for code in self.none]
        return ",".join(words) or "z"

    @property
    def measure_word(self) -> str:
        """The measure as a user says it."""
        return self.measure if self.inverse_units is None else f"{self.measure}:{self.inverse_units:g}"

    def to_z(self, depth: np.ndarray, rays: np.ndarray, depth_scale: float) -> np.ndarray:
        """Depth image as stored -> distance along the optical axis, metres.

        Args:
            depth: float32 [H, W], what is stored divided by `depth_scale`; 0: none.
            rays: float32 [H, W, 3] with z = 1, of the camera whose depth it is.
            depth_scale: units per metre.

        Returns:
            float32 [H, W]; 0: none.
        """
        depth = self.right_way_round(depth)
        if self.measure == "ray":
            depth = depth / np.linalg.norm(rays, axis=2)
        elif self.measure == "inverse":
            units = (self.inverse_units or depth_scale) / depth_scale
            depth = np.divide(np.float32(units), depth, out=np.zeros(depth.shape, np.float32), where=depth > 0)
        return np.ascontiguousarray(depth, np.float32)

    def right_way_round(self, image: np.ndarray) -> np.ndarray:
        """An image [H, W] as stored -> the right way round."""
        image = image[:, ::-1] if self.mirrored else image
        return image[::-1] if self.flipped else image


PLAIN = DepthKind()


def read_depth_kind(text: str | None) -> DepthKind:
    """The kind that a user names: words with commas between, of `WORDS`; None: plain depth.

    Raises:
        SequenceError: another word, or two that exclude each other.
    """
    kind: dict[str, object] = {}
    none: list[float] = []
    for word in [] if text is None else [part.strip() for part in text.split(",")]:
        name, _, number = word.partition(":")
        if name in ("z", "ray", "inverse") and "measure" not in kind and (not number or name == "inverse"):
            kind["measure"], kind["told"] = name, True
            if number:
                kind["inverse_units"] = _positive(text, number)
        elif word in ("mirrored", "flipped"):
            kind[word] = True
        elif name == "none" and number:
            none.append(_positive(text, number))
        else:
            raise SequenceError(f"`depth_kind`: expected words of {WORDS}, found '{str(text)[:60]}'")
    return DepthKind(none=tuple(none), **kind)  # type: ignore[arg-type]


def _positive(text: str | None, number: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise SequenceError(f"`depth_kind`: expected a positive number after the colon, found '{str(text)[:60]}'")
    return value
