# SPDX-License-Identifier: Apache-2.0
"""Writes an edited run: everything to a hidden folder first, then into place, one rename a file."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.formats.point_ply import write_points_in_parts
from ggslam.formats.point_sampling import MapPart, sample_parts
from ggslam.objects.displacement import Displacement
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.reporting.pictures import write_picture
from ggslam.runs.folder import MARKER, OBJECT_FILES, REPORT_FILE, TRUTH_FILE, RunFolder
from ggslam.runs.map_index import MAP_INDEX
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.step_log import STEPS_FILE
from ggslam.system.atomic import make_folder
from ggslam.system.staging import new_staging, publish

RECORDS = (STEPS_FILE, TRUTH_FILE)
"""Files that stay true, too, but older runs have none."""
COPIED = ("trajectory.txt", "keyframes.json", "config.yaml", "sequence.json", "loops.json", *RECORDS)
"""Files that stay true of an edited run."""
SCORES = ("metrics.json", "frames.csv")
"""Files that do not, unless objects were only renamed. `ggslam eval` makes them anew."""
POINTS = ("points.ply", "points_grid.ply")


def save_edited(
    source: RunFolder, target: RunFolder, scene: SegmentedMap, edits: Sequence[str], displacement: Displacement,
    pictures: Mapping[str, np.ndarray], named_only: bool, sequence: Path | None = None,
) -> list[Path]:  # fmt: skip
    """Writes an edited run; returns the files of the pictures.

    Until all files are on the disk nothing of a run that is at the target is touched. Then its marker says that it is
    incomplete while files change places, which takes milliseconds; if the program is killed meanwhile, opening the run
    finishes it.

    Args:
        source: the run that was edited.
        target: where to; may be the same.
        scene: the edited map.
        edits: what was done, a sentence each; added to the run's.
        displacement: where objects were moved to by now.
        pictures: by file name, for `renders/`.
        named_only: whether nothing but names changed, so that scores, points and renders stay.
        sequence: where the recording is now, if it was moved.

    Raises:
        RunFolderError: a file cannot be written; the target is as it was, or opening it finishes the work.
    """
    mark = source.mark()
    staged = RunFolder(new_staging(target.path))
    try:
        _stage(source, staged, scene, pictures, named_only)
        if sequence is not None:
            record = source.sequence()
            opened = record.open.model_copy(update={"path": str(sequence.absolute())})
            record.model_copy(update={"open": opened}).write(staged.path)
        note = {"edits": [*mark.edits, *edits], "displaced": displacement.to_json()}
        mark.model_copy(update=note).write(staged.path)
        meanwhile = mark.model_copy(update={"complete": False, "stopped_by": "saving did not finish"})
    except BaseException as error:
        shutil.rmtree(staged.path, ignore_errors=True)
        if isinstance(error, OSError):
            raise RunFolderError(f"{target.path}: the edited run cannot be written: {error}") from None
        raise
    old = (*SCORES, *POINTS, *OBJECT_FILES, *RECORDS, REPORT_FILE, PLACES_FILE, MAP_INDEX, "renders", "plots")
    try:
        publish(staged.path, target.path, MARKER, old, meanwhile.values())
    except RunFolderError:
        shutil.rmtree(staged.path, ignore_errors=True)
        raise
    except OSError as error:
        text = f"{target.path}: not all files could be put into place; the next command on it will go on: {error}"
        raise RunFolderError(text) from None
    return [target.path / "renders" / name for name in pictures]


def _stage(
    source: RunFolder, staged: RunFolder, scene: SegmentedMap, pictures: Mapping[str, np.ndarray], named_only: bool
) -> None:
    make_folder(staged.path / "renders")
    kept = (*COPIED, *SCORES, *POINTS, PLACES_FILE) if named_only else COPIED
    for name in kept:
        if (source.path / name).is_file():
            shutil.copyfile(source.path / name, staged.path / name)
    if named_only and (source.path / "renders").is_dir():
        shutil.copytree(source.path / "renders", staged.path / "renders", dirs_exist_ok=True)
    source.timing().model_copy(update={"gaussians": len(scene.gaussians)}).write(staged.path)
    for name, picture in pictures.items():
        write_picture(staged.path / "renders" / name, picture)
    if not named_only:
        parts = [MapPart.of(scene.gaussians)]
        write_points_in_parts(staged.path, sample_parts(parts, with_object_id=True))
    staged.save_objects(scene)
