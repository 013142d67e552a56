# SPDX-License-Identifier: Apache-2.0
"""rig.yaml: cameras that are fixed to one another, and the recording that each of them made.

    cameras:
      - name: front
        recording: front                  a folder or file of any format, relative to rig.yaml
        T_rig_camera: [16 numbers, row by row]   from its frame to the rig's, OpenCV axes, metres
      - name: back
        recording: walk.bag
        T_rig_camera: [...]
        topics: [color=/back/image, depth=/back/depth]
        time_offset: 0.012                seconds added to its times; optional, as all that follows
        scale: 0.5                        of its images; times `scale` of the run
        intrinsics: [fx, fy, cx, cy]      or camera: FILE; else the recording's own
    tolerance: 0.02                       seconds between images that count as taken together; optional

An entry also takes `format`, `masks`, `depth_scale`, `depth_camera`, `min_confidence`, `pose_convention`, `depth_kind`,
`depth_delay`, `upright` and `void_id`, which mean what the arguments of `open_sequence` of these names do.
"""

from __future__ import annotations

import difflib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.association import PairingTuning
from ggslam.sequences.calibration import number_entry, transform_entry
from ggslam.sequences.recording import read_text
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml, repeated_key
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import given_path

FILE = "rig.yaml"
"""The file of a rig in a folder of its own."""
_PATHS = ("masks", "depth_camera", "camera")
_TEXTS = ("format", "pose_convention", "depth_kind", "depth_delay")
_KEYS = (
    "name", "recording", "T_rig_camera", "time_offset", "scale", "intrinsics", "topics", "depth_scale",
    "min_confidence", "upright", "void_id", *_PATHS, *_TEXTS,
)  # fmt: skip


class RigFileTuning(Tuning):
    """Limits on numbers in rig.yaml."""

    max_tolerance_s = 10.0
    """Largest tolerance of times, in seconds."""
    max_offset_s = 1e12
    """Largest offset of a clock, in seconds."""


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig, as the file has it.

    Attributes:
        name: of the camera.
        recording: where its recording is.
        T_rig_camera: float64 [4, 4].
        time_offset: seconds that are added to its times.
        scale: of its images, besides that of all.
        options: arguments of `open_sequence` for its recording.
    """

    name: str
    recording: Path
    T_rig_camera: np.ndarray
    time_offset: float
    scale: float | None
    options: dict[str, Any]


@dataclass(frozen=True)
class RigFile:
    """What a file rig.yaml says: its cameras, and how many seconds apart images are that count as taken together."""

    path: Path
    cameras: tuple[RigCamera, ...]
    tolerance: float


def find_rig_file(path: Path) -> Path | None:
    """The file of the rig at a path: itself, or that in the folder; None if there is none.

    A YAML file is one of a rig if it has an entry `cameras`, or is named itself and called rig.yaml.
    """
    file = path / FILE if os.path.isdir(path) else path  # noqa: PTH112 (Path's raises for impossible names)
    if file.suffix.lower() not in (".yaml", ".yml") or not os.path.isfile(file):  # noqa: PTH113
        return None
    if file is path and file.name == FILE:
        return file
    try:
        return file if re.search(r"^cameras\s*:", read_text(file), re.MULTILINE) else None
    except SequenceError:
        return None


def read_rig_file(path: Path) -> RigFile:
    """Reads the file of a rig.

    Raises:
        SequenceError: it is no YAML, or an entry is missing, unknown, there twice or impossible, or two cameras
            have one recording.
    """
    try:
        content, repeated = parse_yaml(text := read_text(path)), repeated_key(text)
    except PlainYamlError as error:
        raise SequenceError(f"{path}: not YAML: {error}") from None
    if repeated is not None:
        raise SequenceError(f"{path}, line {repeated[1]}: '{repeated[0]}' is given twice")
    entries = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(content, dict) or not isinstance(entries, list) or not entries:
        raise SequenceError(f"{path}: expected an entry 'cameras' with a list of cameras")
    _refuse_unknown(str(path), content, ("cameras", "tolerance"))
    tolerance = number_entry(path, content, "tolerance") if "tolerance" in content else PairingTuning.tolerance_s
    if not 0 < tolerance <= RigFileTuning.max_tolerance_s:
        raise SequenceError(f"{path}: expected 'tolerance' above 0 and at most 10 seconds, found {tolerance:g}")
    cameras: list[RigCamera] = []
    for number, entry in enumerate(entries, start=1):
        camera = _camera(path, number, entry)
        if camera.name in [other.name for other in cameras]:
            raise SequenceError(f"{path}: camera '{camera.name}' is there twice")
        twin = next((other for other in cameras if _takes_the_same(other, camera)), None)
        if twin is not None:
            names = f"cameras '{twin.name}' and '{camera.name}'"
            raise SequenceError(f"{path}: {names} have one recording: {entry['recording']}")
        cameras.append(camera)
    if len(cameras) < 2:
        raise SequenceError(f"{path}: a rig has two cameras or more, found '{cameras[0].name}' alone")
    return RigFile(path, tuple(cameras), tolerance)


def _takes_the_same(a: RigCamera, b: RigCamera) -> bool:
    """Whether two cameras are given the same images; a bag has those of several."""
    return os.path.realpath(a.recording) == os.path.realpath(b.recording) and (
        a.options.get("topics") == b.options.get("topics")
    )


def _camera(path: Path, number: int, entry: Any) -> RigCamera:
    place = f"{path}: camera {number}"
    if not isinstance(entry, dict):
        raise SequenceError(f"{place}: expected entries name, recording, T_rig_camera, found '{entry}'")
    name = entry.get("name")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise SequenceError(f"{place}: expected a 'name' of letters, digits, '_', '-' and '.', found '{name}'")
    place = f"{path}: camera '{name}'"
    _refuse_unknown(place, entry, _KEYS)
    recording = entry.get("recording")
    if not isinstance(recording, str) or not recording:
        raise SequenceError(f"{place}: expected 'recording' to name a folder or file, found '{recording}'")
    return RigCamera(
        name, path.parent / given_path(recording, where=place), transform_entry(place, entry, "T_rig_camera"),
        _number(place, entry, "time_offset", -RigFileTuning.max_offset_s, RigFileTuning.max_offset_s) or 0.0,
        _number(place, entry, "scale", 1e-3, 1.0), _options(path, place, entry),
    )  # fmt: skip


def _options(path: Path, place: str, entry: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `open_sequence`."""
    options: dict[str, Any] = {}
    for key in (*_PATHS, *_TEXTS):
        if key in entry:
            if not isinstance(entry[key], str):
                raise SequenceError(f"{place}: expected a text for '{key}', found '{entry[key]}'")
            options[key] = path.parent / given_path(entry[key], where=place) if key in _PATHS else entry[key]
    if "depth_scale" in entry:
        options["depth_scale"] = _number(place, entry, "depth_scale", 0.0, np.inf)
    if "upright" in entry:
        if not isinstance(entry["upright"], bool):
            raise SequenceError(f"{place}: expected 'upright' to be true or false, found '{entry['upright']}'")
        options["upright"] = entry["upright"]
    if "void_id" in entry:
        options["void_id"] = int(_number(place, entry, "void_id", 1, 2**24 - 1) or 0)
    if "min_confidence" in entry:
        options["min_confidence"] = entry["min_confidence"]
    if "topics" in entry:
        options["topics"] = tuple(_list(place, entry, "topics", str, "texts ROLE=TOPIC"))
    if "intrinsics" in entry:
        numbers = _list(place, entry, "intrinsics", (int, float), "numbers fx, fy, cx, cy")
        options["intrinsics"] = " ".join(map(str, numbers))
    return options


def _list(place: str, entry: dict[str, Any], key: str, kind: Any, words: str) -> list[Any]:
    values = entry[key]
    if not isinstance(values, list) or not all(isinstance(v, kind) and not isinstance(v, bool) for v in values):
        raise SequenceError(f"{place}: expected '{key}' to be a list of {words}, found '{values}'")
    return values


def _number(place: str, entry: dict[str, Any], key: str, least: float, most: float) -> float | None:
    """A number within bounds; None without one."""
    value = entry.get(key)
    if key not in entry:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
        raise SequenceError(f"{place}: expected '{key}' to be a number from {least:g} to {most:g}, found '{value}'")
    return float(value)


def _refuse_unknown(place: str, entry: dict[Any, Any], known: tuple[str, ...]) -> None:
    unknown = [str(key) for key in entry if key not in known]
    if unknown:
        near = difflib.get_close_matches(unknown[0], known, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"
        raise SequenceError(f"{place}: unknown entry '{unknown[0]}'; {hint}")
