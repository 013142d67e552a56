# SPDX-License-Identifier: Apache-2.0
"""Saves a run elsewhere when its folder cannot be written: the disk is full, or the folder is read-only or gone."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from ggslam.errors import GgslamError, RunFolderError
from ggslam.runs.checkpoints import has_checkpoints
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.writing import RunToWrite


def save_somewhere(folder: RunFolder, run: RunToWrite) -> tuple[RunFolder, GgslamError | None]:
    """Saves a run in its folder, or where there is room for it: if possible all of it, else at least map, poses and
    settings, else poses, settings and records. These, which are small, are kept in the run's own folder, too.

    Returns:
        Where it is, and, if that is not its folder or if not all of it could be saved, what to tell.

    Raises:
        RunFolderError: it could be saved nowhere.
    """
    try:
        folder.write(run)
        return folder, None
    except (GgslamError, OSError) as error:
        failure = error
    if run.failure is not None:  # all but the clouds is there
        text = f"{failure}; all but the point clouds was saved (`ggslam export` makes them)"
        return folder, _machine_error(text)
    refusals = [str(failure)]
    poses = _keep_poses(folder, run, failure, refusals)
    for least in (False, True):
        for place in places():
            other = RunFolder(_new_folder(place, folder.path.resolve().name))
            if _write_elsewhere(other, run, least, refusals):
                part = "its map, poses and settings were" if least else "the run was"
                also = "" if poses is None else f"; {_what_is_kept(poses)} kept in {poses.path}, too"
                return other, _machine_error(f"{failure}; {part} saved to {other.path} instead{also}")
    for place in places() if poses is None else []:
        poses = poses or _keep_poses(RunFolder(_new_folder(place, folder.path.resolve().name)), run, failure, refusals)
    if poses is None:
        raise _machine_error("; ".join(["the run could not be saved anywhere", *refusals[:3]]))
    again = f"; `ggslam run --resume {folder.path}` makes it where it fits" if has_checkpoints(folder.path) else ""
    text = f"{failure}; {_what_is_kept(poses)} kept in {poses.path}, the map was not{again}"
    return poses, _machine_error(text)


def _keep_poses(
    folder: RunFolder, run: RunToWrite, failure: GgslamError | OSError, refusals: list[str]
) -> RunFolder | None:
    """Writes what is small of a run, or at least its trajectory; returns where it is, None if it cannot be written."""
    result, reason = run.result, f"the map could not be saved: {failure}"
    with suppress(GgslamError, OSError):
        return folder.write_poses(run, reason)
    try:
        return folder.save_trajectory(result.timestamps(), result.trajectory(), reason)
    except (GgslamError, OSError) as error:
        refusals.append(str(error))
        return None


def _what_is_kept(poses: RunFolder) -> str:
    whole = (poses.path / KeyframesRecord.FILE).is_file()
    return "trajectory, keyframes and records were" if whole else "the trajectory alone was"


def _write_elsewhere(other: RunFolder, run: RunToWrite, least: bool, refusals: list[str]) -> bool:
    """Writes a run into a new folder; whether that worked, apart from its clouds."""
    run.failure = None
    try:
        other.write(run, least)
    except (GgslamError, OSError) as error:
        if run.failure is None:
            shutil.rmtree(other.path, ignore_errors=True)
            refusals.append(str(error))
            return False
    return True


def places() -> list[Path]:
    """Folders to save to if the run's own cannot be used, the one with the most room first."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    found: dict[Path, int] = {}
    for place in (Path(tempfile.gettempdir()), Path(state) / "ggslam", Path("/var/tmp"), Path.cwd()):
        try:
            place.mkdir(parents=True, exist_ok=True)
            found[place.resolve()] = shutil.disk_usage(place).free
        except OSError:
            continue
    return sorted(found, key=lambda place: -found[place])


def _new_folder(place: Path, name: str) -> Path:
    """A name for a folder that nobody can have made before."""
    safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:64]
    return place / f"ggslam-{safe}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"


def _machine_error(text: str) -> RunFolderError:
    error = RunFolderError(text)
    error.exit_code = 1
    return error
