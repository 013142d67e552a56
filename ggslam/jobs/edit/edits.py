# SPDX-License-Identifier: Apache-2.0
"""Edits a run's map: writes a run folder with the edited map and pictures from before and after. `ggslam edit`
calls this."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.edit.edit import KINDS, Edit
from ggslam.jobs.edit.edited_file import edit_file
from ggslam.jobs.edit.edited_run import save_edited
from ggslam.jobs.edit.pictures import before_and_after
from ggslam.jobs.edit.selected import apply_to_selection
from ggslam.jobs.edit.vectors import read_vector
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.objects.displacement import Displacement
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
from ggslam.objects.hole_views import CameraView
from ggslam.objects.inpainting import Filling, InpaintSettings, inpaint
from ggslam.objects.recoloring import parse_color
from ggslam.objects.removal_artifacts import drop_artifacts, places
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import join_gaussians
from ggslam.objects.splat_editing import scene_without_objects
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import MapFile, open_map
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.system.interrupts import delay_interrupts
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class EditTuning(Tuning):
    """Which edits have to be confirmed."""

    confirmed_share = 0.5
    """Removing a larger share of the map has to be confirmed."""


Apply = Callable[[SegmentedMap, Edit], Change]
"""Does an edit to a map."""


@dataclass
class EditOutcome:
    """Result of editing a run.

    Attributes:
        folder: the edited run, or the file that stands for it.
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
    folder: str | Path | RunFolder,
    edits: Sequence[Edit],
    out: str | Path | None = None,
    *,
    in_place: bool = False,
    overwrite: bool = False,
    inpainting: bool = False,
    settings: InpaintSettings | None = None,
    sequence: str | Path | None = None,
    confirm: Callable[[str], bool] | None = None,
) -> EditOutcome:
    """Edits a run's map, in the order given, and writes the result.

    Args:
        folder: the run, or its folder; with objects. Or a file of Gaussians (see `runs.map_file.open_map`), of which a
            file is written.
        edits: what to do.
        out: folder for the edited run; default: beside the run, with "-edited" added to its name.
        in_place: write into the run's own folder instead.
        overwrite: replace a run that is already at `out`.
        inpainting: close the holes that removed and moved objects leave.
        settings: of inpainting.
        sequence: where the recording is now, if it was moved; only for inpainting, which does without the recording
            if this is None and it is not where it was.
        confirm: asked, with what is at stake, before more than half of the map is removed; None: nobody is.

    Raises:
        ConfigError: unknown objects, values that cannot be read, no edits, a folder that is the run's own, or a removal
            that was not confirmed.
        RunFolderError: the run has no objects, or is damaged, or the folder cannot be written.
        SequenceError: the recording is not at `sequence`.
    """
    if not edits:
        raise ConfigError("no edit was given; there are " + ", ".join(f"`{kind}`" for kind in KINDS))
    if sequence is not None and not inpainting:
        raise ConfigError("`sequence`: only `inpainting` looks at the recording")
    folder, apply = folder if isinstance(folder, RunFolder) else open_map(folder), _with_consent(confirm)
    if isinstance(folder, MapFile):
        if inpainting or in_place:
            raise ConfigError(f"{folder.path}: `inpainting` and `in_place` need a run, and this is a file")
        path, texts = edit_file(folder, edits, None if out is None else Path(out), overwrite, apply, read_vector)
        return EditOutcome(RunFolder(path), texts)
    sequence = None if sequence is None else Path(sequence)
    target = _target(folder, None if out is None else Path(out), in_place)
    source = _Source.of(folder)
    notes: list[str] = []
    recording = _open_recording(folder, sequence, notes) if inpainting else None
    scene, original = scene_of(folder, edits), folder.gaussians()
    changes = _apply_all(scene, edits, source.displacement, apply)
    if in_place:
        target.check_writable()
    written = target if in_place else RunFolder.create(target.path, overwrite)
    outcome = EditOutcome(written, [change.text for change in changes], inpainted=inpainting, notes=notes)
    try:
        outcome.filling = _mend(source, scene, recording, settings or InpaintSettings() if inpainting else None, notes)
        pictures = before_and_after(original, scene.gaussians, changes, source.camera_of, source.keyframes)
        named_only = all(edit.kind == "rename" for edit in edits)
        with delay_interrupts():
            outcome.pictures = save_edited(
                folder, written, scene, outcome.changes, source.displacement, pictures, named_only, sequence
            )
    except BaseException:
        written.discard()
        raise
    return outcome


def scene_of(folder: RunFolder, edits: Sequence[Edit] = ()) -> SegmentedMap:
    """A run's map with its objects; a map without any, too, if all edits are of selections.

    Raises:
        RunFolderError: there are no objects to edit, or the run is damaged.
    """
    if not folder.has_objects() and all(edit.selection for edit in edits):
        return scene_without_objects(folder.gaussians())
    return folder.segmented_map()


def _target(folder: RunFolder, out: Path | None, in_place: bool) -> RunFolder:
    """Where to.

    Raises:
        ConfigError: into the run itself without `in_place`.
    """
    path = folder.path if in_place else out or folder.path.with_name(folder.path.name + "-edited")
    if not in_place and path.resolve() == folder.path.resolve():
        raise ConfigError(f"{path}: is the run itself; use `in_place` to edit it there, or another `out`")
    if folder.path.resolve() in path.resolve().parents:
        raise ConfigError(f"{path}: lies within the run that is edited; use another `out`")
    return RunFolder(path)


@dataclass(frozen=True)
class _Source:
    """What an edit needs of a run besides its map.

    Attributes:
        camera_of: tells which camera a frame was seen with.
        keyframes: where they are, and how frames were tracked.
        views: of the keyframes.
        displacement: by earlier edits; follows this one.
    """

    camera_of: Callable[[int], Camera]
    keyframes: KeyframesRecord
    views: list[CameraView]
    displacement: Displacement

    @staticmethod
    def of(folder: RunFolder) -> _Source:
        """Reads it, before any work is done.

        Raises:
            RunFolderError: a file is missing or damaged, naming it.
        """
        displacement, recording = folder.mark().displacement(), folder.sequence()
        folder.timing()
        record = folder.keyframes()
        if not record.keyframes or not record.poses():
            raise RunFolderError(f"{folder.path / record.FILE}: it lists no keyframes or no tracked frames")
        # Keyframes of the map that the run began with have no images here.
        views = [
            CameraView(recording.camera, inverse(k.T_world_camera), None) if k.frame == FROM_EARLIER_RUN
            else CameraView(recording.camera_of(k.frame), inverse(k.T_world_camera), k.frame)
            for k in record.keyframes
        ]  # fmt: skip
        return _Source(recording.camera_of, record, views, displacement)


def _apply_all(
    scene: SegmentedMap, edits: Sequence[Edit], displacement: Displacement, apply: Apply
) -> list[Change]:
    """Does the edits."""
    original, changes = scene.table, list[Change]()
    for edit in edits:
        try:
            changes.append(apply(scene, edit))
        except ConfigError as error:
            if changes and set(_ids_of(original, edit)) - set(scene.table.ids()):
                raise ConfigError(f"`{edit.kind}` {edit.objects}: an earlier edit left none of it: {error}") from None
            raise
        displacement.follow(changes[-1], scene)
    return changes


def _ids_of(table: ObjectTable, edit: Edit) -> list[int]:
    """Ids of an edit's objects by a table; none if it knows them not."""
    if edit.selection:
        return []
    try:
        return table.select(edit.objects)
    except ConfigError:
        return []


def _with_consent(confirm: Callable[[str], bool] | None) -> Apply:
    """`apply_edit` that asks before it removes most of the map: on flat ground one object may hold nearly all of it."""

    def apply(scene: SegmentedMap, edit: Edit) -> Change:
        names, before = edit.objects or "the selection", len(scene.gaussians)
        change = apply_edit(scene, edit)
        removed = len(change.before.means)
        if confirm is None or edit.kind != "remove" or removed <= EditTuning.confirmed_share * before:
            return change
        if not confirm(
            f"`remove` {names}: {removed} of {quantity(before, 'Gaussian')}, {removed / before:.0%} of the map"
        ):
            raise ConfigError(f"`remove` {names}: not confirmed; nothing was changed")
        return change

    return apply


def apply_edit(scene: SegmentedMap, edit: Edit) -> Change:
    """Does one edit to a map.

    Raises:
        ConfigError: unknown objects, or values that cannot be read.
    """
    if edit.kind not in KINDS:
        raise ConfigError(f"edit {edit.kind!r}: expected one of {', '.join(KINDS)}")
    if edit.selection:
        return apply_to_selection(scene, edit)
    if edit.kind == "assign":
        raise ConfigError("`assign`: a selection is needed")
    ids = scene.table.select(edit.objects)
    if edit.kind == "remove":
        return remove_objects(scene, ids)
    if edit.kind == "keep":
        return keep_objects(scene, ids)
    if edit.kind == "move":
        turn = read_vector("rotation", edit.rotation) if edit.rotation else (0.0, 0.0, 0.0)
        return move_objects(scene, ids, read_vector("move", edit.value), turn)
    if edit.kind == "duplicate":
        return duplicate_objects(scene, ids, read_vector("duplicate", edit.value) if edit.value else None)
    if edit.kind == "recolor":
        return recolor_objects(scene, ids, parse_color(edit.value))
    if edit.kind == "merge":
        merged = _single(scene.table, "merge", edit.value)
        return merge_objects(scene, _single(scene.table, "merge", edit.objects), merged)
    return rename_object(scene, _single(scene.table, "rename", edit.objects), edit.value)


def _single(table: ObjectTable, argument: str, text: str) -> int:
    ids = table.select(text)
    if len(ids) != 1:
        raise ConfigError(f"`{argument}`: expected one object, but {text!r} are {len(ids)}: {', '.join(map(str, ids))}")
    return ids[0]


# --- the places that objects left -------------------------------------------------------------------------------------


def _mend(
    source: _Source, scene: SegmentedMap, recording: Callable[[int], Recorded] | None,
    settings: InpaintSettings | None, notes: list[str],
) -> Filling | None:  # fmt: skip
    """After all edits: drops the traces of removed and moved objects and, given settings, closes the holes."""
    left, displaced = source.displacement.left(), source.displacement.ids()
    if not left:
        if settings is not None:
            notes.append("nothing to inpaint: no object left its place")
        return None
    removed = join_gaussians(left)
    if settings is not None:
        filling = inpaint(scene, removed, source.views, displaced, recording, settings)
    else:
        spared = source.displacement.cut()
        dropped = [drop_artifacts(scene, part, source.views, displaced, spared) for part in places(removed)]
        filling = Filling(dropped=sum(dropped))
    rebuild_table(scene)
    return filling


def _open_recording(folder: RunFolder, sequence: Path | None, notes: list[str]) -> Callable[[int], Recorded] | None:
    """Gives the images of a frame; None if the recording is not where the run had it.

    Raises:
        SequenceError, RunFolderError: it is not at `sequence`, either.
    """
    try:
        recording = open_recording_of(folder, sequence)
    except GgslamError as error:
        if sequence is not None:
            raise
        notes.append(f"inpainted without the recording: {error}")
        return None

    def images(frame: int) -> Recorded:
        found = recording.frame(frame, masks=False)
        return Recorded(found.color, found.depth)

    return images
