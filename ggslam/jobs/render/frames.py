# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run's map from the poses of its frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError
from ggslam.jobs.render.artist import Artist
from ggslam.reporting.pictures import legend, write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import change_in_run
from ggslam.system.atomic import make_folder


def select_frames(folder: RunFolder, numbers: str | None, every: int | None, count: int = 8) -> list[int]:
    """Frame numbers from a list like "0,50,100", or every n-th, or `count` spread evenly.

    Raises:
        ConfigError: not a number, or no such frame in the run.
    """
    known = sorted(folder.keyframes().poses())
    if not known:
        raise ConfigError(f"{folder.path}: no frame of this run was located, so there is nowhere to look from")
    if numbers is not None:
        try:
            wanted = [int(number) for number in numbers.split(",")]
        except ValueError:
            raise ConfigError(f"`frames`: expected numbers like 0,50,100, found {numbers!r}") from None
        missing = [number for number in wanted if number not in known]
        if missing:
            raise ConfigError(f"`frames`: the run has frames {known[0]} to {known[-1]}, not {missing[0]}")
        return wanted
    if every is not None:
        return known[::every]
    return [known[i] for i in np.unique(np.linspace(0, len(known) - 1, count).round().astype(int))]


def render_frames(
    folder: RunFolder, frames: list[int], what: list[str], out: Path, width: int | None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Path]:  # fmt: skip
    """Renders frames to `out`/frame000123_color.png and so on, with ids a legend.png, too; returns the files.

    Raises:
        ConfigError: `what` names something that is not in `KINDS`.
        RunFolderError: objects are asked of a run that has none.
    """
    artist = Artist(folder, what)
    make_folder(out)
    with change_in_run(out):
        return _render(folder, artist, frames, out, width, progress)


def _render(
    folder: RunFolder, artist: Artist, frames: list[int], out: Path, width: int | None, progress: Callable[[int], None]
) -> list[Path]:
    poses, recording = folder.keyframes().poses(), folder.sequence()
    written = []
    for done, frame in enumerate(frames):
        camera = recording.camera_of(frame)
        if width is not None:
            camera = camera.resize(width, round(camera.height * width / camera.width))
        for kind, picture in artist.pictures(camera, poses[frame]).items():
            written.append(out / f"frame{frame:06d}_{kind}.png")
            write_picture(written[-1], picture)
        progress(done + 1)
    if artist.objects is not None and "ids" in artist.kinds:
        written.append(out / "legend.png")
        entries = [(f"{o.id} {o.name or ''}", o.color) for o in artist.objects.table.objects]
        write_picture(written[-1], legend(entries))
    return written
