# SPDX-License-Identifier: Apache-2.0
"""Reading a camera file, whoever wrote it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ggslam.errors import SequenceError
from ggslam.sequences.camera_files.json_cameras import from_json
from ggslam.sequences.camera_files.text_cameras import from_text
from ggslam.sequences.camera_files.yaml_cameras import from_yaml, parse_camera_yaml
from ggslam.sequences.json_files import parse_object
from ggslam.sequences.recording import read_text

OWN = ("fx", "fy", "cx", "cy")
BESIDE = ("depth_scale", "T_color_depth", "color")
"""Entries of ours that somebody may have added to another program's file."""
_ENTRY = re.compile(r"^\s*[\w.]+\s*:(?:\s|$)", re.MULTILINE)
"""A line of YAML with a name; `#` begins a comment there as in tables."""


def read_entries(path: Path) -> dict[str, Any]:
    """Entries as a camera.yaml has them (see `calibration`) of a file that ggslam, OpenCV, ORB-SLAM, ROS, RTAB-Map,
    Kalibr, Open3D or COLMAP wrote, or of K.txt. Entries that it does not tell are lacking: the size in K.txt.

    Raises:
        SequenceError: missing, damaged, without entries, of several cameras, or of one that cannot be used.
    """
    text = read_text(path)
    if text.lstrip().startswith("{"):
        return from_json(path, parse_object(path, text))
    if path.suffix.lower() not in (".yaml", ".yml") and not _ENTRY.search(text):
        return from_text(path, text)
    settings = parse_camera_yaml(path, text)
    if not isinstance(settings, dict):
        found = "none" if settings is None else f"'{str(settings)[:40]}'"
        raise SequenceError(f"{path}: expected entries width, height, fx, fy, cx, cy, depth_scale, found {found}")
    if any(name in settings for name in OWN):
        return settings
    from_other_program = from_yaml(path, settings)
    if from_other_program is None:
        return settings
    return from_other_program | {key: settings[key] for key in BESIDE if key in settings}
