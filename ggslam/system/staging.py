# SPDX-License-Identifier: Apache-2.0
"""A folder's files replaced together: the new ones are written to a hidden folder inside it, then change places.

While they do, the folder's marker (a JSON file) says from where and what is to go, so that whoever finds the folder
after the program was killed can finish. At no time is a file gone whose successor is not on the disk.

Folders are passed around, so what is found in one is not trusted: nothing is moved or deleted through a link.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ggslam.errors import GgslamError, RunFolderError
from ggslam.system.atomic import is_machine_error, reason_of, write_text
from ggslam.system.folder_lock import LockTuning, folder_lock
from ggslam.system.links import first_link_in, refuse_link
from ggslam.system.process_tie import is_running
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import is_plain_name, read_untrusted_text

_SAVING = "saving"
_NAME = re.compile(r"\.staged-(\d+)-[0-9a-f]{8}")


class StagingTuning(Tuning):
    """How a save waits for another one."""

    wait_s = 5.0
    """Seconds to wait for another process that finishes the same save."""


def new_staging(target: Path) -> Path:
    """A name for a hidden folder in `target` to write files to; folders that killed programs left there go.

    Raises:
        RunFolderError: a link has the name of such a folder.
    """
    for path in target.iterdir():
        if _NAME.fullmatch(path.name):
            refuse_link(path)
    for left in leftovers(target):
        shutil.rmtree(left, ignore_errors=True)
    return target / f".staged-{os.getpid()}-{secrets.token_hex(4)}"


def make_staging(target: Path) -> Path:
    """As `new_staging`, and makes the folder.

    Raises:
        RunFolderError: likewise, or `target` cannot be written to.
    """
    staged = new_staging(target)
    try:
        staged.mkdir()
    except OSError as error:
        raise _failure(target, f"cannot be written to: {reason_of(error)}", error) from None
    return staged


def leftovers(target: Path) -> list[Path]:
    """Hidden folders in `target` whose writers do not run any more, less one that waits to be put into place."""
    found = [
        path for path in target.iterdir()
        if (match := _NAME.fullmatch(path.name)) and not path.is_symlink() and not is_running(int(match[1]))
    ]  # fmt: skip
    # A hidden marker is one that was still being written: nothing waits for it.
    markers = [path for path in target.glob("*.json") if not path.name.startswith(".")] if found else []
    waiting = [_trusted_saving(marker) for marker in markers]
    return [path for path in found if all(record is None or record["from"] != path.name for record in waiting)]


def publish(staged: Path, target: Path, marker: str, old: Sequence[str], before: dict[str, Any]) -> None:
    """Moves the files of `staged` into place, the marker last. If it cannot begin, `staged` is removed.

    Args:
        staged: a folder of `new_staging`, in `target`, with a new marker.
        target: where to.
        marker: name of the marker.
        old: names in `target` that go unless they are replaced.
        before: content of the marker meanwhile; what `finish_saving` needs is added.

    Raises:
        RunFolderError: there is a link among the files, or the marker cannot be written: nothing was moved; or
            something cannot be moved, and `finish_saving` may be tried later.
    """
    stale = [name for name in old if not (staged / name).exists()]
    record = {**before, _SAVING: {"from": staged.name, "stale": stale}}
    with ExitStack() as undone:
        undone.callback(shutil.rmtree, staged, ignore_errors=True)  # a link is not followed
        with folder_lock(target, wait_s=LockTuning.wait_s):
            _refuse_links(staged, target, marker, stale)
            write_text(target / marker, json.dumps(record, indent=1) + "\n", follow=False)
            undone.pop_all()
            try:
                _exchange(staged, target, marker, stale)
            except OSError as error:
                text = f"not all files could be put into place; the next command on it will go on: {reason_of(error)}"
                raise _failure(target, text, error) from None


def refuse_links_at(target: Path, names: Collection[str]) -> None:
    """Refuses what `publish` will, before the work whose result it is to put into place.

    Args:
        target: where to.
        names: of what may be replaced or deleted there.

    Raises:
        RunFolderError: one of them is a link.
    """
    for name in sorted(names):
        refuse_link(target / name)


def is_being_saved(target: Path, marker: str) -> bool:
    """Whether files of a folder are changing places, or were when the program that did it was killed.

    Raises:
        RunFolderError: the marker says so, but not as `publish` does.
    """
    return _read_saving(target / marker) is not None


def finish_saving(target: Path, marker: str) -> None:
    """Finishes a `publish` that was interrupted; does nothing if there was none, or if another process is at it.

    Raises:
        RunFolderError: the folder cannot be written to, the files are gone, there is a link among them, or the marker
            was not written by `publish`.
    """
    if _read_saving(target / marker) is None:
        return
    refuse_link(target / marker)
    with folder_lock(target, wait_s=StagingTuning.wait_s):
        record = _read_saving(target / marker)
        if record is None:  # another process was at it
            return
        staged = target / record["from"]
        if not staged.is_dir():
            refuse_link(staged)
            raise RunFolderError(f"{target}: saving was interrupted, and what was to be put into place is gone")
        try:
            _exchange(staged, target, marker, record["stale"])
        except OSError as error:
            text = f"saving was interrupted and cannot be finished: {reason_of(error)}"
            raise _failure(target, text, error) from None


def _exchange(staged: Path, target: Path, marker: str, stale: Sequence[str]) -> None:
    _refuse_links(staged, target, marker, stale)
    for path in sorted(staged.iterdir()):
        if path.name != marker:
            if (target / path.name).is_dir():  # only for folders there is no replacing in one step
                shutil.rmtree(target / path.name)
            path.replace(target / path.name)
    for name in stale:
        if (target / name).is_dir():
            shutil.rmtree(target / name)
        else:
            (target / name).unlink(missing_ok=True)
    (staged / marker).replace(target / marker)
    shutil.rmtree(staged, ignore_errors=True)


def _refuse_links(staged: Path, target: Path, marker: str, stale: Sequence[str]) -> None:
    """Raises RunFolderError unless files change places within `target` alone: the hidden folder, all that is in it and
    all that it replaces are no links, and lie where `publish` has them."""
    if staged.parent != target or not _NAME.fullmatch(staged.name) or not all(map(is_plain_name, stale)):
        raise RunFolderError(f"{target}: files of another folder were to be put into it; nothing was moved or deleted")
    refuse_link(staged)
    link = first_link_in([staged])
    if link is not None:
        raise RunFolderError(
            f"{staged}: holds a link, {link.relative_to(staged)}, and ggslam makes none; nothing was moved or deleted. "
            "The hidden folder may be deleted"
        )
    refuse_links_at(target, {marker, *stale, *(path.name for path in staged.iterdir())})


def _failure(target: Path, text: str, error: OSError) -> RunFolderError:
    failure = RunFolderError(f"{target}: {text}")
    failure.exit_code = 1 if is_machine_error(error) else failure.exit_code
    return failure


def _read_saving(marker: Path) -> dict[str, Any] | None:
    """What a marker says of a saving under way; None if nothing, or if it cannot be read at all.

    Raises:
        RunFolderError: names that `publish` does not write: somebody else wrote them.
    """
    try:
        record = json.loads(read_untrusted_text(marker))[_SAVING]
    except (GgslamError, ValueError, KeyError, TypeError, RecursionError):
        return None
    try:
        names = [record["from"], *record["stale"]]
        good = _NAME.fullmatch(record["from"]) and all(map(is_plain_name, record["stale"]))
    except (KeyError, TypeError):
        names, good = [record], None
    if not good:
        shown = repr(names)[:100]
        raise RunFolderError(f"{marker}: 'saving' names what no run would ({shown}); nothing was moved or deleted")
    return dict(record)


def _trusted_saving(marker: Path) -> dict[str, Any] | None:
    """The same; None also if somebody else wrote it."""
    try:
        return _read_saving(marker)
    except RunFolderError:
        return None
