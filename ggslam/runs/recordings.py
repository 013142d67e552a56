# SPDX-License-Identifier: Apache-2.0
"""The recording of a run, and how to open it again later."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError, FormatError, RunFolderError, SequenceError
from ggslam.middleware.opening import NodeRequest
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.sequence import OpenRecord, PartRecord, SequenceRecord
from ggslam.scene.arrays import read_all_arrays
from ggslam.sequences import Sequence, open_sequence
from ggslam.sequences.joined import JoinedPart, JoinedSequence
from ggslam.sequences.live import LiveSequence, is_live, open_live
from ggslam.sequences.moving_pixels import MOVERS_FILE, MovingPixels
from ggslam.sequences.rig import RigSequence
from ggslam.system.json_files import json_ready
from ggslam.system.untrusted_files import given_path, read_untrusted


@dataclass(frozen=True)
class SequenceRequest:
    """Which part of which recording, and how to read it; see `open_sequence`."""

    path: Path
    format: str | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    scale: float | None = None
    masks: Path | None = None
    depth_scale: float | None = None
    on_bad_frame: str = "error"
    depth_camera: Path | None = None
    min_confidence: int | None = None
    topics: tuple[str, ...] = ()
    pose_convention: str | None = None
    camera: Path | None = None
    intrinsics: str | None = None
    depth_kind: str | None = None
    depth_delay: str | None = None
    upright: bool = False
    void_id: int | None = None

    @classmethod
    def of(cls, path: str | Path, selection: Mapping[str, Any], caller: str) -> SequenceRequest:
        """A request by arguments of `open_sequence`.

        Args:
            path: of the recording.
            selection: the arguments.
            caller: name of the function that was called with them, for its errors.

        Raises:
            ConfigError: `open_sequence` has no such argument.
        """
        paths = ("masks", "depth_camera", "camera")
        given: dict[str, Any] = {k: Path(v) if k in paths and v is not None else v for k, v in selection.items()}
        try:
            return cls(given_path(path, ConfigError), **given)
        except TypeError:
            raise ConfigError(f"{caller}: no such argument of open_sequence in {', '.join(given)}") from None

    def open(self, truth: bool = True) -> Sequence:
        """Opens the recording; `truth`: with its true poses.

        Raises:
            SequenceError: it cannot be read.
            MissingDependency: a package is needed to read it.
        """
        return open_sequence(
            self.path, format=self.format, start=self.start, stop=self.stop, stride=self.stride, scale=self.scale,
            masks=self.masks, depth_scale=self.depth_scale, on_bad_frame=self.on_bad_frame,  # type: ignore[arg-type]
            depth_camera=self.depth_camera, min_confidence=self.min_confidence, topics=self.topics,
            pose_convention=self.pose_convention, camera=self.camera, intrinsics=self.intrinsics, truth=truth,
            depth_kind=self.depth_kind, depth_delay=self.depth_delay, upright=self.upright, void_id=self.void_id,
        )  # fmt: skip


@dataclass(frozen=True)
class LiveRequest(SequenceRequest):
    """A live camera as the recording of a run; `record`: folder that its frames are kept in."""

    record: Path | None = None

    def join(self, node: NodeRequest) -> LiveRequest:
        """The same over a network: addresses of ROS 2 topics are completed by it."""
        from ggslam.sequences.formats.ros2_address import SCHEME, add_network

        ros2 = str(self.path).startswith(f"{SCHEME}:")
        return replace(self, path=add_network(self.path, node)) if ros2 else self

    def open(self, truth: bool = True) -> LiveSequence:  # type: ignore[override]
        """Starts the camera; what comes back has what a run needs of a sequence.

        Raises:
            SequenceError: it cannot be started, or options are for recordings only.
            MissingDependency: a package is needed for it.
        """
        plain = SequenceRequest(self.path, stop=self.stop, scale=self.scale, on_bad_frame=self.on_bad_frame)
        if replace(self, record=None) != LiveRequest(**asdict(plain)):
            raise SequenceError(f"{self.path}: of a live camera only `stop` and `scale` can be chosen")
        source = open_live(str(self.path), 1.0 if self.scale is None else self.scale)
        return LiveSequence(source, self.stop, self.record)


def describe(
    request: SequenceRequest, sequence: Sequence | LiveSequence, earlier: RunFolder | None = None
) -> SequenceRecord:
    """What `sequence.json` holds: how to open the recording again, its camera, and the run whose map this one began
    with, if any."""
    values = asdict(request)
    values.pop("record", None)
    values["scale"] = sequence.scale if isinstance(sequence, Sequence) else values["scale"] or 1.0
    if isinstance(sequence, LiveSequence):  # what was recorded is a plain folder, scaled already
        values |= {"path": sequence.path if sequence.record else request.path, "scale": 1.0, "stop": None}
    for name in ("path", "masks", "depth_camera", "camera"):
        if values[name] is not None and not is_live(values[name]):
            values[name] = Path(values[name]).absolute()
    rig = {"rig": describe_rig(sequence)} if isinstance(sequence, RigSequence) else {}
    return SequenceRecord.of({
        "open": values, "format": sequence.format, "camera": asdict(sequence.camera), "frames": len(sequence),
        "warnings": sequence.warnings, "skipped": [asdict(skipped) for skipped in sequence.skipped_frames],
        "mask_problems": sequence.mask_problems, "map": None if earlier is None else earlier.path.absolute(),
        "map_fingerprint": None if earlier is None else fingerprint(earlier), **rig,
    })  # fmt: skip


def describe_rig(sequence: RigSequence) -> dict[str, Any]:
    """What sequence.json holds of a rig."""
    ranges = []
    for number in range(len(sequence.rig)):
        at = sequence.places[sequence.frames_of(number), 0]
        breaks = np.flatnonzero(np.diff(at) != 1) + 1
        ranges.append([(int(run[0]), int(run[-1]) + 1) for run in np.split(at, breaks) if len(run)])
    rig = sequence.rig
    return {
        "names": list(rig.names), "cameras": [asdict(camera) for camera in rig.cameras],
        "T_first_camera": rig.T_first_camera, "tolerance": sequence.tolerance, "instants": ranges,
    }  # fmt: skip


def identity_of(sequence: Sequence) -> dict[str, Any]:
    """Tells a recording from another one, wherever it lies: plain values for a record."""
    times = hashlib.sha256(np.ascontiguousarray(sequence.timestamps).tobytes()).hexdigest()
    rig = {"rig": describe_rig(sequence)} if isinstance(sequence, RigSequence) else {}
    file = sequence.path.stat().st_size if sequence.path.is_file() and not rig else None
    return json_ready({
        "format": sequence.format, "frames": len(sequence), "camera": asdict(sequence.camera), "times": times,
        "file_size": file, "masks": sequence.has_masks, **rig,
    })  # fmt: skip


def fingerprint(folder: RunFolder) -> str:
    """Tells a run from another one in the same folder."""
    return hashlib.sha256(read_untrusted(folder.path / "keyframes.json", error=RunFolderError)).hexdigest()


def request_in(record: OpenRecord, path: Path | None = None, masks: Path | None = None) -> SequenceRequest:
    """What a record says of how a recording is opened, with another place of recording or masks if one is given."""
    used = masks if masks is not None else record.masks
    return SequenceRequest(**{
        **record.model_dump(), "path": Path(path if path is not None else record.path),
        "masks": None if used is None else Path(used), "topics": tuple(record.topics),
        "depth_camera": None if record.depth_camera is None else Path(record.depth_camera),
        "camera": None if record.camera is None else Path(record.camera),
    })  # fmt: skip


def open_recording_of(
    folder: RunFolder, path: Path | None = None, masks: Path | None = None, scale: float | None = None
) -> Sequence:
    """Opens the recording of a run again, as the run did; of a merged run all its recordings as one. Frames come
    without what the run found to move.

    Args:
        folder: of the run.
        path: where the recording is now, if it was moved.
        masks: folder of masks to use instead of those that the run had.
        scale: of the images; None: the run's.

    Raises:
        SequenceError: it is not there any more.
        RunFolderError: the run does not say which it was.
    """
    return open_recorded(folder.sequence(), str(folder.path), path, masks, scale)


def read_moving(folder: Path) -> MovingPixels | None:
    """What a run found to move in its frames; None: nothing.

    Raises:
        RunFolderError: the file is damaged.
    """
    path = folder / MOVERS_FILE
    if not path.is_file():
        return None
    try:
        return MovingPixels.from_arrays(read_all_arrays(path, "what moves in a recording"))
    except FormatError as error:
        raise RunFolderError(f"{path}: cannot be read: {str(error).removeprefix(f'{path}: ')}") from None


def open_recorded(
    record: SequenceRecord, run: str, path: Path | None = None, masks: Path | None = None, scale: float | None = None
) -> Sequence:
    """The same by the record alone; `run` is the folder whose it is."""
    sequence = _open_again(record, run, path, masks, scale)
    sequence.moving = read_moving(Path(run))
    return sequence


def _open_again(
    record: SequenceRecord, run: str, path: Path | None, masks: Path | None, scale: float | None
) -> Sequence:
    if record.parts is None:
        return _open_as(run, record, path, masks, scale)
    if len({part.open.path for part in record.parts}) > 1 and (path is not None or masks is not None):
        what = "`sequence`" if path is not None else "`masks`"
        raise RunFolderError(f"{run}: was merged from runs of several recordings; {what} cannot be all of them")
    return JoinedSequence([_open_part(run, part, path, masks, scale) for part in record.parts])


def _open_part(
    run: str, part: PartRecord, path: Path | None, masks: Path | None, scale: float | None
) -> JoinedPart:
    sequence = _open_as(run, part, path, masks, scale)
    T = np.eye(4) if part.T_joint_truth is None else part.T_joint_truth
    return JoinedPart(sequence, part.time_shift_s, T, None if masks is not None else part.mask_ids)


def _open_as(
    run: str, record: SequenceRecord | PartRecord, path: Path | None, masks: Path | None, scale: float | None
) -> Sequence:
    """A recording as a record says, with another place of recording or masks, or at another scale."""
    request = request_in(record.open, path, masks)
    if is_live(request.path):
        raise RunFolderError(f"{run}: was run live ({request.path}), and its frames were not kept (`record`)")
    sequence = replace(request, scale=request.scale if scale is None else scale).open()
    if sequence.finer and scale is None and sequence.camera.width != record.camera.width:  # of an older version
        own = sequence.scale * record.camera.width / sequence.camera.width
        sequence = replace(request, scale=own).open()
    if isinstance(sequence, RigSequence):
        found = {name: value for name, value in describe_rig(sequence).items() if name != "cameras" or scale is None}
        expected = {} if record.rig is None else {name: record.rig.values().get(name) for name in found}
    else:
        camera = sequence.camera if scale is None else sequence.default_camera(record.open.scale)
        found = {"frames": len(sequence), "camera": asdict(camera)}
        expected = {"frames": record.frames, "camera": asdict(record.camera)}
    found = json_ready(found)
    if found != expected:
        if isinstance(sequence, RigSequence):  # the rest would be a screenful
            other = {name for name in found if found[name] != expected.get(name)}
            raise RunFolderError(f"{sequence.path}: not the rig of {run}: other {', '.join(sorted(other))}")
        raise RunFolderError(f"{sequence.path}: not the recording of {run}: expected {expected}, found {found}")
    return sequence
