# SPDX-License-Identifier: Apache-2.0
"""Refuses links where ggslam keeps its own files: it makes none, so one was planted or is a mistake. The same holds for
hard links of files that are written in place.

Whoever moves, replaces or deletes by name in such a folder asks here first. A folder that the user names may itself be
a link: that is the user's choice.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import IO

from ggslam.errors import GgslamError, RunFolderError


def refuse_link(path: Path, error: type[GgslamError] = RunFolderError) -> None:
    """Refuses a path whose last part is a link, wherever it leads; what is missing is none.

    Args:
        path: of a file or folder that ggslam makes itself.
        error: class of the error to raise.

    Raises:
        error: it is one; names it and where it leads, and says that it may be deleted.
    """
    if path.is_symlink():
        raise error(
            f"{path}: is a link to {_leads_to(path)}, and ggslam makes none there; nothing was moved or deleted. "
            "The link may be deleted"
        )


def refuse_shared_file(
    path: Path, found: os.stat_result, advice: str = "it may be deleted", error: type[GgslamError] = RunFolderError
) -> None:
    """Refuses a file that is to be written in place, not replaced, unless it is a regular file with this name alone.

    Args:
        path: of a file that ggslam makes itself.
        found: what the system says of it, best of a descriptor that is open already.
        advice: what the user can do about it.
        error: class of the error to raise.

    Raises:
        error: it is of another kind, or has another name (a hard link), which may be that of somebody's file.
    """
    if not stat.S_ISREG(found.st_mode):
        raise error(f"{path}: is not a regular file; {advice}")
    if found.st_nlink > 1:
        raise error(
            f"{path}: has another name on this disk (a hard link) and may be somebody's file; nothing was written to "
            f"it; {advice}"
        )


def refuse_links_below(folder: Path, names: Iterable[str] | None = None) -> None:
    """Refuses a folder that is a link or holds one, however deep.

    Args:
        folder: of ggslam's own.
        names: only these files and folders in it, while `folder` may be a link; None: all, and it may not.

    Raises:
        RunFolderError: there is a link.
    """
    found = first_link_in([folder] if names is None else [folder / name for name in names])
    if found is not None:
        refuse_link(found)


def first_link_in(paths: Iterable[Path]) -> Path | None:
    """The first link among files and folders and below the folders; None: there is none."""
    waiting = list(paths)
    while waiting:
        path = waiting.pop()
        if path.is_symlink():
            return path
        if path.is_dir():
            waiting += path.iterdir()
    return None


def remove_folder(folder: Path) -> None:
    """Deletes a folder of ggslam's own with all that is in it, if it is there; what cannot be deleted stays.

    Raises:
        RunFolderError: it is a link.
    """
    refuse_link(folder)
    shutil.rmtree(folder, ignore_errors=True)


def new_file(path: Path) -> IO[bytes]:
    """An empty file, to be written, in the place of what is there: of a link, a pipe or one of several names of a file
    the name goes, not what is behind it."""
    path.unlink(missing_ok=True)
    return path.open("xb", buffering=0)


def _leads_to(link: Path) -> str:
    try:
        return os.readlink(link)  # noqa: PTH115 (Path's drops "./")
    except OSError:
        return "somewhere"
