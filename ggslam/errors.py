# SPDX-License-Identifier: Apache-2.0
"""The exception tree of ggslam. Messages name the file or frame, what was expected and what was found."""

from __future__ import annotations

import re
from pathlib import Path

_MARK = r"\d+-[0-9a-f]{8}(?![0-9a-f])"
"""Number of a process and eight digits: how hidden names end that ggslam gives to what is not done yet."""
_BEGIN = r"(?<![^/\s'\"(=])"
"""Nothing before it but a folder."""
_TO_DELETE = r"(?!: (?:is|holds) a link)"
"""Not of a message that asks people to look at the hidden name itself."""

_NOISE = (
    (re.compile(r"\[Errno -?\d+\] "), ""),
    (re.compile(rf"(?<=/)\.staged-{_MARK}/"), ""),
    (re.compile(rf"/\.staged-{_MARK}(?!/){_TO_DELETE}"), ""),
    (re.compile(rf"{_BEGIN}\.index-{_MARK}"), "index.sqlite"),
    (re.compile(rf"{_BEGIN}\.([^/\n]+?)-coming-{_MARK}{_TO_DELETE}(?:/[^\s:'\"]*)?"), r"\1"),
    (re.compile(rf"{_BEGIN}\.([^/\n]+?)\.{_MARK}{_TO_DELETE}"), r"\1"),
)
"""What tells people nothing: numbers of the operating system's errors, and hidden files and folders that are written
to before they take their places; what they are to become is named instead."""


def plain(text: str) -> str:
    """A message without what only the program needs to know."""
    for pattern, instead in _NOISE:
        text = pattern.sub(instead, text)
    return text


class GgslamError(Exception):
    """Base of every error that ggslam raises on purpose. The command line prints it and exits with `exit_code`."""

    exit_code = 2
    """2: the user's input is at fault; 1: ggslam or the machine is, or most frames were lost."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(plain(arg) if isinstance(arg, str) else arg for arg in args))


class SequenceError(GgslamError):
    """A recording cannot be read: folder not recognised, file missing or damaged, sizes that do not agree."""


class ConfigError(GgslamError):
    """A setting is unknown or has an impossible value."""


class AnotherKindError(GgslamError):
    """A file or folder is there, but is not of the kind that was asked for.

    Attributes:
        path: of it.
        wanted: the kind.
    """

    wanted = "input"

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = Path(str(path))


class NotARecordingError(AnotherKindError, SequenceError):
    """A recording was asked for."""

    wanted = "recording"


class TrackingLostError(GgslamError):
    """Most frames of a recording have no pose: the run was saved, but is no result."""

    exit_code = 1


class InputError(GgslamError, ValueError):
    """An argument of a Python call has a type, a shape or a value that cannot be."""


class VoxelError(InputError):
    """Voxels are too small for the depth that a view shows."""


class FormatError(GgslamError):
    """A file (PLY, trajectory, run folder...) does not follow its format."""


class NoPointsError(FormatError):
    """A cloud is whole, but has no points, or none with a position."""


class RunFolderError(GgslamError):
    """A run folder cannot be written or lacks a part that was asked for."""


class NotARunError(AnotherKindError, RunFolderError):
    """A run was asked for."""

    wanted = "run"


class NotABatchError(AnotherKindError, ConfigError):
    """The manifest of a batch or a folder of recordings was asked for."""

    wanted = "batch"


class NotACloudError(AnotherKindError, FormatError):
    """A point cloud was asked for."""

    wanted = "cloud"


class NotAStreamError(AnotherKindError, FormatError):
    """A coded stream was asked for."""

    wanted = "stream"


class RenderError(GgslamError):
    """The renderer was given arrays of wrong shape or type, or a backend that is not available."""


class DeviceError(RenderError):
    """The GPU reports an error, or its memory is full."""

    exit_code = 1


class MemoryFullError(GgslamError, MemoryError):
    """Memory is full: a fault of the machine, or of what else runs on it, not of the file that did not fit."""

    exit_code = 1


class OpenCvError(GgslamError):
    """OpenCV refused an image on the way through ggslam: a fault of ggslam, which should have looked at it before."""

    exit_code = 1


class MiddlewareError(GgslamError):
    """A message, topic or service of the network is not what it should be, or nobody answers."""


class MissingDependency(GgslamError):
    """An optional package or file is needed for what was asked; the message says how to get it."""


class NativeCoreError(GgslamError):
    """The compiled core is missing, does not fit this version of the Python code, or failed."""

    exit_code = 1


class CoreMemoryError(NativeCoreError, MemoryError):
    """Memory ran out in the compiled core."""


class CoreInputError(InputError):
    """The compiled core was given a size, a number or an array that cannot be."""
