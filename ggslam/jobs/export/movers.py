# SPDX-License-Identifier: Apache-2.0
"""Points of the things that moved while a run was recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.formats.ply import write_ply
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.movers import MoversRecord
from ggslam.scene.object_names import object_file_name
from ggslam.system.atomic import make_folder

_FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]


def export_movers(folder: RunFolder, path: Path) -> str:
    """Writes the points of each mover, in its own frame, as a PLY file (`ID_NAME.ply`), and `movers.json`, which tells
    where that frame was, into the folder `path`; returns a line that says so.

    Raises:
        RunFolderError: nothing was found to move, or the files are damaged.
    """
    movers = folder.movers().movers
    if not movers:
        raise RunFolderError(f"{folder.path}: nothing was found to move in this run; there are no movers to write")
    points = folder.mover_points()
    missing = [mover.id for mover in movers if mover.id not in points]
    if missing:
        raise RunFolderError(f"{folder.path}: there are no points of mover {missing[0]}")
    make_folder(path)
    for mover in movers:
        places, colors = points[mover.id]
        rows = np.empty(len(places), _FIELDS)
        for k, name in enumerate("xyz"):
            rows[name] = places[:, k]
        for k, name in enumerate(("red", "green", "blue")):
            rows[name] = colors[:, k]
        comment = f"mover {mover.id}, {mover.kind}, in its own frame"
        write_ply(path / object_file_name(mover.id, mover.name), {"vertex": rows}, [comment], sized_names=True)
    MoversRecord(movers=movers).write(path)
    names = ", ".join(object_file_name(mover.id, mover.name) for mover in movers)
    return f"wrote {path}: {names} and {MoversRecord.FILE}"
