# SPDX-License-Identifier: Apache-2.0
"""A run as the viewer shows it: map, poses, recording, and edits that wait to be saved."""

from __future__ import annotations

import threading
from collections.abc import Sequence as ListOf
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.jobs.changes.saved_changes import ChangesShown, changes_of, read_changes, sentence_of
from ggslam.jobs.edit.edit import Edit
from ggslam.jobs.edit.edited_file import edited_name
from ggslam.jobs.edit.edits import apply_edit, edit_run
from ggslam.jobs.edit.selected import selected_rows
from ggslam.jobs.export.map_files import OBJECT_EXTRAS
from ggslam.jobs.view.pictures import ViewPictures
from ggslam.objects.editing import EditingTuning, group_centroid, opacity_centroid
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import copies_of
from ggslam.objects.splat_editing import scene_without_objects
from ggslam.objects.table import ObjectRecord
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import MapFile
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.changes import ChangedSide
from ggslam.runs.records.movers import MoverFrameRecord, mover_colors
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.object_names import object_file_name
from ggslam.sequences import Sequence
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import is_plain_name, read_untrusted
from ggslam.viewer.model import Box, ListedObject, ShownChange, ShownMover
from ggslam.viewer.splats import most_visible
from ggslam.viewer.viewed_sides import KnownSides
from ggslam.volumes.map_upright import upright_of


class ViewedRunTuning(Tuning):
    """How much of a run is shown."""

    max_splats = 400_000
    """Most Gaussians that are shown unless asked otherwise."""
    change_pictures = 1000
    """Most pictures of changes: one is shown at a time."""
    max_edits = 500
    """Most edits before they have to be saved."""


class ViewedRun:
    """A run (or a file of Gaussians) for the viewer; a `ViewedMap` that can be edited.

    The run itself is never changed: edits are done to what is shown, and done again, as `ggslam edit` does them, to the
    run's files when they are saved to another folder.

    Args:
        folder: the run.
        max_splats: show no more, the most visible ones.
        sequence: where the recording is now, if it was moved.
        changes: folder that `ggslam changes` wrote, with this run as the older one; None: what an updated run holds.

    Raises:
        RunFolderError, FormatError: the run is damaged, or none of its frames was located.
        SequenceError: the recording is not at `sequence`.
        ConfigError: `changes` holds none, or those of other runs.
    """

    def __init__(
        self, folder: RunFolder, max_splats: int = ViewedRunTuning.max_splats, sequence: Path | None = None,
        changes: Path | None = None,
    ) -> None:  # fmt: skip
        self.folder, self._max_splats, self._sequence_path = folder, max_splats, sequence
        self._lock, self._saving = threading.RLock(), threading.Lock()
        self._sides: KnownSides | None = None
        self._edits: list[Edit] = []
        self._texts: list[str] = []
        self._undone: list[Edit] = []
        record = folder.keyframes()
        self._record = folder.sequence()
        self.camera: Camera = self._record.camera
        self.training_cameras = self._record.cameras() if folder.has_poses else []
        self.frame_poses: dict[int, np.ndarray] = dict(sorted(record.poses().items()))
        self.keyframe_poses = np.array([k.T_world_camera for k in record.keyframes]).reshape(-1, 4, 4)
        if not self.frame_poses:
            raise RunFolderError(f"{folder.path}: no frame of this run was located, so there is nowhere to look from")
        self.notes: list[str] = []
        self._changes = self._own_changes() if changes is None else self._given_changes(changes)
        self._recording = self._open_recording(sequence)
        self._read_map()
        upright = upright_of(self._gaussians, np.stack(list(self.frame_poses.values())))
        self.up, self.floor = upright.up, upright.floor

    @property
    def walks(self) -> list[np.ndarray]:
        """See `ViewedMap`."""
        found: dict[tuple[int, int], list[np.ndarray]] = {}
        if not self.folder.has_poses:
            return []  # nobody walked there
        for frame, pose in self.frame_poses.items():
            found.setdefault(self._record.walk_of(frame), []).append(pose[:3, 3])
        return [np.stack(positions) for positions in found.values()]

    def _own_changes(self) -> ChangesShown | None:
        try:
            return changes_of(self.folder, ViewedRunTuning.change_pictures)
        except GgslamError as error:  # the map is there
            self.notes.append(f"shown without what changed: {error}")
            return None

    def _given_changes(self, place: Path) -> ChangesShown:
        shown, own = read_changes(place, ViewedRunTuning.change_pictures), self.folder.path.resolve()
        old, new = shown.record.old, shown.record.new
        if new and own == Path(new).resolve():
            raise ConfigError(f"{place}: lies in the world of the older run; view {old} with it")
        if old and own != Path(old).resolve():
            self.notes.append(f"{place}: says that it is of {old}, not of this run")
        return shown

    def _open_recording(self, path: Path | None) -> Sequence | None:
        if path is None and not self.folder.has_recording:
            return None
        try:
            return open_recording_of(self.folder, path)
        except GgslamError as error:
            if path is not None:
                raise
            self.notes.append(f"shown without the recorded images: {error}")
            return None

    def _read_map(self) -> None:
        self._segmented: SegmentedMap | None = self.folder.segmented_map() if self.folder.has_objects() else None
        self._gaussians: GaussianMap = self.folder.gaussians() if self._segmented is None else self._segmented.gaussians
        self._map_changed()

    def _map_changed(self) -> None:
        """What was worked out of the map before an edit holds no more."""
        self._pictures = ViewPictures(
            self._gaussians, self._segmented if self.has_objects else None, self._record.camera_of,
            self._recorded_frame, self.training_cameras,
        )
        self._rows: np.ndarray | None = None

    def _recorded_frame(self, frame: int) -> Frame | None:
        if self._recording is None:
            return None
        try:
            return self._recording.frame(frame, masks=False)
        except GgslamError:  # one damaged frame is no reason to stop
            return None

    def turn(self) -> AbstractContextManager[Any]:
        """While it is held, no edit is done."""
        return self._lock

    # --- to be looked at ---------------------------------------------------------------------------------------------

    @property
    def has_objects(self) -> bool:
        """Whether there are objects to select."""
        return self._segmented is not None and bool(self._segmented.table.objects)

    def describe(self) -> str:
        """See `ViewedMap`."""
        with self._lock:
            shown = min(len(self._gaussians), self._max_splats)
            parts = [f"{len(self._gaussians):,} Gaussians" + (f" ({shown:,} shown)" if shown < len(self._gaussians)
                                                              else "")]  # fmt: skip
            taken = [quantity(len(self.frame_poses), "frame"), quantity(len(self.keyframe_poses), "keyframe")]
            parts += taken if self.folder.has_poses else [f"{quantity(len(self.frame_poses), 'view')} around it"]
            if self.has_objects and self._segmented is not None:
                parts.append(quantity(len(self._segmented.table), "object"))
            return " · ".join(parts)

    def shown_rows(self) -> np.ndarray:
        """Rows, rising, of the Gaussians that are shown, int [N]: the most visible ones."""
        with self._lock:
            if self._rows is None:
                owners = self._gaussians.object_id.numpy()
                self._rows = most_visible(self._gaussians, self._max_splats, owners)
            return self._rows

    def centers(self) -> np.ndarray:
        """See `ViewedMap`."""
        with self._lock:
            return self._gaussians.means.numpy()[self.shown_rows()]

    def gaussians(self) -> GaussianMap:
        """The map as it is after the edits; not to be changed."""
        with self._lock:
            return self._gaussians

    def objects(self) -> list[ListedObject]:
        """See `ViewedMap`."""
        with self._lock:
            return [] if self._segmented is None else [_list_object(record) for record in self._segmented.table.objects]

    def movers(self) -> list[ShownMover]:
        """See `ViewedMap`."""
        movers = self.folder.movers().movers
        colors = mover_colors(movers)
        return [ShownMover(m.way(), {f.frame: _box_of(f) for f in m.frames}, colors[m.id]) for m in movers]

    def changes(self) -> list[ShownChange]:
        """See `ViewedMap`."""
        shown = self._changes
        return [] if shown is None else [
            ShownChange(sentence_of(change), _box_of_side(change.old), _box_of_side(change.new), shown.pictures.get(k))
            for k, change in enumerate(shown.record.changes)
        ]  # fmt: skip

    def frame_picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """See `ViewedMap`."""
        with self._lock:
            return self._pictures.compare(frame, self.frame_poses[frame])

    def picture(self, camera: Camera, T_world_camera: np.ndarray, hidden: set[int]) -> np.ndarray:
        """See `ViewedMap`."""
        with self._lock:
            return self._pictures.picture(camera, T_world_camera, hidden)

    def viewed_sides(self, rows: np.ndarray) -> np.ndarray | None:
        """See `viewed_sides`; None where the poses are none of a recording."""
        if not self.folder.has_poses:
            return None
        if self._sides is None:  # before the first edit as a rule, else of what is left by then
            self._sides = KnownSides(self._gaussians, self.camera, list(self.frame_poses.values()))
        return self._sides.find(self._gaussians, rows)

    def identity_colors(self, rows: np.ndarray) -> np.ndarray | None:
        """Colours uint8 [N, 3] of the identity vectors of some rows; None if they have none."""
        if self._pictures.identity is None:
            return None
        features = np.ascontiguousarray(self._gaussians.features.numpy()[rows].T)[:, :, None]
        return self._pictures.identity.picture(features, np.ones(features.shape[1:], np.float32))[:, 0]

    # --- to be edited ------------------------------------------------------------------------------------------------

    def edit(self, edit: Edit) -> str:
        """Does an edit to what is shown; returns a sentence about it.

        Raises:
            ConfigError: it cannot be done.
        """
        with self._lock:
            if len(self._edits) >= ViewedRunTuning.max_edits:
                raise ConfigError(f"there are {len(self._edits)} edits already; save them, and view the edited run")
            text = self._do(edit)
            self._undone = []
            return text

    def _do(self, edit: Edit) -> str:
        try:
            change = apply_edit(self._scene_for(edit), edit)
        except BaseException:
            self._replay(self._edits)  # half an edit is none
            raise
        self._edits.append(edit)
        self._texts.append(change.text)
        self._gaussians = self._scene_for(edit).gaussians
        self._map_changed()
        return change.text

    def undo(self) -> str:
        """Takes the last edit back.

        Raises:
            ConfigError: there is none.
        """
        with self._lock:
            if not self._edits:
                raise ConfigError("there is no edit to take back")
            last, text = self._edits[-1], self._texts[-1]
            self._replay(self._edits[:-1])
            self._undone.append(last)
            return f"taken back: {text}"

    def redo(self) -> str:
        """Does again what was taken back last.

        Raises:
            ConfigError: there is nothing.
        """
        with self._lock:
            if not self._undone:
                raise ConfigError("there is no edit to do again")
            text = self._do(self._undone[-1])
            self._undone.pop()
            return text

    def _replay(self, edits: ListOf[Edit]) -> None:
        """Reads the map anew and does edits to it; a run that cannot be read any more leaves all as it is."""
        kept = list(edits)
        self._read_map()
        self._edits, self._texts = [], []
        for edit in kept:
            self._do(edit)

    def edits(self) -> list[str]:
        """Sentences on what was done so far."""
        with self._lock:
            return list(self._texts)

    def undone(self) -> int:
        """How many edits can be done again."""
        return len(self._undone)

    def rows_of(self, selection: str) -> np.ndarray:
        """The Gaussians of a selection, bool [N] of all, also of those that are not shown.

        Raises:
            ConfigError: it is no selection.
        """
        with self._lock:
            scene = self._segmented or scene_without_objects(self._gaussians)
            return selected_rows(scene, selection)

    def centroid_of(self, ids: ListOf[int]) -> np.ndarray:
        """About which objects turn, as one group, [3].

        Raises:
            ConfigError: there are none of these ids.
        """
        with self._lock:
            if self._segmented is None:
                raise ConfigError("this map has no objects")
            return group_centroid(self._segmented, ids)

    def centroid_of_rows(self, rows: np.ndarray) -> np.ndarray:
        """About which Gaussians (bool [N]) turn, [3]."""
        with self._lock:
            return opacity_centroid(copies_of(self._gaussians, rows))

    def export(self, object_id: int) -> tuple[str, bytes]:
        """Name and content of a PLY file of an object."""
        with self._lock, TemporaryDirectory() as folder:
            if self._segmented is None:
                raise ConfigError("this map has no objects")
            record = self._segmented.table.record(object_id)
            g = self._gaussians
            part = GaussianMap(g.sh_degree, g.feature_channels, with_moments=False)
            part.append({k: v for k, v in g.take(torch.nonzero(g.object_id == object_id)[:, 0]).items()
                         if "." not in k})  # fmt: skip
            path = Path(folder) / object_file_name(record.id, record.name)
            write_gaussian_ply(path, part, OBJECT_EXTRAS)
            return path.name, read_untrusted(path)

    def default_target(self) -> str:
        """Name to save as, if nobody gives another."""
        path = self.folder.path.resolve()  # "." has no name
        return edited_name(path).name if isinstance(self.folder, MapFile) else f"{path.name}-edited"

    def save_folder(self) -> Path:
        """Where edited runs are saved: beside this one, whatever a page asks for."""
        return self.folder.path.resolve().parent

    def save(self, target: str, inpaint: bool) -> str:
        """Writes the edited map with all that belongs to it, as a folder of this name in `save_folder`; an earlier run
        at `target` is not replaced.

        Raises:
            ConfigError: nothing was edited, or no name of a new folder.
            GgslamError: as of `edit_run`.
        """
        with self._lock:
            if not self._edits:
                raise ConfigError("nothing was edited, so there is nothing to save")
            name = target.strip()
            long = len(name) > EditingTuning.max_name_length
            if long or not is_plain_name(name) or not name.isprintable() or name[0] in ".-":  # hidden, or an option
                raise ConfigError(f"a name is needed to save as, of a new folder in {self.save_folder()}")
            sequence = self._sequence_path if inpaint else None
            edits = list(self._edits)
        with self._saving:  # the second of two to one place is told so
            outcome = edit_run(self.folder, edits, self.save_folder() / name, inpainting=inpaint, sequence=sequence)
        dropped = 0 if outcome.filling is None else outcome.filling.dropped
        left = [f"without {quantity(dropped, 'Gaussian')} that removed or moved objects left over"] if dropped else []
        return "\n".join([f"saved to {outcome.folder.path}", *left, *outcome.notes])

    def _scene_for(self, edit: Edit) -> SegmentedMap:
        if self._segmented is None and edit.selection:
            self._segmented = scene_without_objects(self._gaussians)
        if self._segmented is None:
            raise ConfigError("this run has no objects to edit")
        return self._segmented


def _list_object(record: ObjectRecord) -> ListedObject:
    box = record.box
    return ListedObject(
        record.id, record.name, record.color, record.gaussians, np.array(box.center), np.array(box.axes),
        np.array(box.size), np.array(record.centroid),
    )  # fmt: skip


def _box_of(frame: MoverFrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return frame.corners().mean(0), frame.T_world_mover[:3, :3].T, frame.box_max - frame.box_min


def _box_of_side(side: ChangedSide | None) -> Box | None:
    box = None if side is None else side.box
    return None if box is None else (np.array(box.center), np.array(box.axes), np.array(box.size))
