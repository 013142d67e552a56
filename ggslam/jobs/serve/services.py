# SPDX-License-Identifier: Apache-2.0
"""What can be asked of a map: functions by name that take and return what JSON can hold. Both faces, HTTP and the
services of ROS 2, call them here."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from ggslam.errors import ConfigError
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning

Function = Callable[[dict[str, Any]], dict[str, Any]]
Locate = Callable[[np.ndarray, np.ndarray, Camera | None], dict[str, Any]]

FUNCTIONS: Final = {
    "status": ("", "what is published, frames, dropped frames, whether the run is held"),
    "verdicts": ("", "how the run is doing: name, level, text of each"),
    "save_map": ("name", "save the map as it is now under this name, beside the run"),
    "localize": ("color, depth [, depth_scale, camera]", "pose of an image (PNG or JPEG) with depth (PNG of 16 bits), "
                 "both in base64"),
    "query_distance": ("points [, frame]", "metres to the nearest surface, and in which direction they grow"),
    "plan": ("start, goal [, frame, robot]", "a path for a robot, or why there is none"),
    "pause": ("[on]", "hold the run after the frame in work, or let it go on"),
    "reset": ("", "end the run as Ctrl-C does: what there is is saved"),
}  # fmt: skip
"""Names, what they take, and what they do."""


class ServiceTuning(Tuning):
    """Limits of what is asked."""

    most_points = 20_000
    """Points of one question."""
    farthest_m = 1e6
    """Largest coordinate, in metres."""
    most_letters = 200
    """Of a text."""


class MapServices:
    """Functions that can be asked, one at a time; those that a map has not tell so.

    Args:
        functions: by name, of `FUNCTIONS`.
        locate: locates arrays, see `locate`.
    """

    def __init__(self, functions: Mapping[str, Function], locate: Locate | None = None) -> None:
        self._functions, self._locate = dict(functions), locate
        self._turn = threading.Lock()

    def use(self, functions: Mapping[str, Function], locate: Locate | None = None) -> None:
        """Others answer from now on."""
        self._functions, self._locate = dict(functions), locate

    @property
    def names(self) -> list[str]:
        """Of the functions that there are now."""
        return [name for name in FUNCTIONS if name in self._functions]

    def call(self, name: str, values: object = None) -> dict[str, Any]:
        """Calls a function.

        Args:
            name: of `FUNCTIONS`.
            values: its arguments, by name; None: none.

        Raises:
            GgslamError: there is no such function, an argument is none, or it cannot be done.
        """
        if name not in FUNCTIONS:
            raise ConfigError(f"there is no function {_short(name)!r}; there are {', '.join(FUNCTIONS)}")
        given = {} if values is None else values
        if not isinstance(given, dict):
            raise ConfigError(f"{name}: expected an object with names and values, found {type(given).__name__}")
        known = {word.strip(" []") for word in FUNCTIONS[name][0].replace("[", ",").split(",")} - {""}
        if unknown := [key for key in given if key not in known]:
            takes = f"it takes {FUNCTIONS[name][0]}" if known else "it takes nothing"
            raise ConfigError(f"{name}: {_short(unknown[0])!r} is no argument; {takes}")
        function = self._functions.get(name)
        if function is None:
            raise self._unable(name)
        if name in ("status", "verdicts", "pause", "reset"):  # these wait for nobody
            return function(given)
        with self._turn:
            return function(given)

    def locate(self, color: np.ndarray, depth: np.ndarray, camera: Camera | None) -> dict[str, Any]:
        """As `localize`, of arrays, see `RunFunctions.locate`; errors as of `call`."""
        if self._locate is None:
            raise self._unable("localize")
        with self._turn:
            return self._locate(color, depth, camera)

    def _unable(self, name: str) -> ConfigError:
        return ConfigError(f"{name}: this map cannot do that; it can {', '.join(self.names)}")


# --- arguments -------------------------------------------------------------------------------------------------------


def points_in(values: Mapping[str, Any], name: str) -> np.ndarray:
    """Float64 [N, 3] of a list of points.

    Raises:
        ConfigError: it is none.
    """
    given = values.get(name)
    if not isinstance(given, list) or not 0 < len(given) <= ServiceTuning.most_points:
        raise ConfigError(f"{name}: expected 1 to {ServiceTuning.most_points} points [x, y, z], found {_kind(given)}")
    return np.array([_point(name, one) for one in given])


def point_in(values: Mapping[str, Any], name: str) -> np.ndarray:
    """Float64 [3]; raises ConfigError if it is no point."""
    return np.array(_point(name, values.get(name)))


def _point(name: str, given: object) -> list[float]:
    if not isinstance(given, list) or len(given) != 3 or not all(_is_coordinate(value) for value in given):
        raise ConfigError(f"{name}: expected points of three finite numbers of metres, found {_short(given)}")
    return [float(value) for value in given]


def _is_coordinate(value: object) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= ServiceTuning.farthest_m  # type: ignore[arg-type,operator]


def text_in(values: Mapping[str, Any], name: str, default: str | None = None) -> str:
    """A text; raises ConfigError if it is none, or too long."""
    given = values.get(name, default)
    if not isinstance(given, str) or len(given) > ServiceTuning.most_letters:
        raise ConfigError(f"{name}: expected a text, found {_kind(given)}")
    return given


def flag_in(values: Mapping[str, Any], name: str, default: bool) -> bool:
    """true or false; raises ConfigError if it is neither."""
    given = values.get(name, default)
    if not isinstance(given, bool):
        raise ConfigError(f"{name}: expected true or false, found {_kind(given)}")
    return given


def choice_in(values: Mapping[str, Any], name: str, choices: Sequence[str]) -> str:
    """One of some texts, the first if none is given; raises ConfigError for others."""
    given = text_in(values, name, choices[0])
    if given not in choices:
        raise ConfigError(f"{name}: expected {' or '.join(choices)}, found {_short(given)!r}")
    return given


def _short(value: object) -> str:
    return str(value)[:60]


def _kind(value: object) -> str:
    return "nothing" if value is None else f"{len(value)} of them" if isinstance(value, list) else type(value).__name__
