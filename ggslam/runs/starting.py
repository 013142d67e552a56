# SPDX-License-Identifier: Apache-2.0
"""Starts a run in the map of an earlier run instead of an empty one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ggslam.errors import ConfigError, FormatError, RunFolderError, SequenceError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, make_keyframe
from ggslam.objects.table import Observation
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import fingerprint, open_recording_of
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.result import LearnedObjects
from ggslam.slam.saved_places import KEYFRAME_CAMERAS, PLACES_FILE
from ggslam.slam.slam import Slam
from ggslam.system.array_forms import Form, PoseForm, check_arrays
from ggslam.system.images import PictureLimits
from ggslam.tracking.settings import DepthNoise

_NEEDED = "to grow its map, the images of its keyframes are needed"
_INSTEAD = "`localize_only` does without its images"


class OtherImagesError(Exception):
    """The map was made with images of another size."""


def camera_of(row: np.ndarray) -> Camera:
    """The camera of a row of places.npz. Raises FormatError if it is none, or has more pixels than images may have."""
    check_arrays({"camera": row}, {"camera": Form("float", 6, finite=True)}, "places")
    if not (row[:2] >= 1).all() or row[0] * row[1] > PictureLimits.max_pixels or not (row[2:4] > 0).all():
        raise FormatError(f"places: 'camera': impossible: {row.tolist()}")
    return Camera(int(row[0]), int(row[1]), *(float(value) for value in row[2:]))


def start_in_map(slam: Slam, folder: RunFolder, growing: bool) -> None:
    """Makes a fresh `Slam` start in the map of a run: lost, until a frame shows a known place.

    Args:
        slam: no frame was tracked yet.
        folder: of the run.
        growing: whether the map is to grow; needs the recording it was made from.

    Raises:
        RunFolderError: the run has no places, or its files do not belong together.
    """
    path = folder.path / PLACES_FILE
    if not path.is_file():
        raise RunFolderError(f"{path}: missing: the run was made without loops, or its map was edited since")
    if slam.loops is None:
        raise ConfigError("`map`: to start in a map, loops.enabled must not be off")
    arrays: dict[str, Any] = read_all_arrays(path, "the places of a run")
    try:
        gaussians, keyframes = _load(slam, slam.loops, folder, arrays)
    except OtherImagesError as error:
        raise ConfigError(f"{folder.path}: {error}; see `scale`") from None
    except (KeyError, ValueError, IndexError, TypeError, RuntimeError, ConfigError, FormatError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else error
        raise RunFolderError(f"{path}: not the places of this run: {reason}") from None
    objects = _objects(folder, gaussians)
    if growing:
        keyframes = _with_images(folder, keyframes, objects is not None and objects.supervision == "masks")
    slam.growing = growing
    slam.load_map(gaussians, keyframes, objects)


def _load(
    slam: Slam, loops: LoopCloser, folder: RunFolder, arrays: dict[str, Any]
) -> tuple[GaussianMap, list[Keyframe]]:
    """Fills surface and loops; gives the map and its keyframes without images."""
    gaussians, birth, poses = folder.gaussians(with_moments=True), arrays["birth"], arrays["keyframe_poses"]
    forms = {
        "keyframe_poses": PoseForm("float", "n"), "birth": Form("int", len(gaussians)),
        "noise": Form("float", 2, finite=True),
    }  # fmt: skip
    if KEYFRAME_CAMERAS in arrays:
        forms[KEYFRAME_CAMERAS] = Form("float", "n", 6, finite=True)
    check_arrays(arrays, forms, "places")
    if birth.max(initial=-1) >= len(poses) or birth.min(initial=0) < -1:
        raise ValueError(f"birth: expected keyframes up to {len(poses) - 1}, found {birth.min()} to {birth.max()}")
    camera, (constant, square) = camera_of(arrays["camera"]), arrays["noise"].tolist()
    if (camera.width, camera.height) != (slam.camera.width, slam.camera.height):
        raise OtherImagesError(
            f"it was made with images of {camera.width}x{camera.height}, these are "
            f"{slam.camera.width}x{slam.camera.height}"
        )
    gaussians.birth_keyframe[:] = torch.from_numpy(birth.astype(np.int32))
    slam.use_scale(scale_of(arrays))
    slam.surface.load(arrays_with_prefix(arrays, "surface_"))
    loops.load(arrays_with_prefix(arrays, "loops_"))
    if len(loops.poses) != len(poses) or not np.isfinite(np.array(loops.poses)).all():
        raise ValueError(f"expected numbers for the poses of {len(poses)} keyframes")
    slam.tracker.noise = DepthNoise(constant, square)
    cameras = [slam.camera] * len(poses)
    if KEYFRAME_CAMERAS in arrays:
        cameras = [camera_of(row) for row in arrays[KEYFRAME_CAMERAS]]
    return gaussians, [_bare_keyframe(k, T, cameras[k]) for k, T in enumerate(poses)]


def scale_of(arrays: dict[str, Any]) -> float:
    """Size of the scene; runs of before it was measured lack it."""
    scale = float(np.asarray(arrays.get("scale", 1.0)).item())
    if not 1e-3 <= scale <= 1e3:
        raise ValueError(f"scale: expected 0.001 to 1000, found {scale:g}")
    return scale


def _objects(folder: RunFolder, gaussians: GaussianMap) -> LearnedObjects | None:
    """The objects of a run; its Gaussians get their votes."""
    if not folder.has_objects():
        return None
    segmented = folder.segmented_map()
    if segmented.votes is not None:
        slots = segmented.votes.ids.shape[1]
        gaussians.vote_ids[:, :slots] = torch.from_numpy(segmented.votes.ids.astype(np.int32))
        gaussians.vote_weights[:, :slots] = torch.from_numpy(segmented.votes.weights)
    seen = {
        o.id: Observation(o.first_frame, o.last_frame, o.views)
        for o in segmented.table.objects
        if o.first_frame is not None and o.last_frame is not None
    }
    return LearnedObjects(segmented.classifier, segmented.table.supervision, seen)


def _bare_keyframe(number: int, T_world_camera: np.ndarray, camera: Camera) -> Keyframe:
    """A keyframe of another recording: its pose alone."""
    color, depth = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.uint16)
    return Keyframe(number, FROM_EARLIER_RUN, float("nan"), camera, color, depth, inverse(T_world_camera))


def _with_images(
    folder: RunFolder, keyframes: list[Keyframe], with_masks: bool, later: Sequence[Path] = ()
) -> list[Keyframe]:
    """The same keyframes with their images, read again from the recordings they came from.

    Raises:
        RunFolderError: a recording is not there any more, or a run began with its own map (`later`: runs that began
            with this one's).
    """
    if folder.path.resolve() in later:
        raise RunFolderError(f"{folder.path}: states that it started from its own map")
    if folder.sequence().map is not None:
        earlier = parent(folder)
        first = len(earlier.keyframes().keyframes)
        later = [*later, folder.path.resolve()]
        keyframes = _with_images(earlier, keyframes[:first], with_masks, later) + keyframes[first:]
    else:
        first = 0
    records = folder.keyframes().keyframes[first:]
    try:
        sequence = open_recording_of(folder)
    except SequenceError as error:
        raise RunFolderError(f"{folder.path}: {_NEEDED} ({error}); {_INSTEAD}") from None
    out = keyframes[:first]
    for keyframe, record in zip(keyframes[first:], records, strict=True):
        frame = sequence.frame(record.frame, masks=with_masks)
        made = make_keyframe(keyframe.index, frame, keyframe.T_world_camera)
        made.exposure = record.known_exposure
        out.append(replace(made, frame_index=FROM_EARLIER_RUN, iterations=record.iterations, instant=None))
    return out


def parent(folder: RunFolder) -> RunFolder:
    """The run whose map a run began with.

    Args:
        folder: of the run.

    Raises:
        RunFolderError: it is not there any more, or is another one now.
    """
    record = folder.sequence()
    if record.map is None:
        raise RunFolderError(f"{folder.path}: did not begin with the map of another run")
    path = Path(record.map)
    try:
        earlier = RunFolder.open(path)
    except RunFolderError as error:
        raise RunFolderError(f"{folder.path} began with the map of another run: {error}; {_INSTEAD}") from None
    if fingerprint(earlier) != record.map_fingerprint:
        raise RunFolderError(
            f"{path}: not the run any more whose map {folder.path} began with (it was made anew); {_INSTEAD}"
        )
    return earlier


def ancestors(folder: RunFolder) -> list[Path]:
    """Folders of the runs that a run's map comes from, its own first."""
    paths = [folder.path.resolve()]
    while (earlier := RunFolder(paths[-1]).sequence().map) is not None:
        if Path(earlier).resolve() in paths or not Path(earlier).is_dir():
            break
        paths.append(Path(earlier).resolve())
    return paths


def arrays_with_prefix(arrays: Mapping[str, Any], prefix: str) -> dict[str, np.ndarray]:
    """Those whose name begins so, by the rest of their names."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
