# SPDX-License-Identifier: Apache-2.0
"""Files of a run that stay as they are in one made of it: copied within limits, for a run may be from elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.runs.writing import TRAJECTORIES
from ggslam.system.untrusted_files import FileTuning, copy_untrusted, copy_untrusted_folder

_TEXT = (".txt", ".json", ".yaml", ".csv")


def copy_files(run: Path, staged: Path, names: Iterable[str], renders: bool = False) -> None:
    """Copies files of a run that are there, and its trajectories.

    Args:
        run: its folder.
        staged: a folder to copy to.
        names: of the files.
        renders: its renders, too.

    Raises:
        RunFolderError: a file is larger than a run has it, no regular file, or a link in a folder; names it.
        OSError: it cannot be written.
    """
    for name in names:
        if (run / name).is_file():
            limit = FileTuning.max_text_bytes if name.endswith(_TEXT) else None
            copy_untrusted(run / name, staged / name, limit, RunFolderError)
    if (run / TRAJECTORIES).is_dir():
        copy_untrusted_folder(run / TRAJECTORIES, staged / TRAJECTORIES, FileTuning.max_text_bytes, RunFolderError)
    if renders and (run / "renders").is_dir():
        copy_untrusted_folder(run / "renders", staged / "renders", FileTuning.max_image_bytes, RunFolderError)
