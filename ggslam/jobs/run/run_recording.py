# SPDX-License-Identifier: Apache-2.0
"""A whole run in one call."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ggslam.errors import ConfigError
from ggslam.jobs.progress import Observer
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.saving import request_of
from ggslam.sequences import Sequence


def run_recording(
    recording: str | Path | Sequence,
    out: str | Path | None = None,
    *,
    config: str | Path | None = None,
    overrides: Iterable[str] = (),
    map: str | Path | None = None,
    localize_only: bool = False,
    evaluate: bool = True,
    overwrite: bool = False,
    check: bool = True,
    energy: bool = False,
    observer: Observer | None = None,
    **selection: Any,
) -> RunOutcome:
    """Runs a recording into a run folder, as `ggslam run` does.

    Args:
        recording: folder or file of the recording, or a sequence that `open_sequence` made.
        out: the run folder; None: runs/ and the recording's name.
        config: a preset's name, or a YAML file; None: the defaults.
        overrides: settings as "name.of.setting=value".
        map: an earlier run to start in, whose map grows.
        localize_only: only find the frames in the map of `map`, which stays as it is.
        evaluate: score the run.
        overwrite: replace a run that is there.
        check: look at the recording's depth first, and refuse what is certainly wrong with it.
        energy: count what each part of the run uses, into timing.json.
        observer: receives progress updates; see `ggslam.jobs.progress.Observer`.
        selection: start, stop, stride, scale and the other arguments of `open_sequence`, of a recording named by path.

    Returns:
        `folder`, `result` and `metrics` of the run; `error` if it stopped early and was saved as far as it came.

    Raises:
        GgslamError: nothing could be done at all: settings, recording or output folder at fault.
    """
    if isinstance(recording, Sequence):
        if selection:
            raise ConfigError(f"run_recording: choose {', '.join(selection)} when the sequence is opened")
        sequence = request_of(recording)
    else:
        sequence = SequenceRequest.of(recording, selection, "run_recording")
    request = RunRequest(
        sequence, None if out is None else Path(out), None if config is None else str(config), list(overrides),
        evaluate, overwrite, None if map is None else Path(map), localize_only, check=check,
        energy=energy,
    )  # fmt: skip
    return execute(request, observer)
