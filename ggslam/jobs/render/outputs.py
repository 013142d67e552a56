# SPDX-License-Identifier: Apache-2.0
"""Pictures and films that may lie in a run's folder, or in a folder of it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from ggslam.runs.folder import MARKER
from ggslam.runs.publishing import change_files, change_in_run
from ggslam.system.atomic import make_folder


def write_beside(*files: Path) -> AbstractContextManager[None]:
    """Files of one folder, which is made, are written within the block; a run that they lie in keeps account of them.

    Raises:
        RunFolderError: the folder cannot be made, or another process writes to the run.
    """
    folder = files[0].parent
    make_folder(folder)
    if (folder / MARKER).is_file():
        return change_files(folder, [file.name for file in files])
    return change_in_run(folder)
