# SPDX-License-Identifier: Apache-2.0
"""Closing loops: `Slam` adds each keyframe, and gets a correction when one shows a known place."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ggslam.errors import FormatError
from ggslam.features.orb import FeatureView
from ggslam.loops.activity import ActiveKeyframes
from ggslam.loops.agreement import GroundLink
from ggslam.loops.parts import KeyframeParts
from ggslam.loops.places import Place, PlaceIndex
from ggslam.loops.pose_graph import SURE_INFORMATION, GraphResult, PoseGraph
from ggslam.loops.revisits import Revisits
from ggslam.loops.uncertainty import information_in_frame
from ggslam.loops.verification import Verification
from ggslam.mapping.keyframe import Keyframe
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, separation
from ggslam.slam.loop_results import Correction, LoopEvent
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.part_joining import (
    closures_between_others,
    find_links,
    links_between,
    poses_brought_together,
)  # fmt: skip
from ggslam.slam.place_comparison import PlaceComparison
from ggslam.system.array_forms import Form, Pose, PoseForm, check_arrays, check_indices
from ggslam.system.savable import savable
from ggslam.tracking.gicp import AlignmentResult, GicpTarget
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import Tracker, TrackingResult


@savable()
@dataclass(frozen=True)
class _Found:
    """A verified loop: the newer keyframe, the older, what moves the newer to where the older has it, and where it
    was."""

    keyframe: int
    old_keyframe: int
    T_correction: Pose
    T_world_camera: Pose


@savable(
    not_saved="settings comparison _camera _surface _lock _helper _begun", growing="events", check="check"
)
class LoopCloser:
    """Stores the place and odometry of every keyframe, and finds loops. `Relocalizer` finds lost frames with it.

    All methods may be called from tracker and mapper thread.

    Args:
        camera: of all frames.
        settings: see `LoopSettings`.
        surface: the keyframes' points; read, and arranged anew when keyframes are put aside.
        tracker: whose settings and noise G-ICP works with.
        context: threads.
    """

    events: list[LoopEvent]
    _verified: list[_Found]
    _found_at: tuple[int, int] | None
    _parts_begin: set[int]
    _taken: list[tuple[int | None, int]]

    def __init__(
        self, camera: Camera, settings: LoopSettings, surface: MeasuredSurface, tracker: Tracker, context: NativeContext
    ) -> None:
        self.settings = settings
        self.events = []
        self.seconds = 0.0
        """Spent here, verification and graph included, and on finding lost frames."""
        self.graph = PoseGraph(settings.graph, surface.poses)
        self.places = PlaceIndex(camera, settings.places)
        self.activity = ActiveKeyframes(settings.activity, surface.poses)
        self.poses = surface.poses
        """Of the keyframes; those of keyframes that are in the surface, but not here yet, are among them."""
        self.parts = KeyframeParts()
        self.revisits = Revisits(settings.revisits)
        self.comparison = PlaceComparison(
            settings.verification, settings.neighbourhood, surface, tracker, context
        )
        self._camera, self._surface = camera, surface
        self._verified = []
        self._found_at = None
        """When a lost camera was found (see `_moment`), and the keyframe it was found at; until its first keyframe is
        in."""
        self._parts_begin = set()
        """Moments of the frames that begin a part, until their keyframes are in."""
        self._taken = []
        """Instant and camera number of each keyframe of a rig; instants are None without one."""
        self._lock = threading.RLock()
        self._helper: ThreadPoolExecutor | None = None
        self._begun: tuple[int, Future[Place]] | None = None
        """Of a frame that will be added: its index, and its place as soon as it is described."""

    def check(self) -> None:
        """Raises FormatError if its parts are not of the same keyframes: it may come from a file."""
        count = len(self)
        counts = [count, len(self.poses), len(self.graph), len(self.places), len(self.activity), len(self.revisits)]
        counts.append(len(self.parts.of))
        if len(set(counts)) > 1:
            raise FormatError(f"loops: the parts of the state disagree about the number of keyframes: {counts}")
        named = [keyframe for found in self._verified for keyframe in (found.keyframe, found.old_keyframe)]
        named += [] if self._found_at is None else [self._found_at[1]]
        check_indices("loops", named, count)

    # --- keyframes ---------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        """How many keyframes were added."""
        return len(self._taken)

    def begin(self, frame: Frame) -> None:
        """Starts to describe the frame that is added next, in another thread: for a caller that has other things to do
        until then."""
        if self._helper is None:
            self._helper = ThreadPoolExecutor(1, thread_name_prefix="places")
        view = FeatureView(frame.color, frame.depth, np.eye(4))
        self._begun = frame.index, self._helper.submit(self.places.describe, view, frame.camera)

    def _describe(self, frame: Frame, T_world_camera: np.ndarray) -> Place:
        begun, self._begun = self._begun, None
        if begun is not None and begun[0] == frame.index:
            return begun[1].result()
        return self.places.describe(FeatureView(frame.color, frame.depth, T_world_camera), frame.camera)

    def add(self, frame: Frame, tracking: TrackingResult, noise: DepthNoise | None = None) -> Correction | None:
        """A keyframe was made of a frame, and its points are in the surface. Puts aside and takes back keyframes.

        Args:
            frame: that it was made of.
            tracking: where it is.
            noise: of the depth camera as it was known then, where the tracker learns more meanwhile.

        Returns:
            The correction if this closes a loop. `apply` it.
        """
        with self.work(), self.comparison.noise_as(noise):
            T = tracking.T_world_camera
            place = self._describe(frame, T)
            # In real time, keyframes from before the camera was lost may still come after it was found.
            belated = self._found_at is not None and _moment(frame) < self._found_at[0]
            before, rigid = self._came_from(frame)
            begins = _moment(frame) in self._parts_begin
            self._connect(T, tracking.information, before, belated, rigid, begins)
            if begins:
                self._leave_behind(frame, belated)
            self.activity.add(T, tracking.median_depth_m, None if rigid or begins else before)
            self._taken.append((frame.instant, frame.camera_number))
            self.places.add(len(self) - 1, place)
            if belated:
                self.activity.active.discard(len(self) - 1)
            correction = None if belated else self._look_back(frame, place, tracking)
            if correction is None and (self.activity.update() or belated or begins):
                self._surface.arrange(self.activity.active)
        return correction

    def add_unseen(self, keyframe: Keyframe) -> None:
        """A keyframe was made of which nothing is known but its pose, which `poses` has: no frame is ever found at it,
        and it closes no loop."""
        with self._lock:
            T, (before, rigid), self._begun = self.poses[keyframe.index], self._came_from(keyframe), None
            moment = keyframe.frame_index if keyframe.instant is None else keyframe.instant
            begins = moment in self._parts_begin
            self._connect(T, None, before, rigid=rigid, begins=begins)
            self._parts_begin.discard(moment)
            median_depth_m = float(self.activity.median_depths[before]) if len(self) else 1.0
            self.activity.add(T, median_depth_m, None if rigid or begins else before)
            self._taken.append((keyframe.instant, keyframe.camera_number))
            self.places.add(keyframe.index, self.places.empty_place())

    @contextmanager
    def work(self) -> Iterator[None]:
        """The block uses what is known of the keyframes, while no other thread does; it counts for `seconds`."""
        start = time.perf_counter()
        with self._lock:
            try:
                yield
            finally:
                self.seconds += time.perf_counter() - start

    def apply(self, correction: Correction) -> None:
        """Moves the tracked surface to the poses of a correction."""
        with self._lock:
            self._surface.arrange(correction.active, correction.T_world_camera)
            self._verified.clear()

    def _came_from(self, frame: Frame | Keyframe) -> tuple[int, bool]:
        """The keyframe before that of a new frame, -1 without one, and whether it is of the same instant. In a rig that
        is one of this instant, else the same camera's of the instant before, else any of that."""
        newest = len(self) - 1
        if newest < 0 or frame.instant is None:
            return newest, False
        first, at = newest, self._taken[newest][0]
        while at is not None and first > 0 and self._taken[first - 1][0] == at:
            first -= 1
        if at == frame.instant:
            return first, True
        same = [k for k in range(first, newest + 1) if self._taken[k][1] == frame.camera_number]
        return (same[0] if same else first), False

    def _leave_behind(self, first: Frame, belated: bool) -> None:
        """What was mapped is out of sight of a part that begins, unless the camera was found there meanwhile."""
        self._parts_begin.remove(_moment(first))
        if not belated:
            self.activity.leave()
            self._verified.clear()

    def _connect(
        self, T: np.ndarray, alignment: np.ndarray | None, before: int, belated: bool = False, rigid: bool = False,
        begins: bool = False,
    ) -> None:  # fmt: skip
        """The new keyframe's node, at T_world_camera `T` by an alignment's information, tied to the one before it, or
        to where a lost camera was found again; where a part begins, by a motion that nothing is known of."""
        number = len(self)
        self.graph.add_node(T)
        found = self._found_at is not None and not belated
        if self._found_at is not None and found:
            before, self._found_at = self._found_at[1], None
        self.revisits.add(inverse(self.poses[before]) @ T if before >= 0 and not rigid else np.eye(4))
        if before >= 0:
            T_before_world = inverse(self.poses[before])
            information = SURE_INFORMATION  # without an alignment, what drift allows for is all that is unsure
            if alignment is not None:
                information = information_in_frame(alignment, T_before_world)
            self.graph.add_odometry(before, number, T_before_world @ T, information, found, rigid, unknown=begins)
        if begins:
            self.parts.begin()
        else:
            self.parts.add(before)

    def _look_back(self, frame: Frame, place: Place, tracking: TrackingResult) -> Correction | None:
        number, s = len(self) - 1, self.settings
        known = self.activity.active | self.activity.spare
        waiting = self._correction_to_confirm()
        if waiting is not None:  # the same correction is looked for at the same place
            reach, T = s.confirmation_gap, waiting.T_correction @ self.poses[-1]
            near = {k for k in range(number) if abs(k - waiting.old_keyframe) <= reach}
            return self._revisit(frame, place, tracking, near, T)
        if len(known) < len(self):  # there is something to come back to
            for match in self.places.query(place, s.candidates, known.__contains__):
                found, _ = self.compare(frame.camera, tracking.points, place, match.number)
                if found.accepted:
                    return self._believe(frame, match.number, found)
                if found.inliers >= s.verification.min_inliers:  # others were never likely
                    self.events.append(LoopEvent("refused", frame.index, number, match.number, found.reason))
        chosen = known.intersection(self.revisits.candidates(tracking.median_depth_m).tolist())
        chosen &= self.activity.alike(s.revisits.near, s.revisits.turned)
        return self._revisit(frame, place, tracking, chosen, self.poses[-1])

    def _believe(self, frame: Frame, old: int, found: Verification) -> Correction | None:
        """A comparison with an old keyframe says that the newest lies elsewhere."""
        number = len(self) - 1
        reason = f"{found.inliers} features, {found.overlap:.0%} of the voxels, RMSE {1e3 * found.rmse:.1f} mm"
        self.events.append(LoopEvent("verified", frame.index, number, old, reason))
        loop = self.graph.add_loop(old, number, found.T_old_new, found.information)
        correction = self.poses[old] @ found.T_old_new @ inverse(self.poses[number])
        self._verified.append(_Found(number, old, correction, self.poses[number]))
        return self._close(frame.index, old, loop) if self._is_confirmed() else None

    def _revisit(
        self, frame: Frame, place: Place, tracking: TrackingResult, chosen: set[int], T_expected: np.ndarray
    ) -> Correction | None:
        """Compares the newest keyframe, expected at a pose [4, 4], with the likeliest of the old ones chosen."""
        number = len(self) - 1
        for match in self.places.query(place, 1, lambda k: k not in chosen):
            old = match.number
            found = self._compare_expected(frame.camera, tracking.points, place, old, T_expected)
            if not found.accepted:
                self.revisits.pause()
                continue
            off = self.graph.discrepancy(old, number, found.T_old_new, found.information)
            if off > 1:
                return self._believe(frame, old, found)
            self.events.append(LoopEvent("agreed", frame.index, number, old, f"{off:.2f} of what noise explains"))
            self.graph.add_loop(old, number, found.T_old_new, found.information)
            self.revisits.tie(old, number)
        return None

    def _correction_to_confirm(self) -> _Found | None:
        """A correction that waits to be confirmed."""
        if self._verified and len(self) - 1 - self._verified[-1].keyframe <= self.settings.confirmation_gap:
            return self._verified[-1]
        return None

    def _compare_expected(
        self, camera: Camera, source: PointSource, place: Place, old: int, T: np.ndarray
    ) -> Verification:
        """Compares the newest keyframe with an old one, expected at `T` [4, 4]."""
        T_old_new, needed = inverse(self.poses[old]) @ T, self.settings.revisits.min_witnesses
        matches = self.comparison.matches(place, self.places[old])
        if self.comparison.count_agreeing(matches, T_old_new, camera, slack=4) >= needed:
            return self.comparison.confirm(
                source, place, self.places, self.poses, old, camera, matches, T_old_new, needed
            )
        return self.compare(camera, source, place, old)[0]

    def compare(
        self, camera: Camera, source: PointSource, place: Place, old: int
    ) -> tuple[Verification, AlignmentResult | None]:
        """Whether a frame sees what keyframe `old` saw, see `PlaceComparison.find`."""
        return self.comparison.find(source, place, self.places, self.poses, old, camera)

    def _is_confirmed(self) -> bool:
        """Whether the last loops found agree on the correction."""
        s, newest, count = self.settings, self._verified[-1], 0
        here = newest.T_world_camera
        for found in reversed(self._verified):
            if newest.keyframe - found.keyframe > count * s.confirmation_gap:
                break
            apart, turned = separation(newest.T_correction @ here, found.T_correction @ here)
            count += apart < s.agreement_m and turned < s.agreement_deg
        return count >= s.confirmations

    def _close(self, frame_index: int, old: int, loop: int) -> Correction | None:
        number = len(self) - 1
        joins = not self.parts.together(old, number)
        result = self._optimise(frame_index, loop)
        if result is None:
            return None
        poses = result.poses
        T_new_old = poses @ inverse(self.poses.array())
        kept, doubted = self.activity.inactive(), self.activity.active | self.activity.spare
        if old in doubted:
            kept, doubted = self.activity.visits(old)
        if joins:
            kept &= self.parts.members(old)
            self._note_joined(frame_index, old, number)
        else:
            moved = float(np.linalg.norm(poses[-1][:3, 3] - self.poses[-1][:3, 3]))
            reason = f"{len(result.accepted)} of {len(self.graph.loops)} closures believed, {result.seconds:.2f} s"
            self.events.append(LoopEvent("closed", frame_index, number, old, reason, moved))
        self.activity.activate_around(old)
        self.revisits.tie(old, number)
        return Correction(poses, T_new_old, kept, doubted, set(self.activity.active))

    def _optimise(self, frame_index: int, number: int) -> GraphResult | None:
        """The graph with a closure that is to be believed; None if it is not."""
        loop = self.graph.loops[number]
        joins = not self.parts.together(loop.i, loop.j)
        start = poses_brought_together(loop, self.parts, self.poses) if joins else None
        result = self.graph.optimise(closures_between_others(loop, self.graph.loops, self.parts), start)
        if number not in result.rejected:
            return result
        reason = f"the pose graph does not believe it: {result.rejected[number]}"
        self.events.append(LoopEvent("refused", frame_index, loop.j, loop.i, reason))
        self.revisits.pause()
        return None

    # --- parts, and where a lost camera goes on -----------------------------------------------------------------------

    def common_places(self) -> list[GroundLink]:
        """Places that parts have in common, as far as one finds them when there are no more frames."""
        with self.work():
            return find_links(
                self.parts, self.poses, self.places, self._surface, self.comparison, self._camera,
                self.settings.candidates,
            )  # fmt: skip

    def join(self, older: int, younger: int, links: Sequence[GroundLink]) -> Correction | None:
        """Makes one part of two, each given as its oldest keyframe, by places that parts have in common.

        Returns:
            As `add`; None if too few of the places agree.
        """
        old_members, new_members = self.parts.members(older), self.parts.members(younger)
        agreeing = links_between(links, old_members, new_members, self.poses, self.settings.graph)
        if len(agreeing) < self.settings.confirmations:
            return None
        loops = [self.graph.add_loop(k.old, k.new, k.T_old_new, k.information) for k in agreeing]
        result = self._optimise(-1, loops[0])
        if result is None:
            return None
        self._note_joined(-1, agreeing[0].old, agreeing[0].new)
        T_new_old = result.poses @ inverse(self.poses.array())
        return Correction(result.poses, T_new_old, old_members, new_members, old_members | new_members)

    def begin_part(self, frame: Frame, first: int) -> None:
        """A lost frame, which will be added as a keyframe, begins a part; `first`: index of its first frame."""
        with self._lock:
            self._parts_begin.add(_moment(frame))
            reason = f"part {len(self.parts.begun) + len(self._parts_begin)} begins"
            self.events.append(LoopEvent("new part", first, len(self), -1, reason))

    def move_world(self, T_new_old: np.ndarray) -> None:
        """Everything is moved [4, 4]."""
        with self._lock:
            self._surface.arrange(self.activity.active, np.array([T_new_old @ T for T in self.poses]))

    def _note_joined(self, frame_index: int, old: int, new: int) -> None:
        """Two parts are one."""
        older, younger = sorted((old, new), key=lambda k: self.parts.of[k])
        names = [self.parts.name(self.parts.members(k)) for k in (younger, older)]
        self.events.append(LoopEvent("joined", frame_index, new, old, f"{names[0]} was joined to {names[1]}"))
        self.parts.join(old, new)

    def go_on_at(self, frame: Frame, old: int, reason: str) -> None:
        """A lost frame was found about keyframe `old`; `reason` says how."""
        with self._lock:
            self._found_at = _moment(frame), old
            self.activity.restart(old)
            self._surface.arrange(self.activity.active)
            self.events.append(LoopEvent("found again", frame.index, len(self), old, reason))

    def target_around(self, keyframe: int) -> GicpTarget:
        """The surface about a keyframe, as `go_on_at` would arrange it."""
        with self._lock:
            return self._surface.of(sorted(self.activity.around(keyframe)))

    # --- files -------------------------------------------------------------------------------------------------------

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Places, poses and depths, for a file."""
        return {
            "poses": self.poses.array(), "median_depths": self.activity.median_depths,
            **{f"places_{name}": values for name, values in self.places.to_arrays().items()},
        }  # fmt: skip

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes over what `to_arrays` gave, before any keyframe was added; the surface has its own already. All
        keyframes are put aside until one of them is found.

        Raises:
            FormatError: arrays that do not fit together.
        """
        forms = {"poses": PoseForm("float", "n"), "median_depths": Form("float", "n", finite=True)}
        check_arrays(arrays, forms, "loops")
        places = {name.removeprefix("places_"): a for name, a in arrays.items() if name.startswith("places_")}
        self.places = PlaceIndex.from_arrays(self._camera, places, self.settings.places)
        if not np.array_equal(arrays["poses"], self.poses.array()):
            raise FormatError("places and surfaces belong to different keyframes")
        for number, (T, depth) in enumerate(zip(self.poses, arrays["median_depths"], strict=True)):
            self.graph.add_node(T)
            T_before_this = inverse(self.poses[number - 1]) @ T if number else np.eye(4)
            self.revisits.add(T_before_this)
            if number:
                self.graph.add_odometry(number - 1, number, T_before_this, SURE_INFORMATION)
            self.parts.add(number - 1)
            self._taken.append((None, 0))
            self.activity.add(T, float(depth))
        if not len(self) == len(self.places) == len(self._surface):
            raise FormatError("places, poses and surfaces belong to different keyframes")
        self.activity.active = set()


def _moment(frame: Frame) -> int:
    """When a frame was taken: its number, or that of its instant."""
    return frame.index if frame.instant is None else frame.instant
