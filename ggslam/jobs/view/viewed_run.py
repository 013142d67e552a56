# SPDX-License-Identifier: Apache-2.0
"""A run as the viewer shows it: map, poses, recording, and edits that wait to be saved."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.jobs.changes.saved_changes import ChangesShown, changes_of, read_changes, sentence_of
from ggslam.jobs.edit.edited_file import edited_name
from ggslam.jobs.edit.edits import Edit, apply_edit, edit_run
from ggslam.jobs.export.map_files import OBJECT_EXTRAS
from ggslam.jobs.view.pictures import ViewPictures
from ggslam.objects.editing import EditingTuning
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.table import ObjectRecord
from ggslam.reporting.pictures import color_of_depth, depth_range
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
from ggslam.viewer.model import Box, Coloring, ListedObject, ShownChange, ShownMover
from ggslam.viewer.splats import Splats, most_visible, splats_of
from ggslam.viewer.static_page import static_page
from ggslam.viewer.viewed_sides import viewed_sides
from ggslam.volumes.map_upright import upright_of


class ViewedRunTuning(Tuning):
    """How much of a run is shown."""

    max_splats = 400_000
    """Most Gaussians that are shown unless asked otherwise."""
    change_pictures = 1000
    """Most pictures of changes: one is shown at a time."""
    digits = 4
    """Decimals of a shift in metres and a rotation in degrees, as shown and as saved."""


class ViewedRun:
    """A run (or a file of Gaussians) for the viewer; an `EditableMap`.

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
        self._lock = threading.RLock()
        self._edits: list[Edit] = []
        self._texts: list[str] = []
        record = folder.keyframes()
        self._record = folder.sequence()
        self.camera: Camera = self._record.camera
        self.frame_poses: dict[int, np.ndarray] = dict(sorted(record.poses().items()))
        self.keyframe_poses = np.array([k.T_world_camera for k in record.keyframes]).reshape(-1, 4, 4)
        if not self.frame_poses:
            raise RunFolderError(f"{folder.path}: no frame of this run was located, so there is nowhere to look from")
        self.notes: list[str] = []
        self._changes = self._own_changes() if changes is None else self._given_changes(changes)
        self._recording = self._open_recording(sequence)
        self._read_map()
        self.up = upright_of(self._gaussians, np.stack(list(self.frame_poses.values()))).up

    @property
    def walks(self) -> list[np.ndarray]:
        """See `ViewedMap`."""
        found: dict[tuple[int, int], list[np.ndarray]] = {}
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
            self._gaussians, self._segmented, self._record.camera_of, self._recorded_frame
        )
        self._shown: tuple[np.ndarray, Splats] | None = None

    def _recorded_frame(self, frame: int) -> Frame | None:
        if self._recording is None:
            return None
        try:
            return self._recording.frame(frame, masks=False)
        except GgslamError:  # one damaged frame is no reason to stop
            return None

    # --- to be looked at ---------------------------------------------------------------------------------------------

    @property
    def has_objects(self) -> bool:
        """Whether there are objects to select."""
        return self._segmented is not None

    @property
    def colorings(self) -> tuple[Coloring, ...]:
        """See `ViewedMap`."""
        if not self.has_objects:
            return ("colour", "depth")
        known = self._pictures.identity is not None
        return ("colour", "objects", "identity", "depth") if known else ("colour", "objects", "depth")

    def describe(self) -> str:
        """See `ViewedMap`."""
        with self._lock:
            shown = min(len(self._gaussians), self._max_splats)
            parts = [f"{len(self._gaussians):,} Gaussians" + (f" ({shown:,} shown)" if shown < len(self._gaussians)
                                                              else "")]  # fmt: skip
            taken = [quantity(len(self.frame_poses), "frame"), quantity(len(self.keyframe_poses), "keyframe")]
            parts += taken if self.folder.has_poses else [f"{quantity(len(self.frame_poses), 'view')} around it"]
            if self._segmented is not None:
                parts.append(quantity(len(self._segmented.table), "object"))
            return " · ".join(parts)

    def splats(self, coloring: Coloring, frame: int) -> dict[int, Splats]:
        """See `ViewedMap`."""
        with self._lock:
            if self._shown is None:
                rows = self._most_visible()
                self._shown = rows, splats_of(self._gaussians, rows)
            rows, splats = self._shown
            splats = replace(splats, colors=self._colors(coloring, frame, rows, splats))
            owner = self._gaussians.object_id.numpy()[rows]
            return {int(i): splats.rows(owner == i) for i in np.unique(owner)}

    def _most_visible(self) -> np.ndarray:
        return most_visible(self._gaussians, self._max_splats, self._gaussians.object_id.numpy())

    def _colors(self, coloring: Coloring, frame: int, rows: np.ndarray, splats: Splats) -> np.ndarray:
        """uint8 [N, 3]."""
        g = self._gaussians
        if coloring == "objects" and self._segmented is not None:
            return self._segmented.table.palette()[g.object_id.numpy()[rows]]
        if coloring == "identity":
            found = self._identity_colors(rows)
            return splats.colors if found is None else found
        if coloring == "depth":
            T = self.frame_poses[frame]
            distance = np.linalg.norm(splats.centers - T[:3, 3], axis=1)
            return color_of_depth(distance[:, None], *depth_range(distance))[:, 0]
        return splats.colors

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

    def object_at(self, origin: np.ndarray, direction: np.ndarray, focal: float, hidden: set[int]) -> int:
        """See `ViewedMap`."""
        with self._lock:
            return self._pictures.object_at(origin, direction, focal, hidden)

    def picture(self, camera: Camera, T_world_camera: np.ndarray, hidden: set[int]) -> np.ndarray:
        """See `ViewedMap`."""
        with self._lock:
            return self._pictures.picture(camera, T_world_camera, hidden)

    def static_page(self, title: str) -> str:
        """The map, up to the limit of splats, as one HTML file that needs neither server nor network."""
        with self._lock:
            rows = self._most_visible()
            owners = self._gaussians.object_id.numpy()[rows].astype(np.uint16)
            identity = self._identity_colors(rows)
            return static_page(self, title, self._gaussians, rows, identity, owners, self._viewed_sides(rows))

    def _viewed_sides(self, rows: np.ndarray) -> np.ndarray | None:
        """See `viewed_sides`; None where the poses are none of a recording."""
        if not self.folder.has_poses:
            return None
        return viewed_sides(self._gaussians, rows, self.camera, list(self.frame_poses.values()))

    def _identity_colors(self, rows: np.ndarray) -> np.ndarray | None:
        """uint8 [N, 3] of the Gaussians' identity vectors; None if they have none."""
        if self._pictures.identity is None:
            return None
        features = np.ascontiguousarray(self._gaussians.features.numpy()[rows].T)[:, :, None]
        return self._pictures.identity.picture(features, np.ones(features.shape[1:], np.float32))[:, 0]

    # --- to be edited ------------------------------------------------------------------------------------------------

    def rename(self, object_id: int, name: str) -> str:
        """See `EditableMap`."""
        return self._do(Edit("rename", str(object_id), name))

    def remove(self, object_id: int) -> str:
        """See `EditableMap`."""
        return self._do(Edit("remove", str(object_id)))

    def move(self, object_id: int, T: np.ndarray) -> str:
        """See `EditableMap`."""
        with self._lock:
            center = np.array(self._scene().table.record(object_id).centroid)
        shift = T[:3, :3] @ center + T[:3, 3] - center
        turn = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)  # about fixed x, then y, then z
        rotation = _numbers(turn) if np.abs(turn).max() > 10.0**-ViewedRunTuning.digits else ""
        return self._do(Edit("move", str(object_id), _numbers(shift), rotation))

    def _do(self, edit: Edit) -> str:
        with self._lock:
            change = apply_edit(self._scene(), edit)
            self._edits.append(edit)
            self._texts.append(change.text)
            self._gaussians = self._scene().gaussians
            self._map_changed()
            return change.text

    def undo(self) -> str:
        """See `EditableMap`."""
        with self._lock:
            if not self._edits:
                raise ConfigError("there is no edit to take back")
            kept, text = self._edits[:-1], self._texts[-1]
            self._edits, self._texts = [], []
            self._read_map()
            for edit in kept:
                self._do(edit)
            return f"taken back: {text}"

    def edits(self) -> list[str]:
        """See `EditableMap`."""
        with self._lock:
            return list(self._texts)

    def export(self, object_id: int) -> tuple[str, bytes]:
        """See `EditableMap`."""
        with self._lock, TemporaryDirectory() as folder:
            record = self._scene().table.record(object_id)
            g = self._gaussians
            part = GaussianMap(g.sh_degree, g.feature_channels, with_moments=False)
            part.append({k: v for k, v in g.take(torch.nonzero(g.object_id == object_id)[:, 0]).items()
                         if "." not in k})  # fmt: skip
            path = Path(folder) / object_file_name(record.id, record.name)
            write_gaussian_ply(path, part, OBJECT_EXTRAS)
            return path.name, read_untrusted(path)

    def default_target(self) -> str:
        """See `EditableMap`."""
        path = self.folder.path.resolve()  # "." has no name
        return edited_name(path).name if isinstance(self.folder, MapFile) else f"{path.name}-edited"

    def save_folder(self) -> Path:
        """Where edited runs are saved: beside this one, whatever a page asks for."""
        return self.folder.path.resolve().parent

    def save(self, target: str, inpaint: bool) -> str:
        """See `EditableMap`; an earlier run at `target` is not replaced."""
        with self._lock:
            if not self._edits:
                raise ConfigError("nothing was edited, so there is nothing to save")
            if (
                not is_plain_name(target.strip())
                or not target.isprintable()
                or len(target) > EditingTuning.max_name_length
            ):
                raise ConfigError(f"a name is needed to save as, of a new folder in {self.save_folder()}")
            sequence = self._sequence_path if inpaint else None
            edits = list(self._edits)
        out = self.save_folder() / target.strip()
        outcome = edit_run(self.folder, edits, out, inpainting=inpaint, sequence=sequence)
        return "\n".join([f"saved to {outcome.folder.path}", *outcome.notes])

    def _scene(self) -> SegmentedMap:
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


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.{ViewedRunTuning.digits}f}" for value in values)
