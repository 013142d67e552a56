# SPDX-License-Identifier: Apache-2.0
"""movers.json: things that moved while the recording was made, one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pydantic

from ggslam.movers.mover_table import FoundMover, MoverSight
from ggslam.movers.point_files import POINTS_FILE
from ggslam.runs.records.record import Array, Number, Record, RecordFile
from ggslam.scene.id_colors import id_palette
from ggslam.scene.poses import inverse, separation
from ggslam.sequences.mask_ids import LARGEST_ID
from ggslam.sequences.moving_pixels import MOVERS_FILE
from ggslam.slam.result import SlamResult
from ggslam.system.array_forms import PoseForm


def _pose(value: np.ndarray) -> np.ndarray:
    if value.shape != (4, 4) or not (np.abs(value) <= PoseForm.FARTHEST_M).all():
        raise ValueError(f"expected a 4x4 matrix of finite numbers up to {PoseForm.FARTHEST_M:g}")
    return value


def _corner(value: np.ndarray) -> np.ndarray:
    if value.shape != (3,) or not (np.abs(value) <= PoseForm.FARTHEST_M).all():
        raise ValueError(f"expected three finite numbers up to {PoseForm.FARTHEST_M:g}")
    return value


Pose = Annotated[Array, pydantic.AfterValidator(_pose)]
Corner = Annotated[Array, pydantic.AfterValidator(_corner)]
FrameIndex = Annotated[int, pydantic.Field(ge=0, lt=2**31)]
MoverNumber = Annotated[int, pydantic.Field(ge=0, le=LARGEST_ID)]
"""One that has a colour of its own, see `id_palette`."""


class MoverFrameRecord(Record):
    """A mover in a frame.

    Attributes:
        frame: its index.
        T_world_mover: [4, 4]. The mover's own frame has the world's axes where it was first seen, and its origin in the
            middle of what was seen of it there: what lay at p in frame i is at T_world_mover[j] inv(T_world_mover[i]) p
            in frame j. Of what is not rigid it follows the middle, and does not turn.
        box_min, box_max: corners of the box about it, in its own frame, metres.
        share: of the image that shows it.
    """

    frame: FrameIndex
    T_world_mover: Pose
    box_min: Corner
    box_max: Corner
    share: Number = 0.0

    @staticmethod
    def of_sight(sight: MoverSight, T_world_camera: np.ndarray) -> MoverFrameRecord:
        """With the camera's pose as it came out."""
        T = T_world_camera @ sight.T_camera_mover
        values = {"frame": sight.frame, "T_world_mover": T, "box_min": sight.low, "box_max": sight.high}
        return MoverFrameRecord.of({**values, "share": sight.share})

    def corners(self) -> np.ndarray:
        """Of the box, [8, 3], world."""
        bits = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        own = np.where(bits == 0, self.box_min, self.box_max)
        return np.asarray(own @ self.T_world_mover[:3, :3].T + self.T_world_mover[:3, 3])


class DisplacementRecord(Record):
    """A motion from the place before to the place after.

    Attributes:
        T_new_old: [4, 4], world: what lay at p before lies at T_new_old p.
        distance_m: of the middle of the mover.
        turn_deg: angle.
        scatter_m, scatter_deg: of single frames about both places; what the way between adds is not in it.
    """

    T_new_old: Pose
    distance_m: Number
    turn_deg: Number
    scatter_m: Number = 0.0
    scatter_deg: Number = 0.0


class MoverRecord(Record):
    """One mover.

    Attributes:
        id: its number.
        name: of its object; None: it has none.
        instance: id in the recording's masks; None: they do not tell.
        kind: whether it keeps its shape.
        found: frame in which it was found.
        moves: first and last frame of each stretch in which it moves and is seen; the first may begin before `found`:
            it was found out later since when.
        frames: all of these.
        before: where it stood before; None: not seen standing.
        after: where it came to rest; None: not seen.
        displacement: from the one to the other; None without both.
    """

    id: MoverNumber
    name: str | None = None
    instance: int | None = None
    kind: Literal["rigid", "not rigid", "unknown"]
    found: int
    moves: list[tuple[int, int]]
    frames: list[MoverFrameRecord]
    before: MoverFrameRecord | None = None
    after: MoverFrameRecord | None = None
    displacement: DisplacementRecord | None = None

    @property
    def title(self) -> str:
        """Name, or number."""
        return self.name or f"mover {self.id}"

    def way(self) -> np.ndarray:
        """Its middles, frame by frame, float64 [n, 3]."""
        return np.array([f.corners().mean(0) for f in self.frames]).reshape(-1, 3)

    def frame(self, index: int) -> MoverFrameRecord | None:
        """How it is in a frame in which it moves."""
        return next((f for f in self.frames if f.frame == index), None)


class MoversRecord(RecordFile):
    """All movers."""

    FILE: ClassVar[str] = "movers.json"
    movers: list[MoverRecord] = []

    @staticmethod
    def of_result(result: SlamResult, names: Mapping[int, str]) -> MoversRecord:
        """Of a run that ended; `names` of ids in masks."""
        known = zip(result.frames, result.trajectory(), strict=True)
        poses = {frame.frame_index: T for frame, T in known if np.isfinite(T).all()}
        found = [_record(mover, poses, names) for mover in result.movers]
        return MoversRecord.of({"movers": [record for record in found if record is not None]})


def mover_colors(movers: Sequence[MoverRecord]) -> dict[int, tuple[int, int, int]]:
    """RGB of each."""
    palette = id_palette()
    return {mover.id: tuple(palette[mover.id].tolist()) for mover in movers}


def _record(mover: FoundMover, poses: Mapping[int, np.ndarray], names: Mapping[int, str]) -> dict[str, Any] | None:
    frames = [MoverFrameRecord.of_sight(s, poses[s.frame]) for s in mover.sights if s.frame in poses]
    if not frames:
        return None
    ends = [
        None if s is None or s.frame not in poses else MoverFrameRecord.of_sight(s, poses[s.frame])
        for s in (mover.before, mover.after)
    ]
    before, after = ends
    shift = None
    if before is not None and after is not None:
        shift = DisplacementRecord.of({
            "T_new_old": after.T_world_mover @ inverse(before.T_world_mover),
            "distance_m": np.linalg.norm(after.T_world_mover[:3, 3] - before.T_world_mover[:3, 3]),
            "turn_deg": separation(before.T_world_mover, after.T_world_mover)[1],
            "scatter_m": mover.scatter_m, "scatter_deg": mover.scatter_deg,
        })  # fmt: skip
    values: dict[str, Any] = {
        "id": mover.number, "name": None if mover.instance is None else names.get(mover.instance),
        "instance": mover.instance, "kind": mover.kind, "found": mover.found,
        "moves": _stretches([f.frame for f in frames]), "frames": [f.values() for f in frames],
    }  # fmt: skip
    for key, part in (("before", before), ("after", after), ("displacement", shift)):
        values[key] = None if part is None else part.values()
    return values


def _stretches(frames: list[int]) -> list[list[int]]:
    """First and last of each row of numbers without a gap."""
    found: list[list[int]] = []
    for frame in frames:
        if found and frame == found[-1][1] + 1:
            found[-1][1] = frame
        else:
            found.append([frame, frame])
    return found


MOVER_FILES = (MOVERS_FILE, MoversRecord.FILE, POINTS_FILE)
"""All that a run has of its movers; stays true whatever is done to its map."""
