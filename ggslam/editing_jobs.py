# SPDX-License-Identifier: Apache-2.0
"""Edits of a run's map: a new run folder with the edited map and pictures of before and after. What `ggslam edit` does,
usable from Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ggslam.edited_run import save_edited
from ggslam.editing_pictures import before_and_after
from ggslam.errors import ConfigError, GgslamError
from ggslam.objects.editing import (
    Change,
    duplicate_objects,
    keep_objects,
    merge_objects,
    move_objects,
    rebuild_table,
    recolor_objects,
    remove_objects,
    rename_object,
)
from ggslam.objects.hole_refinement import Recorded
from ggslam.objects.hole_views import View
from ggslam.objects.inpainting import Filling, InpaintSettings, inpaint
from ggslam.objects.recoloring import parse_color
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import joined
from ggslam.objects.table import ObjectTable
from ggslam.objects.traces import drop_traces, places
from ggslam.pipeline import open_recording_of, uninterrupted
from ggslam.rendering_jobs import run_camera
from ggslam.run_folder import RunFolder
from ggslam.scene.poses import inverse

KINDS = ("remove", "keep", "move", "duplicate", "recolor", "merge", "rename")


@dataclass(frozen=True)
class Edit:
    """One edit, as people write it.

    Attributes:
        kind: one of `KINDS`.
        objects: names or ids, e.g. "mug,7"; of merge the object that stays; of rename exactly one.
        value: what `kind` needs: "dx dy dz" in metres (move, duplicate; of the latter also "", just beside), a colour
            (recolor), the object that is merged into the other (merge), the new name (rename); else "".
        rotation: of move, "rx ry rz" in degrees, or "".
    """

    kind: Literal["remove", "keep", "move", "duplicate", "recolor", "merge", "rename"]
    objects: str
    value: str = ""
    rotation: str = ""


@dataclass
class EditOutcome:
    """What came of it.

    Attributes:
        folder: the edited run.
        changes: the edits as sentences.
        filling: what happened to the places that removed and moved objects left; None if none did.
        inpainted: whether they were to be closed; if not, only traces were dropped.
        pictures: files.
        notes: what the user should know.
    """

    folder: RunFolder
    changes: list[str]
    filling: Filling | None = None
    inpainted: bool = False
    pictures: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def edit_run(
    folder: RunFolder,
    edits: Sequence[Edit],
    out: Path | None = None,
    *,
    in_place: bool = False,
    overwrite: bool = False,
    inpainting: bool = False,
    settings: InpaintSettings | None = None,
    sequence: Path | None = None,
) -> EditOutcome:
    """Edits a run's map, in the order given, and writes the result.

    Args:
        folder: the run, with objects.
        edits: what to do.
        out: folder for the edited run; default: beside the run, with "-edited" added to its name.
        in_place: write into the run's own folder instead.
        overwrite: replace a run that is already at `out`.
        inpainting: close the holes that removed and moved objects leave.
        settings: of inpainting.
        sequence: where the recording is now, if it was moved; only inpainting looks at it, and does without if it is
            not there.

    Raises:
        ConfigError: unknown objects, values that cannot be read, no edits, or a folder that is the run's own.
        RunFolderError: the run has no objects, or the folder cannot be written.
    """
    if not edits:
        raise ConfigError("no edit was given; there are --" + ", --".join(KINDS))
    target = folder.path if in_place else out or folder.path.with_name(folder.path.name + "-edited")
    if not in_place and target.resolve() == folder.path.resolve():
        raise ConfigError(f"{target}: is the run itself; use --in-place to edit it there, or another --out")
    scene, original = folder.segmented_map(), folder.gaussians()
    changes = _apply_all(scene, edits)
    written = RunFolder(target) if in_place else RunFolder.create(target, overwrite)
    outcome = EditOutcome(written, [change.text for change in changes], inpainted=inpainting)
    try:
        outcome.filling = _mend(folder, scene, changes, inpainting, settings, sequence, outcome.notes)
        camera, record = run_camera(folder), folder.read_json("keyframes.json")
        pictures = before_and_after(original, scene.gaussians, changes, camera, record)
        named_only = all(edit.kind == "rename" for edit in edits)
        with uninterrupted():
            outcome.pictures = save_edited(folder, written, scene, outcome.changes, pictures, named_only)
    except BaseException:
        written.discard()
        raise
    return outcome


def _apply_all(scene: SegmentedMap, edits: Sequence[Edit]) -> list[Change]:
    """Does the edits. What was moved or made here and then goes leaves no hole: no recording shows it there."""
    changes: list[Change] = []
    for edit in edits:
        displaced = {i for change in changes for i in change.displaced}
        own = set(scene.table.select(edit.objects))
        change = apply_edit(scene, edit)
        changes.append(replace(change, vacated=change.vacated and not own & displaced))
    return changes


def apply_edit(scene: SegmentedMap, edit: Edit) -> Change:
    """Does one edit to a map.

    Raises:
        ConfigError: unknown objects, or values that cannot be read.
    """
    if edit.kind not in KINDS:
        raise ConfigError(f"edit {edit.kind!r}: expected one of {', '.join(KINDS)}")
    ids = scene.table.select(edit.objects)
    if edit.kind == "remove":
        return remove_objects(scene, ids)
    if edit.kind == "keep":
        return keep_objects(scene, ids)
    if edit.kind == "move":
        turn = _vector("--rotate", edit.rotation) if edit.rotation else (0.0, 0.0, 0.0)
        return move_objects(scene, ids, _vector("--move", edit.value), turn)
    if edit.kind == "duplicate":
        return duplicate_objects(scene, ids, _vector("--duplicate", edit.value) if edit.value else None)
    if edit.kind == "recolor":
        return recolor_objects(scene, ids, parse_color(edit.value))
    if edit.kind == "merge":
        merged = _single(scene.table, "--merge", edit.value)
        return merge_objects(scene, _single(scene.table, "--merge", edit.objects), merged)
    return rename_object(scene, _single(scene.table, "--rename", edit.objects), edit.value)


def _single(table: ObjectTable, option: str, text: str) -> int:
    ids = table.select(text)
    if len(ids) != 1:
        raise ConfigError(f"{option}: expected one object, but {text!r} are {len(ids)}: {', '.join(map(str, ids))}")
    return ids[0]


def _vector(option: str, text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise ConfigError(f'{option}: expected three numbers like "0.1 0 -0.2", found {text!r}') from None
    if not np.isfinite([x, y, z]).all():
        raise ConfigError(f"{option}: expected finite numbers, found {text!r}")
    return x, y, z


# --- the places that objects left -------------------------------------------------------------------------------------


def _mend(
    folder: RunFolder, scene: SegmentedMap, changes: Sequence[Change], inpainting: bool,
    settings: InpaintSettings | None, sequence: Path | None, notes: list[str],
) -> Filling | None:  # fmt: skip
    """After all edits: drops the traces of removed and moved objects and, if asked, closes the holes."""
    left = [change for change in changes if change.vacated and len(change.before.means)]
    if not left:
        if inpainting:
            notes.append("nothing to inpaint: no object left its place")
        return None
    removed, views = joined([change.before for change in left]), _keyframe_views(folder)
    displaced = sorted({i for change in changes for i in change.displaced})
    if inpainting:
        filling = inpaint(scene, removed, views, displaced, _recorded(folder, sequence, notes), settings)
    else:
        filling = Filling(dropped=sum(drop_traces(scene, part, views, displaced) for part in places(removed)))
    rebuild_table(scene)
    return filling


def _keyframe_views(folder: RunFolder) -> list[View]:
    keyframes, camera = folder.read_json("keyframes.json")["keyframes"], run_camera(folder)
    poses = {k["frame"]: np.array(k["T_world_camera"]) for k in keyframes}
    return [View(camera, inverse(pose), frame) for frame, pose in sorted(poses.items())]


def _recorded(folder: RunFolder, sequence: Path | None, notes: list[str]) -> Callable[[int], Recorded] | None:
    """Gives the images of a frame; None if the recording is not at hand."""
    try:
        recording = open_recording_of(folder, sequence)
    except GgslamError as error:
        notes.append(f"inpainted without the recording: {error}")
        return None

    def images(frame: int) -> Recorded:
        found = recording.frame(frame, masks=False)
        return Recorded(found.color, found.depth)

    return images
