# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run in one call."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ggslam.jobs.render.frames import render_frames, select_frames
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map


def render_run(
    run: str | Path | RunFolder,
    out: str | Path,
    *,
    frames: Iterable[int] | None = None,
    count: int = 8,
    what: Iterable[str] = ("color", "depth"),
    width: int | None = None,
) -> list[Path]:
    """Renders a run's map from the poses of its frames, as `ggslam render` does; returns the pictures.

    Args:
        run: the run, or its folder; or a file of Gaussians, which is seen from cameras around it.
        out: folder for frame000123_color.png and so on.
        frames: their numbers; None: `count` frames spread evenly.
        count: see `frames`.
        what: of color, depth, alpha and, of a run with objects, ids and pca.
        width: of the pictures in pixels; None: as the run saw them.

    Raises:
        ConfigError: no such frame or kind of picture.
        RunFolderError: no run, or objects are asked of a run that has none.
    """
    folder = run if isinstance(run, RunFolder) else open_map(run)
    named = None if frames is None else ",".join(str(int(frame)) for frame in frames)
    return render_frames(folder, select_frames(folder, named, None, count), list(what), Path(out), width)
