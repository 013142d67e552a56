# SPDX-License-Identifier: Apache-2.0
"""Finds what changed between the visits of two finished runs. `ggslam changes` calls this."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ggslam.changes.change_table import ChangeTable
from ggslam.changes.detection import ChangeDetector
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Visit
from ggslam.errors import ConfigError
from ggslam.jobs.changes.pictures import picture_of_change
from ggslam.jobs.changes.saved_changes import ChangesShown, SavedChangesTuning
from ggslam.jobs.changes.stale_gaussians import own_keyframes, without_stale_gaussians
from ggslam.jobs.merge.joint_poses import find_joint_poses, place_maps
from ggslam.jobs.merge.sources import MergeSource, read_sources
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.merging.coverage import PlacedRun
from ggslam.merging.joint_graph import JointPoses
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.reporting.pictures import write_picture
from ggslam.runs.records.changes import ChangesRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.scene.poses import transform_points
from ggslam.system.atomic import make_folder, write_failure, write_text
from ggslam.system.json_files import json_ready
from ggslam.system.links import refuse_links_below

CHANGES_FILE = "changes.json"


@dataclass(frozen=True)
class ChangesOutcome:
    """Result of comparing two visits.

    Attributes:
        table: the changes, in the world of the older run.
        visits: the two maps in that world.
        detector: which compared them.
        seconds: that it took.
        context: threads.
    """

    table: ChangeTable
    visits: tuple[Visit, Visit]
    detector: ChangeDetector
    seconds: float
    context: NativeContext


def find_changes(
    old: str | Path, new: str | Path, *, ids: bool | None = None, settings: ChangeSettings | None = None,
    observer: Observer | None = None,
) -> ChangesOutcome:  # fmt: skip
    """Compares two visits to one place, object by object.

    Args:
        old, new: folders of the runs, or containers of them (`map.ggz`).
        ids: whether one object id means one thing in both runs; None: that is found out.
        settings: see there.
        observer: receives progress updates.

    Raises:
        ConfigError: the runs have no ground in common; the message tells the best that was found.
        RunFolderError: a run is damaged or has no places.
        MissingDependency: gtsam is not installed.
    """
    start, context, observer = time.perf_counter(), NativeContext(None), observer or SilentObserver()
    with tempfile.TemporaryDirectory(prefix="ggslam-changes-") as unpacked:
        sources = read_sources([Path(old), Path(new)], context, Path(unpacked))
        poses = find_joint_poses(sources, MergeSettings(), context, observer)
        placed = place_maps(sources, poses)
        outcome = compare_placed(sources, placed, poses, settings or ChangeSettings(), context, observer, ids)
    return replace(outcome, seconds=time.perf_counter() - start)


def compare_placed(
    sources: list[MergeSource], placed: list[PlacedRun], poses: JointPoses, settings: ChangeSettings,
    context: NativeContext, observer: Observer, ids: bool | None = None,
) -> ChangesOutcome:  # fmt: skip
    """Compares two visits whose maps are in one world; arguments as of `find_joint_poses` and `find_changes`."""
    start = time.perf_counter()
    counted = (range(len(placed[0].cameras)), own_keyframes(sources[1].record))
    notes: list[str] = []
    older, newer = (
        _visit(*parts, notes) for parts in zip(sources, placed, poses.T_new_old, counted, strict=True)
    )
    observer.begin("comparing surfaces", 1)
    detector = ChangeDetector(older, newer, settings, context, ids)
    found = detector.detect()
    found.notes += notes
    observer.advance(1, 1)
    names = [{} if s.objects is None else {o.id: o.name for o in s.objects.table.objects} for s in sources]
    table = ChangeTable(found, detector.judged, (names[0], names[1]))
    return ChangesOutcome(table, (older, newer), detector, time.perf_counter() - start, context)


def write_changes(outcome: ChangesOutcome, out: Path, old: str | Path, new: str | Path) -> list[Path]:
    """Writes pictures and, last, changes.json.

    Args:
        outcome: of `find_changes`.
        out: folder; made if it is not there.
        old, new: the runs, as the file shall name them.

    Raises:
        RunFolderError: `out` is a file, cannot be made or cannot be written to.
    """
    make_folder_of_changes(out)
    refuse_links_below(out, [path.name for path in out.glob("change*")])
    values, written = outcome.table.to_dict(), []
    for number, change in enumerate(outcome.table.found.changes):
        path = out / f"change{number:02d}_{change.kind}.png"
        write_picture(path, picture_of_change(change, outcome.table, outcome.visits, outcome.context))
        values["changes"][number]["picture"] = path.name
        written.append(path)
    values = {"old": str(old), "new": str(new), "world": "of the old run", **values}
    write_text(out / CHANGES_FILE, json.dumps(json_ready(values), indent=1) + "\n")
    for stale in set(out.glob("change[0-9][0-9]*_*.png")) - set(written):  # of what was written there before
        stale.unlink()
    return [*written, out / CHANGES_FILE]


def make_folder_of_changes(out: Path) -> None:
    """Raises `RunFolderError` if `out` is a file, cannot be made or cannot be written to; `ConfigError` if it is a run.
    """
    if (out / RunRecord.FILE).is_file():
        raise ConfigError(f"`out` {out}: is a run; choose another folder")
    make_folder(out)
    try:
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise write_failure(out, error) from None


def show_changes(
    outcome: ChangesOutcome, old: str | Path, new: str | Path, most: int = SavedChangesTuning.pictures
) -> ChangesShown:
    """What `find_changes` found, as pages show it, with so many pictures; `old`, `new`: as the runs are named there."""
    found = outcome.table.found.changes
    record = ChangesRecord.of({"old": str(old), "new": str(new), **outcome.table.to_dict()})
    pictures = {
        number: picture_of_change(change, outcome.table, outcome.visits, outcome.context)
        for number, change in enumerate(found[:most])
    }
    return ChangesShown(record, pictures, left_out=len(found[most:]))


def _visit(
    source: MergeSource, placed: PlacedRun, T_new_old: np.ndarray, counted: Sequence[int], notes: list[str]
) -> Visit:
    """A run as its keyframes with these numbers tell of it; `notes` get what the user should know."""
    known = source.known
    poses = T_new_old @ known.poses
    points = [transform_points(known.points[k].astype(float), poses[k]) for k in counted]
    normals = [known.normals[k].astype(float) @ poses[k, :3, :3].T for k in counted]
    gaussians = without_stale_gaussians(source, placed, notes)
    return Visit(
        gaussians, [placed.cameras[k] for k in counted], placed.T_world_camera[list(counted)],
        np.concatenate(points), np.concatenate(normals), source.objects is not None,
    )  # fmt: skip
