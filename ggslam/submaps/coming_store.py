# SPDX-License-Identifier: Apache-2.0
"""Stores that appear only when they are complete on the disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.submaps.cell_files import wait_for_disk
from ggslam.system.atomic import make_folder, write_failure
from ggslam.system.hidden_folder import hidden_beside


@contextmanager
def coming_store(target: Path) -> Iterator[Path]:
    """Gives the name of a hidden folder beside `target`, to be made within the block; it takes the place of `target`
    when the block ends well, and is deleted when it does not.

    Args:
        target: the store to be; nothing, or an empty folder.

    Raises:
        RunFolderError: there is something at the target, or it cannot be written.
    """
    _refuse_content(target)
    make_folder(target.parent)
    try:
        with hidden_beside(target) as beside:
            yield beside
            _refuse_content(target)
            beside.replace(target)
        wait_for_disk(target.parent)
    except OSError as error:
        raise write_failure(target, error) from error


def _refuse_content(target: Path) -> None:
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise RunFolderError(f"{target}: is there already and no folder; choose another one with `out`")
    if target.is_dir() and (held := sorted(entry.name for entry in target.iterdir())):
        raise RunFolderError(f"{target}: is not empty (it holds {held[0]}): a new store needs a folder of its own")
