# SPDX-License-Identifier: Apache-2.0
"""Opens a recording: recognises its format and selects a part of it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path

from ggslam.errors import NotARecordingError, SequenceError
from ggslam.sequences.calibration import use_depth_camera
from ggslam.sequences.depth_delay import delay_depth
from ggslam.sequences.depth_kind import PLAIN, DepthKind, read_depth_kind
from ggslam.sequences.formats.folder import FolderFormat, SyntheticFormat
from ggslam.sequences.formats.icl_nuim import IclNuimFormat
from ggslam.sequences.formats.polycam import PolycamFormat
from ggslam.sequences.formats.realsense import RealSenseFormat
from ggslam.sequences.formats.record3d import Record3DFormat
from ggslam.sequences.formats.replica import ReplicaFormat
from ggslam.sequences.formats.ros_bag import Ros1Format, Ros2Format
from ggslam.sequences.formats.ros_topics import ROLES
from ggslam.sequences.formats.rtabmap import RtabmapFormat
from ggslam.sequences.formats.scanner_app import ScannerAppFormat
from ggslam.sequences.formats.scannet import ScanNetFormat
from ggslam.sequences.formats.scannetpp import ScanNetPlusFormat
from ggslam.sequences.formats.seven_scenes import SevenScenesFormat
from ggslam.sequences.formats.stray import StrayFormat
from ggslam.sequences.formats.transforms_json import TransformsFormat
from ggslam.sequences.formats.tum import TumFormat
from ggslam.sequences.formats.vmap import VmapFormat
from ggslam.sequences.live import is_live
from ggslam.sequences.masks import find_masks
from ggslam.sequences.own_camera import read_own_camera, use_own_camera
from ggslam.sequences.pose_conventions import convert_poses
from ggslam.sequences.recording import ReadOptions, Recording, RecordingFormat, select
from ggslam.sequences.rig import LAYOUT as RIG_LAYOUT
from ggslam.sequences.rig import NAME as RIG
from ggslam.sequences.rig import open_rig
from ggslam.sequences.rig_file import find_rig_file
from ggslam.sequences.sequence import OnBadFrame, Sequence
from ggslam.system.missing_paths import why_missing
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import given_path, refuse_links

FORMATS: tuple[RecordingFormat, ...] = (
    SyntheticFormat(),
    FolderFormat(),
    ReplicaFormat(),
    VmapFormat(),
    TumFormat(),
    IclNuimFormat(),
    SevenScenesFormat(),
    ScanNetFormat(),
    ScanNetPlusFormat(),
    TransformsFormat(),
    Record3DFormat(),
    PolycamFormat(),
    StrayFormat(),
    ScannerAppFormat(),
    RtabmapFormat(),
    RealSenseFormat(),
    Ros1Format(),
    Ros2Format(),
)
"""Known formats in the order in which they are tried."""


class DepthScaleTuning(Tuning):
    """A limit on units of depth."""

    min_scale = 1e-6
    """Smallest depth scale, in units per metre; the largest is its reciprocal. float32 holds both."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """How images are stored, as given by the user; see the arguments of `open_sequence` of these names."""

    depth_kind: DepthKind = PLAIN
    depth_delay: str | None = None
    upright: bool = False
    void_id: int | None = None


def open_sequence(
    path: str | Path,
    *,
    format: str | None = None,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    scale: float | None = None,
    masks: str | Path | None = None,
    depth_scale: float | None = None,
    on_bad_frame: OnBadFrame = "error",
    depth_camera: str | Path | None = None,
    min_confidence: int | None = None,
    topics: Iterable[str] = (),
    pose_convention: str | None = None,
    camera: str | Path | None = None,
    intrinsics: str | None = None,
    truth: bool = True,
    depth_kind: str | None = None,
    depth_delay: str | None = None,
    upright: bool = False,
    void_id: int | None = None,
) -> Sequence:
    """Opens an RGB-D recording.

    Args:
        path: folder or file of the recording; rig.yaml, or its folder, for the recordings of a rig (see `rig`).
        format: name of a format in `FORMATS`, or "rig"; None: recognised from the folder or file.
        start, stop, stride: frames start, start + stride, ... below stop (None: to the end). A stop past the end means
            the end.
        scale: of the delivered images to those that come by default: the stored ones, or of colour much finer than
            depth (phones) 640x480 pixels of it; above 0, and at most what gives the stored size.
        masks: folder of instance masks to use instead of the recording's own; see `masks.find_masks`.
        depth_scale: depth units per metre, instead of the recording's own.
        on_bad_frame: "error": a damaged frame or mask raises; "skip": `stream` skips the frame and lists it in
            `skipped_frames`; a frame whose mask alone is damaged comes without it and is listed in `mask_problems`.
        depth_camera: file with the calibration of a depth camera beside the colour camera (see `calibration`); its
            depth images are registered to the colour images.
        min_confidence: depth less sure than this (0 low, 1 medium, 2 high) is dropped where the recording tells how
            sure it is; None: `RecordingTuning.confidence`.
        topics: of a ROS bag, "role=topic" each, where they are not found by themselves; see `ros_topics`.
        pose_convention: what the recording's poses really are, if not what its format says; see `pose_conventions`.
        camera: file with the calibration of the colour camera, instead of the recording's own (see `calibration` and
            `camera_files`).
        intrinsics: the same as "fx fy cx cy", then up to 8 coefficients of distortion, of colour images as stored.
        truth: whether the recording's true poses are read. They are never needed: what is wrong with them is a warning.
        depth_kind: what the numbers of depth images mean: words of `depth_kind.WORDS` with commas between; None: z.
        depth_delay: by how much depth was taken after the colour that it is stored beside, as "1f" (frames), "-1f" or
            "33ms": pairs colour with the depth of its own time; see `depth_delay`.
        upright: turn colour images as their orientation tag (EXIF) says; the calibration is that of the turned images.
        void_id: id of masks that means "unlabelled", besides 0.

    Raises:
        MissingDependency: a package is needed to read the recording.
        SequenceError: the recording cannot be read; the message names the file, what was expected and what was found.
    """
    topics = tuple(topics)
    rig = find_rig_file(given_path(path)) if format in (None, RIG) else None
    if rig is not None:
        of_cameras = {
            "masks": masks, "depth_scale": depth_scale, "depth_camera": depth_camera, "min_confidence": min_confidence,
            "topics": topics or None, "pose_convention": pose_convention, "camera": camera, "intrinsics": intrinsics,
            "depth_kind": depth_kind, "depth_delay": depth_delay, "upright": upright or None, "void_id": void_id,
        }  # fmt: skip
        return _open_rig(given_path(path), rig, (start, stop, stride), scale, on_bad_frame, truth, of_cameras)
    if format == RIG:
        raise SequenceError(f"{path}: expected {RIG_LAYOUT}")
    read = partial(
        _read_recording, given_path(path), format, None if masks is None else given_path(masks),
        dataclasses.replace(
            _options(depth_camera, min_confidence, topics, camera, intrinsics, depth_scale), truth=truth
        ), pose_convention,
        Stored(read_depth_kind(depth_kind), depth_delay, upright, void_id),
    )  # fmt: skip
    recording = read()
    selection = select(recording.path, len(recording.files), start, stop, stride)
    sequence = Sequence(recording, selection, scale=scale, on_bad_frame=on_bad_frame, reopen=read)
    sequence.options = {
        "path": given_path(path), "format": format, "scale": sequence.scale,
        "masks": None if masks is None else given_path(masks), "depth_scale": depth_scale,
        "on_bad_frame": on_bad_frame, "depth_camera": None if depth_camera is None else given_path(depth_camera),
        "min_confidence": min_confidence, "topics": topics, "pose_convention": pose_convention,
        "camera": None if camera is None else given_path(camera), "intrinsics": intrinsics,
        "depth_kind": depth_kind, "depth_delay": depth_delay, "upright": upright, "void_id": void_id,
    }  # fmt: skip
    return sequence


def _open_rig(
    path: Path, file: Path, selected: tuple[int, int | None, int], scale: float | None, on_bad_frame: OnBadFrame,
    truth: bool, of_cameras: Mapping[str, object],
) -> Sequence:  # fmt: skip
    """A rig; `of_cameras` are arguments that hold for one camera alone."""
    given = [name for name, value in of_cameras.items() if value is not None]
    if given:
        raise SequenceError(
            f"{file}: `{given[0]}` holds for one camera; set it in the rig's file, as `{given[0]}` there"
        )
    start, stop, stride = selected
    read = partial(open_sequence, truth=truth)
    sequence = open_rig(file, read, start=start, stop=stop, stride=stride, scale=scale, on_bad_frame=on_bad_frame)
    sequence.options = {
        "path": path, "format": RIG, "scale": sequence.scale, "on_bad_frame": on_bad_frame,
    }  # fmt: skip
    return sequence


def _read_recording(
    folder: Path, format: str | None, masks: Path | None, options: ReadOptions, pose_convention: str | None,
    stored: Stored,
) -> Recording:  # fmt: skip
    """Reads a recording's description and applies the user's options; arguments and errors as in `open_sequence`."""
    _check_kind(folder)
    found = _find_format(folder, format)
    if folder.is_dir():
        refuse_links(folder, SequenceError, links=True)  # people share images between recordings by links
    try:
        recording = found.read(folder, options)
    except OSError as error:  # a name that no file can have, a folder that may not be read
        raise SequenceError(f"{str(error.filename or folder)[:200]}: {error.strerror or error}") from None
    if not recording.files:
        raise SequenceError(f"{folder}: holds no frames")
    _check_places(recording)
    if options.depth_camera is not None:
        use_depth_camera(recording, options.depth_camera)
    if options.own_camera is not None:
        use_own_camera(recording, options.own_camera, options.depth_scale is not None)
    if options.min_confidence is not None:
        recording.min_confidence = options.min_confidence
    if masks is not None:
        _use_masks(recording, masks)
    if options.depth_scale is not None:
        recording.depth_scale = options.depth_scale
    if pose_convention is not None:
        if recording.poses is not None:
            recording.poses = convert_poses(recording.poses, pose_convention)
        elif options.truth and not recording.pose_problem:
            raise SequenceError(f"{folder}: has no poses to convert from {pose_convention}")
    recording.depth_kind, recording.upright = stored.depth_kind, stored.upright
    recording.void_id = stored.void_id
    if stored.depth_delay is not None:
        delay_depth(recording, stored.depth_delay)
    low, high = DepthScaleTuning.min_scale, 1 / DepthScaleTuning.min_scale
    if not low <= recording.depth_scale <= high:
        raise SequenceError(f"{folder}: depth scale must be {low:g} to {high:g}, found {recording.depth_scale}")
    return recording


def _check_kind(path: Path) -> None:
    """Raises SequenceError unless there is a folder or a regular file."""
    if os.path.exists(path):  # noqa: PTH110 (Path's raises for impossible names)
        if not os.path.isfile(path) and not os.path.isdir(path):  # noqa: PTH112, PTH113
            raise SequenceError(f"{path}: is neither a folder nor a regular file (a pipe, a socket or a device?)")
        return
    if is_live(path):
        raise SequenceError(
            f"{path}: is a live camera, which `ggslam run` and `ggslam volumes --live` take; the former with --record "
            "FOLDER keeps what it shows"
        )
    raise SequenceError(f"{path}: {why_missing(path)}")


def _check_places(recording: Recording) -> None:
    """Raises SequenceError if a recording names a file outside its folder: it may come from somebody who wants to know
    what is there."""
    root = recording.path if recording.path.is_dir() else recording.path.parent
    inside: dict[Path, bool] = {}
    for entry in recording.files:
        for path in (entry.color, entry.depth, entry.mask, entry.confidence):
            if not isinstance(path, Path):
                continue
            if path.parent not in inside:
                inside[path.parent] = Path(os.path.normpath(path.parent)).is_relative_to(os.path.normpath(root))
            if not inside[path.parent]:
                raise SequenceError(
                    f"{path}: lies outside the recording {root}; copy it there, or give the folder that holds both"
                )


def _use_masks(recording: Recording, folder: Path) -> None:
    """Takes the masks of another folder; names of the recording's own ids would be wrong for them."""
    found = find_masks(folder, [entry.color for entry in recording.files])
    if any(mask is not None and mask != entry.mask for mask, entry in zip(found, recording.files, strict=True)):
        recording.instance_names = {}
    pairs = zip(recording.files, found, strict=True)
    recording.files = [dataclasses.replace(entry, mask=mask) for entry, mask in pairs]


def _options(
    depth_camera: str | Path | None, min_confidence: int | None, topics: Iterable[str], camera: str | Path | None,
    intrinsics: str | None, depth_scale: float | None,
) -> ReadOptions:  # fmt: skip
    if min_confidence is not None and min_confidence not in (0, 1, 2):
        raise SequenceError(f"min_confidence: expected 0, 1 or 2, found {min_confidence}")
    by_role = {}
    for text in topics:
        role, _, topic = text.partition("=")
        if role not in ROLES or not topic:
            raise SequenceError(f"topic: expected ROLE=TOPIC with a role of {', '.join(ROLES)}, found '{text}'")
        by_role[role] = topic
    own = read_own_camera(None if camera is None else given_path(camera), intrinsics)
    beside = None if depth_camera is None else given_path(depth_camera)
    return ReadOptions(beside, by_role, min_confidence, own, depth_scale)


def recognise_format(path: str | Path) -> str | None:
    """Name of the format of a folder or file, None when it is none of the known ones."""
    place = Path(path)
    if find_rig_file(place) is not None:
        return RIG
    found = _matching_format(place) if os.path.exists(place) else None  # noqa: PTH110
    return None if found is None else found.name


def _matching_format(place: Path) -> RecordingFormat | None:
    plain = FolderFormat()
    found = next((f for f in FORMATS if f.matches(place)), None)
    return plain if found is None and plain.lacks_camera_only(place) else found


def _find_format(folder: Path, name: str | None) -> RecordingFormat:
    if name is not None:
        named = next((f for f in FORMATS if f.name == name), None)
        if named is None:
            raise SequenceError(f"unknown format '{name}'; known: {', '.join([*(f.name for f in FORMATS), RIG])}")
        return named
    recognised = _matching_format(folder)
    if recognised is None:
        looked_for = "\n".join([*(f"  {f.name}: {f.layout}" for f in FORMATS), f"  {RIG}: {RIG_LAYOUT}"])
        if folder.is_file():
            reason = f"expected a recording, found a file that is none. Looked for:\n{looked_for}"
            raise NotARecordingError(folder, reason)
        holds = f"not a known recording; it holds {_contents(folder)}. Looked for:\n{looked_for}"
        raise NotARecordingError(folder, holds)
    return recognised


def _contents(folder: Path, shown: int = 8) -> str:
    names = sorted(p.name + ("/" if p.is_dir() else "") for p in folder.iterdir())
    if not names:
        return "nothing"
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more
