# SPDX-License-Identifier: Apache-2.0
"""Follows a run and publishes it as it grows, at a small, bounded cost.

Poses and frames go out after every frame. For the rest the thread of the run copies the map now and then, and another
thread makes contents of the copy. Images wait until those before, writing messages included, have used no more than
`LiveContentsTuning.image_share` of the program's processor time, and copies until those before and what was made of
them have used no more than `LiveContentsTuning.map_share`. What nobody listens to is neither copied nor made.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ggslam.driving.robot import Robot
from ggslam.jobs.serve.channels import (
    DEPTH,
    LENS,
    MAP,
    MOVERS,
    OBJECTS,
    OPTICAL,
    PATH,
    POINT_TILES,
    POINTS,
    POSE,
    RECORDED,
    RENDERED,
    TF,
    TF_STATIC,
    VERDICTS,
    Flow,
)
from ggslam.jobs.serve.frames_tree import T_OPTICAL_CAMERA, FramesTree, fixed_frames
from ggslam.jobs.serve.keyframe_volumes import Floor, KeyframeVolumes, PlacedKeyframe, keyframes_now
from ggslam.jobs.serve.live_volumes import GrowingVolumes
from ggslam.jobs.serve.map_contents import MapContents, MapCopy
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.seen_points import PointCloud, SeenPoints, saved_points
from ggslam.jobs.serve.things import MoversNow, growing_objects
from ggslam.jobs.serve.tiles import TileTuning
from ggslam.messages.contents import Lens, Path, Picture, Pose, Verdict, Verdicts
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import GaussianTensors
from ggslam.reporting.pictures import color_to_uint8
from ggslam.runs.folder import RunFolder
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.slam.map_copy import shown_gaussians
from ggslam.slam.result import SlamResult, StepReport
from ggslam.slam.slam import Slam
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.tracking.tracker import TrackingStatus
from ggslam.viewer.splats import opacities_of
from ggslam.volumes.floor_frame import floor_from_map
from ggslam.volumes.map_upright import upright_of

_log = logging.getLogger(__name__)


class LiveContentsTuning(Tuning):
    """What publishing a growing map costs and shows."""

    map_share = 0.03
    """Share of the program's processor time that copies of the map, and what is made of them, may take."""
    image_share = 0.01
    """The same of the camera's images."""
    ahead_s = 0.1
    """Processor seconds that either may use before."""
    look_s = 0.2
    """Seconds between two looks whether there is time for the next copy."""
    min_rest_s = 1.0
    """Shortest rest between two copies of the map, in seconds."""
    picture_every_s = 0.2
    """Seconds between two images of the camera."""
    rendered_width = 320
    """Width of rendered images, in pixels."""
    max_path_poses = 1000
    """Most poses of the path."""
    verdict_every_s = 1.0
    """Seconds between two verdicts."""
    floor_keyframes = 5
    """Keyframes from which the floor is looked for."""
    floor_samples = 4000
    """Gaussians by which the floor is looked for while the map grows: three times as fast as all that a finished map
    is asked by."""
    end_after_s = 1e-6
    """Seconds after the last frame at which tree and pose as they came out are stamped: of two of one time, tf2
    may keep the first."""


@dataclass
class _Snapshot:
    """A copy that the run does not change any more; what nobody wants is None."""

    gaussians: GaussianTensors
    ids: np.ndarray
    poses: np.ndarray
    stamps: np.ndarray
    camera: Camera
    T_map_optical: np.ndarray | None
    stamp: float
    whole: bool
    keyframes: list[PlacedKeyframe]
    scale: float
    labels: np.ndarray | None


class LiveContents:
    """A follower of a run (`follow` is a `Follower` of `ggslam.jobs.run.pipeline.execute`).

    Args:
        publisher: that takes the contents.
        robots: by name, that grids are made for.
    """

    def __init__(self, publisher: MapPublisher, robots: Mapping[str, Robot] | None = None) -> None:
        self._publisher = publisher
        self.volumes = GrowingVolumes(publisher, robots or {})
        self.tree = FramesTree()
        self._moves, self._unbroken = 0, False
        self._movers, self._has_movers = MoversNow(), False
        self._map, self._seen = MapContents(publisher), SeenPoints()
        self._labels: np.ndarray | None = None
        self._rasterizer: CpuRasterizer | None = None
        self._floor: Floor | None = None
        self._floor_due, self._corrections, self._scale = True, 0, 1.0
        self._picture_at = self._verdict_at = -1e9
        self._ready = threading.Event()
        self._ready.set()
        self._given = threading.Condition()
        self._snapshot: _Snapshot | None = None
        self._ended, self._first, self._cameras = False, True, 1
        self.copies = 0
        """How many times the map was copied."""
        self.follow_s = 0.0
        """Seconds that the run's own thread spent here."""
        self._map_s, self._follow_s, self._began_cpu = 0.0, 0.0, time.process_time()
        self._thread = threading.Thread(target=self._work, name="publish-map", daemon=True)
        self._thread.start()

    # --- the thread of the run ---------------------------------------------------------------------------------------

    def follow(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """After a frame. Of a rig the first camera is followed."""
        began, began_cpu = time.perf_counter(), time.thread_time()
        if frame.camera_number == 0:
            self._follow(slam, frame, report)
        self.follow_s += time.perf_counter() - began
        self._follow_s += time.thread_time() - began_cpu

    @property
    def cpu_s(self) -> float:
        """Processor seconds that publishing took so far."""
        return self._map_s + self._follow_s + sum(self._publisher.cpu_s(flow) for flow in Flow)

    def _may_spend(self, taken_s: float, share: float) -> bool:
        used = time.process_time() - self._began_cpu
        return taken_s < LiveContentsTuning.ahead_s + share * used

    def _may_copy(self) -> bool:
        return self._may_spend(self._map_s + self._publisher.cpu_s(Flow.map), LiveContentsTuning.map_share)

    def _may_send_pictures(self) -> bool:
        return self._may_spend(self._publisher.cpu_s(Flow.images), LiveContentsTuning.image_share)

    def _follow(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        stamp = frame.timestamp
        if self._first:
            self._first, self._moves, self._cameras = False, slam.moves_followed, len(slam.cameras)
            self._publisher.put(TF_STATIC, fixed_frames(None), stamp)
            self._publisher.put(LENS, Lens(OPTICAL, slam.camera), stamp)
        T = self._locate(slam, report)
        if T is not None:
            self._publisher.put(TF, self.tree.transforms, stamp, keep=False)
            self._publisher.put(POSE, Pose(MAP, T @ T_OPTICAL_CAMERA), stamp, keep=False)
            self._send_movers(slam, frame, T)
        now = time.monotonic()
        if now - self._picture_at >= LiveContentsTuning.picture_every_s and self._may_send_pictures():
            self._picture_at = now
            self._send_pictures(frame)
        if now - self._verdict_at >= LiveContentsTuning.verdict_every_s:
            self._verdict_at = now
            self._publisher.put(VERDICTS, self._verdicts(slam, report), stamp)
        self._copy(slam, report, T, stamp)

    def _locate(self, slam: Slam, report: StepReport) -> np.ndarray | None:
        """T_map_optical [4, 4] as far as is known by now; None: the camera is lost."""
        moves = slam.corrections.moves[self._moves : slam.moves_followed]
        self._moves = slam.moves_followed
        if report.frame.status == TrackingStatus.LOST.value:
            self._unbroken = False
            for T_new_old in moves:
                self.tree.move_world(T_new_old)
            return None
        T, found_anew = slam.pose_of(report.frame), report.frame.status == TrackingStatus.RECOVERED.value
        self.tree.step(report.T_world_camera, T, moves, self._unbroken and not found_anew)
        self._unbroken = True
        return T

    def _send_movers(self, slam: Slam, frame: Frame, T_map_optical: np.ndarray) -> None:
        tracks = slam.movers.tracks.tracks
        if not (tracks or self._has_movers) or not self._publisher.is_wanted(MOVERS):
            return
        seen = {track.number: track.sights[-1] for track in tracks if track.sights}
        things = self._movers.step(seen, frame.index, frame.timestamp, T_map_optical)
        if things.things or self._has_movers:
            self._publisher.put(MOVERS, things, frame.timestamp)
        self._has_movers = bool(things.things)

    def _send_pictures(self, frame: Frame) -> None:
        for channel, image in ((RECORDED, frame.color), (DEPTH, frame.depth)):
            if self._publisher.is_wanted(channel):
                self._publisher.put(channel, Picture(OPTICAL, image), frame.timestamp, keep=False)

    def _verdicts(self, slam: Slam, report: StepReport) -> Verdicts:
        tracked = report.frame
        levels = {"ok": "ok", "first": "ok", "lost": "error"}
        level = levels.get(tracked.status, "warning")
        overlap = f"{tracked.overlap:.2f}"
        text = f"{tracked.status}{f': {tracked.reason}' if tracked.reason else ''}"
        frame, dropped = str(tracked.frame_index), len(slam.dropped_frames)
        values = {"frame": frame, "status": tracked.status, "overlap": overlap, "dropped": str(dropped)}
        keyframes = len(slam.mapper.keyframes)
        of_map = {"keyframes": str(keyframes), "gaussians": str(report.gaussians), "corrections": str(self._moves)}
        size = f"{quantity(keyframes, 'keyframe')}, {report.gaussians:,} Gaussians"
        return Verdicts((
            Verdict("ggslam: tracking", level, text, values),  # type: ignore[arg-type]
            Verdict("ggslam: map", "ok", size, of_map),
        ))  # fmt: skip

    def _copy(self, slam: Slam, report: StepReport, T: np.ndarray | None, stamp: float) -> None:
        """Copies the map if the other thread is ready and anybody wants what is made of it."""
        heavy = self._map.is_wanted or any(self._publisher.is_wanted(c) for c in (OBJECTS, PATH, RENDERED))
        if len(slam.corrections) > self._corrections:
            self._corrections, self._floor_due = len(slam.corrections), True
        heavy = heavy or self.volumes.is_wanted
        if not self._ready.is_set() or not slam.mapper.keyframes or not (heavy or self._floor_due):
            return
        self._ready.clear()
        began = time.thread_time()
        snapshot = self._snapshot_of(slam, T, stamp)
        self._map_s += (took := time.thread_time() - began)
        self._follow_s -= took
        self.copies += 1
        with self._given:
            self._snapshot = snapshot
            self._given.notify()

    def _snapshot_of(self, slam: Slam, T: np.ndarray | None, stamp: float) -> _Snapshot:
        copies = shown_gaussians(slam, harmonics=1)
        ids = np.zeros(len(copies.means), np.uint16)
        if self._publisher.is_wanted(OBJECTS) and slam.mapper.identity is not None:
            with slam.mapper.in_turn():
                labels = slam.mapper.vote_labels()[: len(ids)]
            ids[: len(labels)] = labels
        poses, stamps = _path_of(slam)
        keyframes = keyframes_now(slam.mapper.keyframes) if self.volumes.is_wanted or self._wants_points else []
        self._scale = slam.scale
        if slam.mapper.identity is not None:
            self._labels = slam.mapper.identity.current(np.arange(1 << 16, dtype=np.uint16))
        return _Snapshot(
            copies, ids, poses, stamps, slam.camera, T, stamp, slam.pager is None, keyframes, slam.scale, self._labels
        )  # fmt: skip

    @property
    def _wants_points(self) -> bool:
        return any(self._publisher.is_wanted(channel) for channel in (POINTS, POINT_TILES))

    # --- the thread that makes contents ------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._given:
                self._given.wait_for(lambda: self._snapshot is not None or self._ended)
                snapshot, self._snapshot = self._snapshot, None
                if self._ended or snapshot is None:
                    return
            began, began_cpu = time.monotonic(), time.thread_time()
            try:
                self._show(snapshot)
            except Exception:  # the run goes on
                _log.exception("a map could not be published")
            self._map_s += time.thread_time() - began_cpu
            self._rest(began)
            self._ready.set()

    def _rest(self, since: float) -> None:
        """Returns when the next copy may be made."""
        with self._given:
            while not self._ended:
                rested = time.monotonic() - since >= LiveContentsTuning.min_rest_s
                if rested and self._may_copy():
                    return
                self._given.wait(LiveContentsTuning.look_s)

    def _show(self, s: _Snapshot) -> None:
        put, wanted = self._publisher.put, self._publisher.is_wanted
        if self._floor_due and len(s.poses) >= LiveContentsTuning.floor_keyframes:
            self._floor_due = False
            self._send_floor(s.gaussians, s.poses, s.stamp, LiveContentsTuning.floor_samples)
        if wanted(PATH) and len(s.poses):
            put(PATH, Path(MAP, s.poses @ T_OPTICAL_CAMERA, s.stamps), s.stamp)
        if self._map.is_wanted:
            surface = self._seen.cloud(s.keyframes, s.labels) if s.keyframes else None
            self._map.show(MapCopy(s.gaussians, s.ids, surface, s.whole), s.stamp)
        if wanted(OBJECTS) and s.ids.any():
            solid = opacities_of(s.gaussians) >= TileTuning.min_opacity
            put(OBJECTS, growing_objects(s.gaussians.means.numpy()[solid], s.ids[solid]), s.stamp)
        if wanted(RENDERED) and s.T_map_optical is not None:
            put(RENDERED, Picture(OPTICAL, self._render(s, s.T_map_optical)), s.stamp, keep=False)
        self.volumes.show(s.keyframes, s.scale, self._floor, s.poses, s.stamp)

    def _send_floor(
        self, gaussians: GaussianTensors, poses: np.ndarray, stamp: float, samples: int | None = None
    ) -> None:
        upright = upright_of(gaussians, poses, samples)
        self._floor = Floor(floor_from_map(upright, poses), upright.floor is not None)
        self._publisher.put(TF_STATIC, fixed_frames(self._floor.T_floor_map), stamp)

    def _render(self, s: _Snapshot, T_map_optical: np.ndarray) -> np.ndarray:
        if self._rasterizer is None:  # kernels of one context take turns; the run must not wait for these
            self._rasterizer = CpuRasterizer(context=NativeContext(1))
        width = min(s.camera.width, LiveContentsTuning.rendered_width)
        small = s.camera.resize(width, round(s.camera.height * width / s.camera.width))
        view = self._rasterizer.forward(s.gaussians, small, inverse(T_map_optical), features=False)
        return color_to_uint8(view.image.numpy())

    # --- the end -----------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Follows no more."""
        with self._given:
            self._ended = True
            self._given.notify()
        self._thread.join(timeout=10.0)

    def finish(self, result: SlamResult, folder: RunFolder | None = None) -> None:
        """The run ended: publishes poses and map as they came out. `folder`: where it was saved, if it was."""
        self.stop()
        poses, stamps = result.trajectory()[:: self._cameras], result.timestamps()[:: self._cameras]
        known = np.isfinite(poses).all(axis=(1, 2))
        if not known.any():
            return
        stamp = float(stamps[known][-1])
        self.tree.correct(poses[known][-1])
        put = self._publisher.put
        put(TF, self.tree.transforms, stamp + LiveContentsTuning.end_after_s)
        put(POSE, Pose(MAP, poses[known][-1] @ T_OPTICAL_CAMERA), stamp + LiveContentsTuning.end_after_s)
        put(PATH, Path(MAP, poses[known] @ T_OPTICAL_CAMERA, stamps[known]), stamp)
        if len(result.gaussians):
            g = result.gaussians
            views = (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh, g.features[:, :0])
            copies = GaussianTensors(*(view.detach().to("cpu") for view in views))
            self._send_floor(copies, poses[known], stamp)
            ids = g.object_id.cpu().numpy().astype(np.uint16)
            surface = self._last_points(result, folder) if self._wants_points else None
            self._map.show(MapCopy(copies, ids, surface), stamp, final=True)
        self.volumes.show(keyframes_now(result.keyframes), self._scale, self._floor, poses[known], stamp, final=True)

    def _last_points(self, result: SlamResult, folder: RunFolder | None) -> PointCloud:
        if folder is not None:
            return saved_points(folder)
        return self._seen.cloud(keyframes_now(result.keyframes), self._labels)

    def keyframe_volumes(self, result: SlamResult) -> KeyframeVolumes | None:
        """Volumes of the finished run's keyframes; None: no floor is known, for there is no map."""
        return None if self._floor is None else KeyframeVolumes(result.keyframes, self._scale, self._floor)


def _path_of(slam: Slam) -> tuple[np.ndarray, np.ndarray]:
    """Poses [N, 4, 4] of the frames so far, thinned, and their times [N], seconds."""
    frames = slam.frames[:: len(slam.cameras)]  # of the first camera
    located = [frame for frame in frames if frame.status != TrackingStatus.LOST.value]
    located = located[:: max(1, -(-len(located) // LiveContentsTuning.max_path_poses))]
    poses = [slam.pose_of(frame) for frame in located]
    return np.array(poses).reshape(-1, 4, 4), np.array([frame.timestamp for frame in located])
