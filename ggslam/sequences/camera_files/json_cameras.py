# SPDX-License-Identifier: Apache-2.0
"""Cameras in JSON: Open3D, Replica's cam_params.json, and objects with fx, fy, cx, cy (RealSense: ppx, ppy)."""

from __future__ import annotations

from typing import Any

from ggslam.sequences.camera_files.matrices import intrinsics_of_matrix, matrix_numbers

Entries = dict[str, Any]

KEPT = ("depth_scale", "T_color_depth", "color", "distortion", "distortion_model")
RENAMED = {"w": "width", "h": "height", "ppx": "cx", "ppy": "cy", "coeffs": "distortion", "model": "distortion_model",
           "scale": "depth_scale"}  # fmt: skip


def from_json(place: object, content: Entries) -> Entries:
    """Entries of a camera.yaml for the camera of a JSON object; those that it lacks are lacking.

    Raises:
        SequenceError: a matrix in it is no camera's.
    """
    inner: Entries = next((content[key] for key in ("intrinsic", "camera") if isinstance(content.get(key), dict)), {})
    values = {RENAMED.get(key, key): value for key, value in {**content, **inner}.items()}
    if "intrinsic_matrix" not in values:
        return values
    name = f"{place}, intrinsic_matrix"
    found: Entries = dict(intrinsics_of_matrix(name, matrix_numbers(name, values["intrinsic_matrix"])))
    return found | {key: values[key] for key in ("width", "height", *KEPT) if key in values}
