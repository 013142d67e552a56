# SPDX-License-Identifier: Apache-2.0
"""Writes an edited run: everything to a hidden folder first, then into place, one rename a file."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.formats.atomic import make_folder
from ggslam.formats.point_ply import write_points
from ggslam.formats.point_sampling import sample_points
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.reporting.pictures import write_picture
from ggslam.run_folder import MARKER, OBJECT_FILES, RunFolder

COPIED = ("trajectory.txt", "keyframes.json", "config.yaml", "sequence.json")
"""Files that stay true of an edited run."""
SCORES = ("metrics.json", "frames.csv")
"""Files that do not, unless objects were only renamed. `ggslam eval` makes them anew."""
POINTS = ("points.ply", "points_grid.ply")


def save_edited(
    source: RunFolder, target: RunFolder, scene: SegmentedMap, changes: list[str], pictures: Mapping[str, np.ndarray],
    named_only: bool,
) -> list[Path]:  # fmt: skip
    """Writes an edited run; returns the files of the pictures.

    Until all files are on the disk nothing of a run that is at the target is touched. Then its marker says that it is
    incomplete while files change places, which takes milliseconds.

    Args:
        source: the run that was edited.
        target: where to; may be the same.
        scene: the edited map.
        changes: what was done, for the marker.
        pictures: by file name, for `renders/`.
        named_only: whether nothing but names changed, so that scores, points and renders stay.

    Raises:
        RunFolderError: a file cannot be written; the target is as it was.
    """
    mark = source.read_json(MARKER)
    staged = RunFolder(target.path / f".edited-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        _stage(source, staged, scene, pictures, named_only)
        staged.write_json(MARKER, {**mark, "edits": [*mark.get("edits", []), *changes]})
        target.write_json(MARKER, {**mark, "complete": False, "stopped_by": "saving did not finish"})
        _publish(staged, target)
    except OSError as error:
        raise RunFolderError(f"{target.path}: the edited run cannot be written: {error}") from None
    finally:
        shutil.rmtree(staged.path, ignore_errors=True)
    return [target.path / "renders" / name for name in pictures]


def _stage(
    source: RunFolder, staged: RunFolder, scene: SegmentedMap, pictures: Mapping[str, np.ndarray], named_only: bool
) -> None:
    make_folder(staged.path / "renders")
    kept = (*COPIED, *SCORES, *POINTS) if named_only else COPIED
    for name in kept:
        if name in COPIED or (source.path / name).is_file():
            shutil.copyfile(source.path / name, staged.path / name)
    if named_only and (source.path / "renders").is_dir():
        shutil.copytree(source.path / "renders", staged.path / "renders", dirs_exist_ok=True)
    staged.write_json("timing.json", {**source.read_json("timing.json"), "gaussians": len(scene.gaussians)})
    for name, picture in pictures.items():
        write_picture(staged.path / "renders" / name, picture)
    if not named_only:
        write_points(staged.path, sample_points(scene.gaussians))
    staged.save_objects(scene)


def _publish(staged: RunFolder, target: RunFolder) -> None:
    """Moves the staged files into place, the marker last; whatever else a run had there goes."""
    for stale in (*SCORES, *POINTS, *OBJECT_FILES):
        (target.path / stale).unlink(missing_ok=True)
    shutil.rmtree(target.path / "renders", ignore_errors=True)
    last = ("objects.json", MARKER)
    names = [path.name for path in staged.path.iterdir() if path.name not in last]
    for name in (*sorted(names), *last):
        (staged.path / name).replace(target.path / name)
