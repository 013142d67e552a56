# SPDX-License-Identifier: Apache-2.0
"""Starting in the map of an earlier run instead of an empty one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ggslam.errors import FormatError, RunFolderError, SequenceError
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.objects.table import Observation
from ggslam.recordings import open_recording_of
from ggslam.run_folder import RunFolder
from ggslam.saved_places import FILE
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.slam import Slam
from ggslam.slam_result import LearnedObjects
from ggslam.tracking.settings import DepthNoise

ELSEWHERE = -1
"""Frame number of keyframes that are of another recording than the run's."""


def _camera(row: np.ndarray) -> Camera:
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
    path = folder.path / FILE
    if not path.is_file():
        raise RunFolderError(f"{path}: missing; only runs with loops.enabled can be started in")
    arrays: dict[str, Any] = read_all_arrays(path, "the places of a run")
    if slam.loops is None:
        raise RunFolderError(f"{folder.path}: to start in a map, loops.enabled must not be off")
    try:
        gaussians = folder.gaussians(with_moments=True)
        if len(gaussians) != len(arrays["birth"]):
            raise RunFolderError(
                f"{path}: expected {len(gaussians)} Gaussians as in map.ply, found {len(arrays['birth'])}"
            )
        gaussians.birth_keyframe[:] = torch.from_numpy(arrays["birth"])
        slam.surface.load(_part(arrays, "surface_"))
        slam.loops.load(_part(arrays, "loops_"), _camera(arrays["camera"]))
        poses = arrays["keyframe_poses"]
    except (KeyError, ValueError, IndexError, FormatError) as error:
        raise RunFolderError(f"{path}: not the places of a run: {error}") from None
    slam.tracker.noise = DepthNoise(*(float(value) for value in arrays["noise"]))
    keyframes = [_bare_keyframe(k, T, slam.camera) for k, T in enumerate(poses)]
    objects = _objects(folder, gaussians)
    if growing:
        keyframes = _with_images(folder, keyframes, objects is not None and objects.supervision == "masks")
    slam.growing = growing
    slam.adopt(gaussians, keyframes, objects)


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
    return Keyframe(number, ELSEWHERE, float("nan"), camera, color, depth, inverse(T_world_camera))


def _with_images(folder: RunFolder, keyframes: list[Keyframe], with_masks: bool) -> list[Keyframe]:
    """The same keyframes with their images, read again from the recordings they came from.

    Raises:
        RunFolderError: a recording is not there any more.
    """
    first = 0
    if (earlier := folder.read_json("sequence.json").get("map")) is not None:
        parent = RunFolder.open(Path(earlier))
        first = len(parent.read_json("keyframes.json")["keyframes"])
        keyframes = _with_images(parent, keyframes[:first], with_masks) + keyframes[first:]
    records = folder.read_json("keyframes.json")["keyframes"][first:]
    try:
        sequence = open_recording_of(folder)
    except SequenceError as error:
        raise RunFolderError(
            f"{folder.path}: to grow its map, the images of its keyframes are needed ({error}); --localize-only does "
            "without"
        ) from None
    out = keyframes[:first]
    for keyframe, record in zip(keyframes[first:], records, strict=True):
        frame = sequence.frame(record["frame"], masks=with_masks)
        made = make_keyframe(keyframe.index, frame, keyframe.T_world_camera)
        out.append(replace(made, frame_index=ELSEWHERE, iterations=record["iterations"]))
    return out


def _part(arrays: dict[str, Any], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
