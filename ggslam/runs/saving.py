# SPDX-License-Identifier: Apache-2.0
"""Saves a run made frame by frame from Python as a run folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from ggslam.errors import RunFolderError
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe
from ggslam.scene.camera import Camera
from ggslam.sequences import Sequence
from ggslam.slam.result import SlamResult

NO_RECORDING = "python:frames"
"""Stands in sequence.json for the recording of a run whose frames came from a program."""


@dataclass
class _Frames:
    """Frames given by a program, described like a recording."""

    camera: Camera
    count: int
    format: str = "python"
    warnings: list[str] = field(default_factory=list)
    skipped_frames: list[Any] = field(default_factory=list)
    mask_problems: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.count


def save_run(
    result: SlamResult, folder: str | Path, sequence: Sequence | None = None, *, overwrite: bool = False
) -> RunFolder:
    """Writes a finished run as a run folder, which `ggslam eval`, `view`, `export` and the others take.

    Args:
        result: of `Slam.finish`.
        folder: where to; made if it is not there.
        sequence: the recording that the frames came from, so that scores and meshes can read it again; None: the
            frames are not kept anywhere.
        overwrite: replace a run that is there.

    Returns:
        The run.

    Raises:
        RunFolderError: nothing was mapped; the folder holds something else or a run, or cannot be written to.
    """
    if not result.keyframes or result.config is None:
        raise RunFolderError(f"{folder}: the run has no keyframe, so there is no map to save")
    if sequence is None:
        request = SequenceRequest(Path(NO_RECORDING), scale=1.0)
        described = describe(request, cast(Sequence, _Frames(result.keyframes[0].camera, len(result.frames))))
    else:
        described = describe(request_of(sequence), sequence)
    out = RunFolder.create(Path(folder), overwrite)
    names = None if sequence is None else sequence.instance_names
    out.save(result.config, described, result, names=names)
    return out


def request_of(sequence: Sequence) -> SequenceRequest:
    """How a sequence that `open_sequence` made is opened again.

    Raises:
        RunFolderError: it was made otherwise.
    """
    if sequence.options is None or not len(sequence):
        raise RunFolderError(f"{sequence.path}: expected a sequence with frames that open_sequence made")
    chosen = sequence.selection
    return SequenceRequest(
        **{**sequence.options, "start": chosen[0], "stop": chosen[-1] + 1, "stride": chosen.step}
    )  # fmt: skip
