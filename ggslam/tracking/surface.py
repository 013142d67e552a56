# SPDX-License-Identifier: Apache-2.0
"""The surface that the tracker aligns to: points of the keyframes as they were measured.

G-ICP models each measured point as a Gaussian on its surface; a keyframe's points are such Gaussians. Trained for
looks, a map's Gaussians wander: blended along the ray they give the right colour and depth, while each of them alone
may lie a centimetre in front of the surface or behind it. Aligning to trained Gaussians drifts: in a run of the first
100 frames of a rendered room the trajectory error was 1.2 cm, against 0.05 cm for the surface as measured. The public
G-ICP Gaussian SLAM escapes this by hardly training positions at all, at the price of image quality.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.array_archive import ArrayArchive, Arrays
from ggslam.geometry.image_parts import is_in_image_part
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.keyframe_poses import KeyframePoses
from ggslam.scene.poses import transform_points
from ggslam.system.array_forms import Form, PoseForm, check_arrays, check_indices
from ggslam.system.plurals import quantity
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import TargetSettings


class SurfaceTuning(Tuning):
    """Shape of the points of the tracked surface."""

    spacing = 3.0 / 200.0
    """Standard deviation of a point's disc along the surface, as a share of its depth. Weights go with its inverse
    square."""
    flatness = 0.1
    """Thickness of the disc relative to its width."""
    opacity_logit = 3.0
    """Opacity of the points, as a logit."""


_SAVED = {
    "counts": Form("int", "n", below=2**31 - 1), "reach": Form("float", "n", finite=True),
    "points": Form("i2", "points", 3), "normals": Form("i1", "points", 3), "poses": PoseForm("float", "n"),
}  # fmt: skip


def check_surface_arrays(arrays: Mapping[str, np.ndarray]) -> None:
    """Raises FormatError unless these could be what `MeasuredSurface.to_arrays` gave."""
    check_arrays(arrays, _SAVED, "surface")
    if np.abs(arrays["reach"]).max(initial=0) > PoseForm.FARTHEST_M:
        raise FormatError(f"surface: 'reach': expected points within {PoseForm.FARTHEST_M:g} m of their keyframes")
    if arrays["counts"].astype(np.int64).sum() != len(arrays["points"]):
        raise FormatError("surface: the counts do not add up to the number of points")


@savable(fixed="_arrays", check="check")
class _Part:
    """One keyframe's points and normals in its camera's frame, float32 [n, 3]; in an archive if there is one."""

    _name: str
    _archive: ArrayArchive | None
    count: int
    _arrays: Arrays

    def __init__(self, number: int, points: np.ndarray, normals: np.ndarray, archive: ArrayArchive | None) -> None:
        self._name, self._archive = f"surface{number:06d}", archive
        self.count = len(points)
        self._arrays = {"points": points, "normals": normals}
        if archive is not None:
            archive.put(self._name, self._arrays)
            self._arrays = {}

    def check(self) -> None:
        """Raises FormatError if this is not `count` points with normals in memory: it may come from a file."""
        if self._archive is not None or set(self._arrays) != {"points", "normals"}:
            raise FormatError("points of a keyframe: expected points and normals")
        form = Form("f4", self.count, 3, finite=True)
        for name, array in self._arrays.items():
            if found := form.check(array, {}):
                raise FormatError(f"{name} of a keyframe: {found}")

    @property
    def points(self) -> np.ndarray:
        return self._get("points")

    @property
    def normals(self) -> np.ndarray:
        return self._get("normals")

    def _get(self, name: str) -> np.ndarray:
        return (self._arrays if self._archive is None else self._archive.get(self._name))[name]


@dataclass(frozen=True)
class _Begun:
    """Points that will be added from a pose to a target, as keyframe `number`, and the part and target they give."""

    points: PointSource
    T_world_camera: np.ndarray
    base: GicpTarget | None
    number: int
    result: Future[tuple[_Part, GicpTarget]]

    def is_for(self, points: PointSource, T_world_camera: np.ndarray, base: GicpTarget | None, number: int) -> bool:
        """Whether that is what is to be added now: the surface may have changed since."""
        same = points is self.points and base is self.base and number == self.number
        return same and np.array_equal(T_world_camera, self.T_world_camera)


@savable(not_saved="_context _archive target finish prepare _helper _begun", after="gather_again", check="check")
class MeasuredSurface:
    """Keyframes' points gathered into one target, keyframe by keyframe. Which of the keyframes take part can be
    chosen, and keyframes can be moved: after a loop was closed the surface is where they are. Holds the run's
    `KeyframePoses`.

    Args:
        settings: voxel sizes and bounds.
        context: threads to work on.
        archive: keeps the keyframes' points, in memory or not; None: they stay in memory.
    """

    _parts: list[_Part]
    active: set[int]
    _joined: list[list[int]]

    def __init__(self, settings: TargetSettings, context: NativeContext, archive: ArrayArchive | None = None) -> None:
        self.settings = settings
        """May be changed until the first keyframe is in."""
        self._context, self._archive = context, archive
        self.poses = KeyframePoses()
        """Of the keyframes; others share them."""
        self._parts = []
        self.finish = True
        """False: the targets' voxels are left without shapes; see `GicpTarget.from_arrays`."""
        self.prepare: Callable[[GicpTarget], None] | None = None
        """Gets targets that grew, before others see them; in the thread that adds keyframes."""
        self.active = set()
        """Numbers of the keyframes that take part."""
        self.target: GicpTarget | None = None
        """What has been gathered so far; None before the first keyframe. Each change makes a new one."""
        self._joined = []
        """The keyframes of the target, in the groups in which they joined it."""
        self._helper: ThreadPoolExecutor | None = None
        self._begun: _Begun | None = None

    def __len__(self) -> int:
        return len(self._parts)

    def check(self) -> None:
        """Raises FormatError if it names keyframes that it does not have: it may come from a file."""
        if len(self.poses) != len(self):
            raise FormatError(f"surface: {quantity(len(self.poses), 'pose')} of {quantity(len(self), 'keyframe')}")
        check_indices("keyframes of the surface", self.active, len(self))
        check_indices("keyframes of the surface", (number for group in self._joined for number in group), len(self))

    def begin(self, points: PointSource, T_world_camera: np.ndarray) -> None:
        """Starts in another thread what `add` will have to do, for a caller that has other things to do until then."""
        if self._archive is not None:
            return
        if self._helper is None:
            self._helper = ThreadPoolExecutor(1, thread_name_prefix="surface")
        T, base, number = np.array(T_world_camera, float), self.target, len(self._parts)

        def prepare() -> tuple[_Part, GicpTarget]:
            read = points.read()
            part = _Part(number, read.points.copy(), read.normals.copy(), None)
            return part, self._gather([(part, T)], base)

        self._begun = _Begun(points, T, base, number, self._helper.submit(prepare))

    def add(self, points: PointSource, T_world_camera: np.ndarray) -> GicpTarget:
        """Adds the points of a keyframe seen from `T_world_camera` [4, 4]; returns the new target."""
        begun, self._begun = self._begun, None
        number = len(self._parts)
        if begun is not None and begun.is_for(points, T_world_camera, self.target, number):
            part, target = begun.result.result()
            self._parts.append(part)
            self.poses.append(begun.T_world_camera)
            return self._note_joined([number], target)
        read = points.read()
        self._append(read.points.copy(), read.normals.copy(), np.array(T_world_camera, float))
        return self._join([number])

    def add_unseen(self, T_world_camera: np.ndarray) -> None:
        """Adds a keyframe [4, 4] without points; the target stays."""
        self._append(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), T_world_camera)

    def _join(self, numbers: list[int]) -> GicpTarget:
        """These keyframes take part, too."""
        return self._note_joined(numbers, self._gather(self._parts_with_poses(numbers), self.target))

    def _note_joined(self, numbers: list[int], target: GicpTarget) -> GicpTarget:
        self.active |= set(numbers)
        self._joined.append(numbers)
        if self.prepare is not None:
            self.prepare(target)
        self.target = target
        return target

    def _append(self, points: np.ndarray, normals: np.ndarray, T_world_camera: np.ndarray) -> None:
        self._parts.append(_Part(len(self._parts), points, normals, self._archive))
        self.poses.append(T_world_camera)

    def _parts_with_poses(self, numbers: Iterable[int]) -> list[tuple[_Part, np.ndarray]]:
        """Keyframes with where they are."""
        return [(self._parts[number], self.poses[number]) for number in numbers]

    def of(self, numbers: Iterable[int]) -> GicpTarget:
        """A target of these keyframes alone."""
        return self._gather(self._parts_with_poses(numbers), None)

    def points(self, numbers: Iterable[int]) -> np.ndarray:
        """World points float32 [n, 3] of these keyframes."""
        placed = (transform_points(part.points, T) for part, T in self._parts_with_poses(numbers))
        return np.concatenate([np.empty((0, 3), np.float32), *placed])

    def arrange(self, active: set[int], T_world_camera: np.ndarray | None = None) -> GicpTarget:
        """Chooses the keyframes that take part, and with `T_world_camera` [K, 4, 4] where keyframes are; returns the
        new target. Where keyframes only join, the cost goes with them; else with all that take part."""
        if T_world_camera is not None:
            self.poses.replace(T_world_camera)
        elif self.target is not None and self.active <= active:
            joining = sorted(active - self.active)
            return self._join(joining) if joining else self.target
        before = self.target if self._archive is None else None  # where memory is short it goes before the next is made
        self.target, self.active, numbers = None, set(active), sorted(active)
        self._joined = [numbers]
        self.target = self._gather(self._parts_with_poses(numbers), None, before)
        return self.target

    def drop_pixels(self, part: np.ndarray, nearest: float, camera: Camera) -> None:
        """Takes out the points that keyframes have in a part of their images, bool [H, W], or nearer than some metres;
        those in an archive stay."""
        if self._archive is not None:
            return
        for number, old in enumerate(self._parts):
            stays = ~is_in_image_part(old.points, part, camera) & (old.points[:, 2] >= nearest)
            self._parts[number] = _Part(number, old.points[stays], old.normals[stays], None)
        if self.target is not None:
            self.gather_again()

    def drop_pixels_of(self, parts: Mapping[int, tuple[np.ndarray, Camera]]) -> None:
        """Takes out the points that some keyframes, by number, have in parts of their images, bool [H, W], of their
        cameras; those in an archive stay."""
        if self._archive is not None or not parts:
            return
        for number, (part, camera) in parts.items():
            old = self._parts[number]
            stays = ~is_in_image_part(old.points, part, camera)
            self._parts[number] = _Part(number, old.points[stays], old.normals[stays], None)
        if self.target is not None:
            self.gather_again()

    def gather_again(self) -> None:
        """Makes the target from the keyframes in the order in which it came to be, so that it is the same bit for
        bit."""
        self.target = None
        for numbers in self._joined:
            self.target = self._gather(self._parts_with_poses(numbers), self.target)

    def points_and_normals(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Points, metres, and normals float32 [n, 3] of a keyframe in its camera's frame."""
        return self._parts[number].points, self._parts[number].normals

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Everything, for a file: points to 1/32767 of the farthest of a keyframe, normals to half a degree."""
        points = [np.float32(np.abs(p.points).max(initial=1e-6)) for p in self._parts]
        return {
            "counts": np.array([p.count for p in self._parts], np.int64),
            "reach": np.array(points, np.float32),
            "points": np.concatenate(
                [np.empty((0, 3), np.int16)]
                + [np.rint(p.points * (32767 / r)).astype(np.int16) for p, r in zip(self._parts, points, strict=True)]
            ),
            "normals": np.concatenate(
                [np.empty((0, 3), np.int8)] + [np.rint(p.normals * 127).astype(np.int8) for p in self._parts]
            ),
            "poses": self.poses.array(),
        }

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes over what `to_arrays` gave, all of it active.

        Raises:
            FormatError: arrays that do not fit together.
        """
        check_surface_arrays(arrays)
        counts, poses = arrays["counts"].astype(np.int64), arrays["poses"]
        ends = np.cumsum(counts)[:-1]
        for q, n, r, T in zip(
            np.split(arrays["points"], ends), np.split(arrays["normals"], ends), arrays["reach"], poses, strict=True
        ):
            normals = n.astype(np.float32)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
            self._append(q.astype(np.float32) * (r / np.float32(32767)), normals, T.astype(float))
        self.arrange(set(range(len(self._parts))))

    def _gather(
        self, placed: list[tuple[_Part, np.ndarray]], base: GicpTarget | None, like: GicpTarget | None = None
    ) -> GicpTarget:
        count = sum(part.count for part, _ in placed)
        points, quaternions, log_scales = (np.empty((count, width), np.float32) for width in (3, 4, 3))
        begin = 0
        for part, T in placed:  # one after the other: there may be far more points than a keyframe has
            rows, own = slice(begin, begin + part.count), part.points
            points[rows] = transform_points(own, T)
            quaternions[rows] = quaternions_from_normals(part.normals @ T[:3, :3].T)
            shape = np.log([1.0, 1.0, SurfaceTuning.flatness])
            log_scales[rows] = np.log(SurfaceTuning.spacing * own[:, 2])[:, None] + shape
            begin += part.count
        opacity_logits = np.full(count, SurfaceTuning.opacity_logit, np.float32)
        return GicpTarget.from_arrays(
            points, quaternions, log_scales, opacity_logits, self.settings, self._context,
            base=base, finish=self.finish, like=like,
        )  # fmt: skip


def quaternions_from_normals(normals: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [n, 4] of the shortest rotations that turn the z axis to unit vectors [n, 3]."""
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    q = np.stack([1 + z, -y, x, np.zeros_like(z)], 1)
    q[z < -0.9999] = [0, 1, 0, 0]
    return q / np.linalg.norm(q, axis=1, keepdims=True)
