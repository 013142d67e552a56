# SPDX-License-Identifier: Apache-2.0
"""Writes an edited run: everything to a hidden folder first, then into place, one rename a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.objects.displacement import Displacement
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.reporting.pictures import write_picture
from ggslam.runs.copied_files import copy_files
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MAP_INDEX
from ggslam.runs.publishing import publish_run
from ggslam.runs.records.annotations import AnnotationsRecord, CameraKeysRecord
from ggslam.runs.records.movers import MOVER_FILES
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.saving_parts import save_points
from ggslam.runs.writing import OBJECT_FILES, POINTS, REPORT_FILE, TRUTH_FILE, write_objects
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.step_log import STEPS_FILE
from ggslam.system.atomic import make_folder

RECORDS = (STEPS_FILE, TRUTH_FILE, *MOVER_FILES, AnnotationsRecord.FILE, CameraKeysRecord.FILE)
"""Files that stay true, too, but older runs have none."""
COPIED = ("trajectory.txt", "keyframes.json", "config.yaml", "sequence.json", "loops.json", *RECORDS)
"""Files that stay true of an edited run."""
SCORES = ("metrics.json", "frames.csv", "verdict.json")
"""Files that do not, unless objects were only renamed. `ggslam eval` makes scores anew."""


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

    def write(staged: Path) -> RunRecord:
        _stage(source, staged, scene, pictures, named_only)
        if sequence is not None:
            record = source.sequence()
            opened = record.open.model_copy(update={"path": str(sequence.absolute())})
            record.model_copy(update={"open": opened}).write(staged)
        return mark.model_copy(update={"edits": [*mark.edits, *edits], "displaced": displacement.to_json()})

    old = (*SCORES, *POINTS, *OBJECT_FILES, *RECORDS, REPORT_FILE, PLACES_FILE, MAP_INDEX, "renders", "plots")
    publish_run(target.path, write, old, f"{target.path}: the edited run cannot be written")
    return [target.path / "renders" / name for name in pictures]


def _stage(
    source: RunFolder, staged: Path, scene: SegmentedMap, pictures: Mapping[str, np.ndarray], named_only: bool
) -> None:
    make_folder(staged / "renders")
    kept = (*COPIED, *SCORES, *POINTS, PLACES_FILE) if named_only else COPIED
    copy_files(source.path, staged, kept, renders=named_only)
    source.timing().model_copy(update={"gaussians": len(scene.gaussians)}).write(staged)
    for name, picture in pictures.items():
        write_picture(staged / "renders" / name, picture)
    if scene.table.objects or source.has_objects():
        write_objects(staged, scene)
    else:
        write_gaussian_ply(staged / "map.ply", scene.gaussians, extra=("object_id", "identity"))
    if not named_only:
        save_points(staged)
