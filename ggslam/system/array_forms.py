# SPDX-License-Identifier: Apache-2.0
"""Declares the dtype and shape of arrays beside the attribute that holds them, and checks them when a file is read.

    T_world_camera: Pose
    depth: Annotated[np.ndarray, Form("f4", "h", "w")]
    color: Annotated[np.ndarray, Form("u1", "h", "w", 3)]     # as high and wide as the depth
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import numpy as np

from ggslam.errors import FormatError


class Form:
    """Type and shape of an array.

    Args:
        code: of numpy, of the type: "f4", "u2", "?"; "int" and "float": of any size.
        shape: of each axis its length, a name, or None (any length); lengths of one name agree within an object.
        finite: neither NaN nor infinite.
        below: whole numbers from 0 to below this.
    """

    def __init__(self, code: str, *shape: int | str | None, finite: bool = False, below: int | None = None) -> None:
        self.code, self.shape, self.finite, self.below = code, shape, finite, below

    def _fits(self, dtype: np.dtype) -> bool:
        if self.code in ("int", "float"):
            return dtype.kind in ("iu" if self.code == "int" else "f")
        return dtype == np.dtype(self.code)

    def check(self, array: np.ndarray, lengths: dict[str, int]) -> str | None:
        """What is wrong with an array; None: nothing.

        Args:
            array: to look at.
            lengths: of named axes as found so far; those found here are added.
        """
        if not self._fits(array.dtype) or array.ndim != len(self.shape):
            return f"expected {self}, found {array.dtype} {list(array.shape)}"
        for expected, length in zip(self.shape, array.shape, strict=True):
            wanted = lengths.setdefault(expected, length) if isinstance(expected, str) else expected
            if wanted is not None and length != wanted:
                return f"expected {self} with {wanted} for {expected}, found {list(array.shape)}"
        return self._check_values(array)

    def _check_values(self, array: np.ndarray) -> str | None:
        if self.finite and not np.isfinite(array).all():
            return "expected finite numbers"
        if self.below is not None and array.size and not (array.min() >= 0 and array.max() < self.below):
            return f"expected 0 to {self.below - 1}, found {array.min()} to {array.max()}"
        return None

    def __str__(self) -> str:
        shape = ", ".join("any" if length is None else str(length) for length in self.shape)
        return f"{self.code if self.code in ('int', 'float') else np.dtype(self.code)} [{shape}]"


class PoseForm(Form):
    """Rigid transforms, float [..., 4, 4].

    Args:
        code: as of `Form`.
        leading: lengths of the axes before the last two.
        farthest_m: metres from the origin that they may be.
    """

    FARTHEST_M = 1e6
    """In the world of a run: farther off float32 has steps of 0.1 m."""
    FARTHEST_ON_EARTH_M = 1e7
    """In the world of a map: UTM and Earth-centred coordinates are nearer."""
    _ROUNDING = 1e-3

    def __init__(self, code: str = "f8", *leading: int | str | None, farthest_m: float = FARTHEST_M) -> None:
        super().__init__(code, *leading, 4, 4, finite=True)
        self._farthest_m = farthest_m

    def _check_values(self, array: np.ndarray) -> str | None:
        if not np.isfinite(array).all() or np.abs(array).max(initial=0) > self._farthest_m:
            return f"expected a pose within {self._farthest_m:g} m of the origin"
        rotation = array[..., :3, :3]
        off = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max(initial=0)
        if off > self._ROUNDING or (np.linalg.det(rotation) < 0).any() or (array[..., 3, :] != [0, 0, 0, 1]).any():
            return "expected a rotation and a translation"
        return None


class NotFinite:
    """Marks a float that may be NaN or infinite."""


class Between:
    """A number from `low` to `high`, both included."""

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    def check(self, value: Any, lengths: dict[str, int]) -> str | None:
        """What is wrong with a number; None: nothing. See `Form.check`."""
        if self.low <= value <= self.high:
            return None
        return f"expected {self.low} to {self.high}, found {value}"


def check_arrays(arrays: Mapping[str, np.ndarray], forms: Mapping[str, Form], what: str) -> None:
    """Raises FormatError if one of some arrays out of a file is missing or has not its form; lengths of one name agree
    among all of them. `what` is for the message."""
    lengths: dict[str, int] = {}
    for name, form in forms.items():
        if name not in arrays:
            raise FormatError(f"{what}: no array '{name}'")
        if found := form.check(np.asarray(arrays[name]), lengths):
            raise FormatError(f"{what}: '{name}': {found}")


def check_indices(what: str, numbers: Iterable[int], end: int) -> None:
    """Raises FormatError if one of some whole numbers is not from 0 to below `end`."""
    for number in numbers:
        if not 0 <= number < end:
            raise FormatError(f"{what}: expected numbers from 0 to below {end}, found {number}")


MaybeNan = Annotated[float, NotFinite()]
ObjectId = Annotated[int, Between(0, 65535)]
"""Number of an object; 0: none."""
Pose = Annotated[np.ndarray, PoseForm()]
"""`T_to_from`, metres."""

Mask = Annotated[np.ndarray, Form("?", "h", "w")]
ColorImage = Annotated[np.ndarray, Form("u1", "h", "w", 3)]
DepthImage = Annotated[np.ndarray, Form("f4", "h", "w")]
"""Metres, 0 = none."""
IdImage = Annotated[np.ndarray, Form("u2", "h", "w")]
"""Numbers of objects, 0 = none."""
Points32 = Annotated[np.ndarray, Form("f4", "n", 3, finite=True)]
Points64 = Annotated[np.ndarray, Form("f8", "n", 3, finite=True)]
Vector3 = Annotated[np.ndarray, Form("f8", 3, finite=True)]
Covariance6 = Annotated[np.ndarray, Form("f8", 6, 6, finite=True)]
