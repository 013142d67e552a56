# SPDX-License-Identifier: Apache-2.0
"""Cameras in YAML: ORB-SLAM and its kin, OpenCV's FileStorage, ROS, RTAB-Map, Kalibr and EuRoC."""

from __future__ import annotations

import re
from typing import Any

from ggslam.errors import SequenceError
from ggslam.sequences.camera_files.lens_models import FISHEYE_NAMES
from ggslam.sequences.camera_files.matrices import intrinsics_of_matrix, matrix_numbers
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml

Entries = dict[str, Any]

MATRIX_NAMES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k")
"""Of the colour image as stored. A projection matrix is that of the rectified image, and not taken."""
DISTORTION_NAMES = (
    "distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "distortion_coeffs", "D", "d",
)  # fmt: skip
ORB_CAMERAS = ("Camera", "Camera1")
_OPENCV_DIRECTIVE = re.compile(r"\A%YAML:[0-9.]+[^\n]*\n")
_OPENCV_TAG = re.compile(r"!!opencv-[\w-]+")


def parse_camera_yaml(place: object, text: str) -> Any:
    """Content of YAML as the standard or as OpenCV's FileStorage has it (`%YAML:1.0`, `!!opencv-matrix`), or as ROS
    prints a message (`---` at its end). Raises SequenceError if it is none."""
    text = _OPENCV_TAG.sub("", _OPENCV_DIRECTIVE.sub("", text))
    text = re.sub(r"(?:\n(?:---|\.\.\.)[ \t]*)+\s*\Z", "\n", text)
    try:
        return parse_yaml(text)
    except PlainYamlError as error:
        raise SequenceError(f"{place}: not YAML: {error}") from None


def from_yaml(place: object, settings: Entries) -> Entries | None:
    """Entries of a camera.yaml for the camera that another program's YAML holds; None: it is no such.

    Raises:
        SequenceError: it holds several cameras, or a model that cannot be used.
    """
    chain = {key: value for key, value in settings.items() if re.fullmatch(r"cam\d+", str(key))}
    if chain:
        if len(chain) > 1:
            raise SequenceError(f"{place}: holds {', '.join(chain)}; keep only the right camera in the file")
        [(name, camera)] = chain.items()
        return _of_kalibr(f"{place}, {name}", camera if isinstance(camera, dict) else {})
    if isinstance(settings.get("intrinsics"), list):
        return _of_kalibr(str(place), settings)
    flat = _with_inner_names(settings)
    orb = next((name for name in ORB_CAMERAS if f"{name}.fx" in flat), None)
    if orb is not None:
        return _of_orb(flat, orb)
    found = next((name for name in MATRIX_NAMES if name in settings), None)
    return None if found is None else _of_matrix(place, settings, found)


def _with_inner_names(settings: Entries) -> Entries:
    """`Camera: {fx: ...}` as `Camera.fx`, too."""
    inner = {
        f"{key}.{name}": value for key, held in settings.items() if isinstance(held, dict)
        for name, value in held.items()
    }  # fmt: skip
    return {**settings, **inner}


def _of_orb(flat: Entries, name: str) -> Entries:
    """ORB-SLAM2 and 3 (`Camera.fx`, `Camera1.fx`), OpenVSLAM and stella (`Camera: {fx: ...}`)."""
    found = {key: flat[f"{name}.{key}"] for key in ("fx", "fy", "cx", "cy") if f"{name}.{key}" in flat}
    for key, other in (("width", "cols"), ("height", "rows")):
        value = next((flat[f"Camera.{n}"] for n in (key, other) if f"Camera.{n}" in flat), None)
        found |= {} if value is None else {key: value}
    model = str(next((flat[f"Camera.{key}"] for key in ("type", "model") if f"Camera.{key}" in flat), "pinhole"))
    if model.lower() == "rectified":
        model = "opencv"
    fisheye = model.lower() in FISHEYE_NAMES
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values = [flat.get(f"{name}.{key}", 0.0) for key in names]
    found |= {"distortion": values if fisheye or any(values[5:]) else values[:5], "distortion_model": model}
    scale = next((flat[key] for key in ("RGBD.DepthMapFactor", "DepthMapFactor", "Camera.depthmap_factor",
                                        "depthmap_factor") if key in flat), None)  # fmt: skip
    rate = flat.get("Camera.fps")
    found |= {"frame_rate": rate} if isinstance(rate, (int, float)) and rate > 0 else {}
    return found if scale is None else {**found, "depth_scale": scale}


def _of_matrix(place: object, settings: Entries, name: str) -> Entries:
    """OpenCV's FileStorage, ROS's calibration files and printed camera_info, and RTAB-Map."""
    found: Entries = dict(intrinsics_of_matrix(f"{place}, {name}", matrix_numbers(f"{place}, {name}", settings[name])))
    for key in ("width", "height"):
        value = next((settings[n] for n in (f"image_{key}", f"image_{key.capitalize()}", key) if n in settings), None)
        found |= {} if value is None else {key: value}
    _refuse_part(place, settings)
    coefficients = next((n for n in DISTORTION_NAMES if settings.get(n) is not None), None)
    fisheye = bool(settings.get("fisheye_model"))
    found["distortion_model"] = str(settings.get("distortion_model", "fisheye" if fisheye else "opencv"))
    if coefficients is not None:
        numbers = matrix_numbers(f"{place}, {coefficients}", settings[coefficients])
        found["distortion"] = numbers.tolist()
    return found | ({"local_transform": settings["local_transform"]} if "local_transform" in settings else {})


def _refuse_part(place: object, settings: Entries) -> None:
    """Of a printed camera_info: K is that of the whole sensor, not of the part of it that the images show."""
    roi = settings.get("roi")
    cut = isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset", "width", "height"))
    binned = any(isinstance(settings.get(key), int) and settings[key] > 1 for key in ("binning_x", "binning_y"))
    if cut or binned:
        raise SequenceError(f"{place}: is for cropped or binned images (roi, binning_x), which is not supported")


def _of_kalibr(place: str, camera: Entries) -> Entries:
    """One camera of Kalibr's camchain.yaml, or EuRoC's sensor.yaml."""
    model = str(camera.get("camera_model", "pinhole"))
    if model != "pinhole":
        raise SequenceError(f"{place}: the camera model '{model}' is not supported; known is pinhole")
    numbers = matrix_numbers(f"{place}, intrinsics", camera.get("intrinsics", []))
    if numbers.size != 4:
        raise SequenceError(f"{place}: expected 'intrinsics' to be fx fy cx cy, found {numbers.size} numbers")
    found: Entries = dict(zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True))
    size = camera.get("resolution")
    if isinstance(size, list) and len(size) == 2:
        found |= {"width": size[0], "height": size[1]}
    coefficients = next((name for name in DISTORTION_NAMES if camera.get(name) is not None), None)
    lens = str(camera.get("distortion_model", "opencv"))
    values = [] if coefficients is None else matrix_numbers(f"{place}, {coefficients}", camera[coefficients]).tolist()
    return found | {"distortion": values, "distortion_model": lens}
