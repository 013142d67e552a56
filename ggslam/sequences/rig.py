# SPDX-License-Identifier: Apache-2.0
"""Reads the recordings of a rig's cameras as one: instant by instant, and at each instant the frames of its cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, SupportsIndex, TypeVar

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.scene.rig import Rig
from ggslam.sequences.recording import FrameFiles, select
from ggslam.sequences.rig_file import RigCamera, RigFile, find_rig_file, read_rig_file
from ggslam.sequences.rig_times import find_instants, gaps
from ggslam.sequences.sequence import OnBadFrame, ReadMasks, Sequence, SkippedFrame
from ggslam.system.tuning import Tuning

T = TypeVar("T")

NAME = "rig"
"""Of the format."""
LAYOUT = "rig.yaml: cameras, each with a recording of any format and T_rig_camera"


class RigTuning(Tuning):
    """When true poses of two cameras are in one world."""

    near_m = 0.25
    """Largest distance between a camera's true pose and its place in rig.yaml, in metres."""
    near_deg = 10.0
    """Largest rotation between them, in degrees."""


@dataclass(frozen=True)
class RigPart:
    """A camera of a rig with its recording; `time_offset` seconds are added to its times."""

    name: str
    sequence: Sequence
    time_offset: float

    @property
    def times(self) -> np.ndarray:
        """Of its frames by the rig's clock, float64 [n], seconds."""
        return self.sequence.timestamps + self.time_offset


class RigSequence(Sequence):
    """The recordings of a rig as one. `Frame.index` counts the frames of all cameras, those of one instant behind one
    another; `Frame.instant` and `Frame.camera_number` say whose they are; `Frame.camera`, `Frame.source_index` are of
    the camera's own recording. What a recording has one of (`camera`, `scale`, ...) is the first camera's.

    Args:
        path: of the rig's file.
        rig: the cameras.
        parts: their recordings, in the same order.
        instants: number of each camera's frame at each instant, int [instants, cameras], -1 where it has none.
        tolerance: seconds between images that were taken together.

    Attributes:
        rig, parts, instants, tolerance: the same.
        places: (instant, camera number) of each frame, int64 [n, 2].
    """

    def __init__(
        self, path: Path, rig: Rig, parts: list[RigPart], instants: np.ndarray, tolerance: float
    ) -> None:
        own = {"_recording", "_masks", "_geometry", "mask_problems"}
        vars(self).update({name: value for name, value in vars(parts[0].sequence).items() if name not in own})
        self.rig, self.parts, self.instants, self.tolerance = rig, parts, instants, tolerance
        self.path, self.format = path, NAME
        self.name = path.parent.resolve().name if path.stem == NAME else path.stem
        self._reopen, self.options, self._skipped = None, None, {}
        self._earlier_problems: dict[int, str] = {}
        self.selected = range(len(instants))
        """Numbers of the instants in all of the recordings."""
        self.warnings = [f"{part.name}: {warning}" for part in parts for warning in part.sequence.warnings]
        self.has_masks = any(part.sequence.has_masks for part in parts)
        self.instance_names = {
            i: name for part in reversed(parts) for i, name in part.sequence.instance_names.items()
        }
        self._take(instants)

    def _take(self, instants: np.ndarray) -> None:
        """Chooses the instants."""
        self.instants = instants
        self.places = np.argwhere(instants >= 0)
        self._selection = range(len(self.places))
        own = [(self.parts[camera], instants[instant, camera]) for instant, camera in self.places]
        self.timestamps = np.array([part.times[number] for part, number in own], float)
        self.ground_truth = self._true_poses()

    @property
    def selection(self) -> range:
        """Numbers of the instants among all of the recordings."""
        return self.selected

    def __getitem__(self, index: SupportsIndex | slice) -> Frame | Sequence:  # type: ignore[override]
        """See `Sequence`; there are no slices.

        Raises:
            SequenceError: a slice was asked for.
        """
        if isinstance(index, slice):
            raise SequenceError(f"{self.path}: the recordings of a rig have no slices; choose instants by `start`, ...")
        return super().__getitem__(index)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)

    @property
    def mask_problems(self) -> dict[int, str]:  # type: ignore[override]
        """See `Sequence`."""
        found = dict(self._earlier_problems)
        for number, part in enumerate(self.parts):
            frames = {int(self.instants[self.places[i, 0], number]): i for i in self.frames_of(number).tolist()}
            of_part = part.sequence.mask_problems.items()
            found.update({frames[own]: reason for own, reason in of_part if own in frames})
        return found

    def go_on_after(self, skipped: Iterable[SkippedFrame], mask_problems: Mapping[int, str]) -> None:
        """See `Sequence`."""
        super().go_on_after(skipped, {})
        self._earlier_problems.update(mask_problems)

    def place_of(self, index: int) -> tuple[int, int]:
        """Instant and camera number of a frame.

        Raises:
            SequenceError: no such frame.
        """
        if not 0 <= index < len(self):
            raise SequenceError(f"{self.path}: expected a frame from 0 to {len(self) - 1}, found {index}")
        instant, camera = self.places[index].tolist()
        return instant, camera

    def frames_of(self, number: int) -> np.ndarray:
        """Indices of the frames of a camera, int64 [n]."""
        return np.flatnonzero(self.places[:, 1] == number)

    def _own(self, index: int) -> tuple[RigPart, int]:
        """The recording of a frame, and its number there."""
        instant, camera = self.place_of(index)
        return self.parts[camera], int(self.instants[instant, camera])

    def files(self, index: int) -> FrameFiles:
        """See `Sequence`."""
        part, number = self._own(index)
        return part.sequence.files(number)

    def mask_kinds(self) -> Counter[str]:
        """See `Sequence`."""
        return sum((part.sequence.mask_kinds() for part in self.parts), Counter())

    def frame(self, index: int, masks: ReadMasks = True) -> Frame:
        """See `Sequence`."""
        part, number = self._own(index)
        instant, camera = self.place_of(index)
        pose = None if self.ground_truth is None else self.ground_truth[index]
        return replace(
            part.sequence.frame(number, masks), index=index, timestamp=float(self.timestamps[index]), instant=instant,
            camera_number=camera,
            T_world_camera=pose.copy() if pose is not None and np.isfinite(pose).all() else None,
        )  # fmt: skip

    def _attempt(self, index: int, masks: ReadMasks) -> Frame | SkippedFrame:
        part, number = self._own(index)
        try:
            return self.frame(index, masks)
        except SequenceError as error:
            if part.sequence._on_bad_frame == "error":
                raise
            return SkippedFrame(index, part.sequence.selection[number], f"{part.name}: {error}")

    def _true_poses(self) -> np.ndarray | None:
        """T_world_camera of all frames, NaN where unknown; None without any. Where recordings tell poses in different
        worlds, those of the first one that tells any hold for the others, too."""
        known = [k for k, part in enumerate(self.parts) if part.sequence.ground_truth is not None]
        if not known:
            return None
        each = np.full((*self.instants.shape, 4, 4), np.nan)
        for k in known:
            truth = self.parts[k].sequence.ground_truth
            there = self.instants[:, k] >= 0
            assert truth is not None
            each[there, k] = truth[self.instants[there, k]]
        first = known[0]
        for k in range(len(self.parts)):
            if k in known and (k == first or self._is_of_one_world(each, first, k)):
                continue
            T_first_k = inverse(self.rig.T_first_camera[first]) @ self.rig.T_first_camera[k]
            each[:, k] = each[:, first] @ T_first_k
        return each[self.instants >= 0]

    def _is_of_one_world(self, each: np.ndarray, a: int, b: int) -> bool:
        """Whether true poses [instants, cameras, 4, 4] have two cameras where rig.yaml has them; nothing speaks against
        it if they are never known together."""
        both = np.isfinite(each[:, [a, b]]).all((1, 2, 3))
        if not both.any():
            return True
        T_first_b = self.rig.T_first_camera[a] @ inverse(each[both, a]) @ each[both, b]
        apart = [separation(T, self.rig.T_first_camera[b]) for T in T_first_b]
        shift, turn = np.median(np.array(apart), axis=0)
        return bool(shift < RigTuning.near_m and turn < RigTuning.near_deg)


def one_camera(sequence: Sequence, what: str) -> Sequence:
    """The same sequence, which is not of a rig.

    Args:
        sequence: a recording.
        what: takes one camera's recording only, in words.

    Raises:
        SequenceError: it is of a rig.
    """
    if isinstance(sequence, RigSequence):
        places = ", ".join(str(part.sequence.path) for part in sequence.parts)
        raise SequenceError(f"{sequence.path}: is a rig, and {what} takes the recording of one camera: {places}")
    return sequence


def by_instant(frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    """The frames of a recording, in order: those of one instant of a rig together, others at once and alone."""
    return together_by_instant(frames, lambda frame: frame)


def together_by_instant(items: Iterable[T], frame_of: Callable[[T], Frame]) -> Iterator[list[T]]:
    """The same of things that each have a frame."""
    together: list[T] = []
    for item in items:
        instant = frame_of(item).instant
        if together and instant != frame_of(together[0]).instant:
            yield together
            together = []
        together.append(item)
        if instant is None:
            yield together
            together = []
    if together:
        yield together


def open_rig(
    path: Path, open_one: Callable[..., Sequence], *, start: int = 0, stop: int | None = None, stride: int = 1,
    scale: float | None = None, on_bad_frame: OnBadFrame = "error",
) -> RigSequence:  # fmt: skip
    """Opens the recordings of a rig.

    Args:
        path: of the rig's file.
        open_one: `open_sequence`.
        start, stop, stride: instants start, start + stride, ... below stop.
        scale: of all images, times that of each camera; 1: as their recordings come by themselves.
        on_bad_frame: as of `open_sequence`.

    Raises:
        SequenceError: the file or a recording cannot be read, or two cameras took no images together.
    """
    file = read_rig_file(path)
    parts = [RigPart(c.name, _open_part(file, c, open_one, scale, on_bad_frame), c.time_offset) for c in file.cameras]
    instants = find_instants([part.times for part in parts], file.tolerance)
    _check_common(file, parts, instants)
    T_first_rig = inverse(orthonormalize(file.cameras[0].T_rig_camera))
    T_first_camera = np.stack([T_first_rig @ orthonormalize(c.T_rig_camera) for c in file.cameras])
    T_first_camera[0] = np.eye(4)
    cameras = tuple(part.sequence.camera for part in parts)
    rig = Rig(tuple(part.name for part in parts), cameras, T_first_camera)
    sequence = RigSequence(path, rig, parts, instants, file.tolerance)
    sequence.scale = 1.0 if scale is None else scale
    _select(sequence, start, stop, stride)
    return sequence


def _open_part(
    file: RigFile, camera: RigCamera, open_one: Callable[..., Sequence], scale: float | None, on_bad_frame: OnBadFrame
) -> Sequence:
    if find_rig_file(camera.recording) is not None:  # before it is opened: it may name itself
        raise SequenceError(f"{file.path}: camera '{camera.name}': {camera.recording} is a rig itself")
    own, times = camera.scale, 1.0 if scale is None else scale
    wanted = own * times if own is not None else times if times != 1 else None
    try:
        return open_one(camera.recording, scale=wanted, on_bad_frame=on_bad_frame, **camera.options)
    except SequenceError as error:
        raise SequenceError(f"{file.path}: camera '{camera.name}': {error}") from None


def _check_common(file: RigFile, parts: list[RigPart], instants: np.ndarray) -> None:
    """Raises SequenceError if a camera took no image together with any other."""
    seen = instants >= 0
    for k, part in enumerate(parts):
        if not (seen[:, k] & (seen.sum(1) > 1)).any():
            other = parts[1 if k == 0 else 0]
            spans = [f"'{p.name}' {p.times.min():.3f} to {p.times.max():.3f} s" for p in (part, other)]
            raise SequenceError(
                f"{file.path}: no image of '{part.name}' was taken within {file.tolerance:g} s of one of another "
                f"camera ({', '.join(spans)}); see 'tolerance' and 'time_offset' there"
            )


def _select(sequence: RigSequence, start: int, stop: int | None, stride: int) -> None:
    """Chooses instants as `open_sequence` chooses frames."""
    sequence.selected = select(sequence.path, len(sequence.instants), start, stop, stride)
    sequence._take(sequence.instants[sequence.selected.start : sequence.selected.stop : stride])


def camera_gaps(sequence: RigSequence) -> np.ndarray:
    """See `rig_times.gaps`, of the chosen instants."""
    return gaps([part.times for part in sequence.parts], sequence.instants)
