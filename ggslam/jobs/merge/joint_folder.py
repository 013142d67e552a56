# SPDX-License-Identifier: Apache-2.0
"""Reads several runs and starts the folder of the merged run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from collections.abc import Sequence as ListOf
from contextlib import contextmanager
from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.jobs.merge.clock import Clock
from ggslam.jobs.merge.sources import MergeSource, read_sources
from ggslam.native.loader import NativeContext
from ggslam.runs.folder import RunFolder
from ggslam.system.folder_lock import folder_lock


@contextmanager
def joint_folder(
    runs: ListOf[str | Path], out: str | Path, overwrite: bool, context: NativeContext, clock: Clock, what: str
) -> Iterator[tuple[list[MergeSource], RunFolder]]:
    """What the runs hold, and the locked folder of the run to be made; it goes if that fails.

    Args:
        runs: folders, or containers of runs (`map.ggz`), which stay unpacked within the block.
        out: folder of the run to be made.
        overwrite: replace a run that is already there.
        context: threads.
        clock: what reading took is counted as "read".
        what: becomes of the runs, for errors.

    Raises:
        ConfigError: `out` is one of the runs, or a run is given twice.
        RunFolderError: a run is damaged or has no places, or `out` cannot be made.
    """
    out = Path(out)
    if any(out.resolve() in (Path(run).resolve(), *Path(run).resolve().parents) for run in runs):
        raise ConfigError(f"`out` {out}: is one of the runs that are {what}, or holds it; choose another folder")
    with tempfile.TemporaryDirectory(prefix="ggslam-merge-") as unpacked:
        sources = read_sources([Path(run) for run in runs], context, Path(unpacked))
        clock.lap("read")
        folder = RunFolder.create(out, overwrite)
        try:
            with folder_lock(folder.path):
                yield sources, folder
        except BaseException:
            folder.discard()
            raise
