# SPDX-License-Identifier: Apache-2.0
"""What is published of a finished run: each channel's content is made when somebody asks for it first."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from pathlib import Path as FilePath

import numpy as np

from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.changes.saved_changes import changes_of, read_changes, sentence_of
from ggslam.jobs.serve.channels import (
    CAMERA,
    CHANGED,
    CHANGES,
    DISTANCE,
    LENS,
    MAP,
    MESH,
    MOVERS,
    OBJECTS,
    ODOM,
    OPTICAL,
    PATH,
    POINT_TILES,
    POINTS,
    POSE,
    SPLAT_TILES,
    SPLATS,
    TF_STATIC,
    VERDICTS,
    grid_channel,
)
from ggslam.jobs.serve.frames_tree import T_OPTICAL_CAMERA, fixed_frames
from ggslam.jobs.serve.live_volumes import put_gone
from ggslam.jobs.serve.map_contents import MapContents, MapCopy
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_volumes import RunVolumes
from ggslam.jobs.serve.seen_points import PointCloud, saved_points
from ggslam.jobs.serve.things import known_changes, known_movers, known_objects
from ggslam.messages.contents import Channel, Lens, Level, Path, Points, Pose, Things, Transforms, Verdict, Verdicts
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.verdict import AspectRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning

_LEVELS: dict[str | None, Level] = {"good": "ok", "doubtful": "warning", "bad": "error", None: "ok"}


class RunContentsTuning(Tuning):
    """How finished runs are published."""

    harmonics = 4
    """Most coefficients of a splat's colour: degree 1. All 16 take four times the bytes."""
    verdict_every_s = 1.0
    """Seconds between two messages of diagnostics, which go stale without."""


class RunContents:
    """A finished run.

    Args:
        folder: the run.
        volumes: made of it.
        changes: folder that `ggslam changes` wrote; None: what an updated run holds.

    Raises:
        RunFolderError: the run is damaged, or none of its frames was located.
    """

    def __init__(self, folder: RunFolder, volumes: RunVolumes, changes: FilePath | None = None) -> None:
        self.folder, self.volumes, self._changes = folder, volumes, changes
        record = folder.keyframes()
        poses, times = record.poses(), {f.frame: f.timestamp for f in record.frames}
        if not poses:
            raise ConfigError(f"{folder.path}: no frame of this run was located, so there is nothing to publish")
        frames = sorted(poses)
        self.camera = folder.sequence().camera
        self.poses = np.array([poses[frame] for frame in frames])
        """T_map_optical of the frames that were located, [N, 4, 4]..."""
        self.stamps = np.array([_number(times.get(frame), frame) for frame in frames])
        """...and their times [N], seconds; of a map without times the frames' numbers."""
        self._times = dict(zip(frames, self.stamps.tolist(), strict=True))
        self._map: GaussianMap | None = None
        self._surface: PointCloud | None = None
        self.problems: dict[str, str] = {}
        """Why a channel has no content, by its name."""
        self._makers: dict[str, Callable[[MapPublisher, Channel], None]] = {
            TF_STATIC.name: self._frames, POSE.name: self._pose, PATH.name: self._path, LENS.name: self._lens,
            OBJECTS.name: self._objects, MOVERS.name: self._movers, CHANGES.name: self._known_changes,
            VERDICTS.name: self._verdicts, MESH.name: self._mesh, DISTANCE.name: self._distance,
        }  # fmt: skip
        self._of_map = {channel.name for channel in (POINTS, POINT_TILES, SPLATS, SPLAT_TILES)}
        self._map_contents: MapContents | None = None
        self.grids = {grid_channel(name).name: name for name in volumes.robots()}

    @property
    def stamp(self) -> float:
        """Of everything but poses: that of the last frame."""
        return float(self.stamps[-1])

    def channels(self) -> list[Channel]:
        """All that there may be something of. Poses are latched: a finished run says them once."""
        pose = Channel(POSE.name, Pose, latched=True)
        known = [TF_STATIC, pose, PATH, LENS, POINTS, POINT_TILES, SPLATS, SPLAT_TILES, OBJECTS, MOVERS]
        grids = [grid_channel(name) for name in self.grids.values()]
        return [*known, CHANGES, VERDICTS, *grids, DISTANCE, MESH]  # the largest last

    def make(self, publisher: MapPublisher, channel: Channel) -> None:
        """Hands over what there is of a channel; what cannot be made is noted in `problems`."""
        try:
            if channel.name in self._of_map:
                self._points_and_splats(publisher, channel)
            elif channel.name in self.grids:
                grid = self.volumes.grid(self.grids[channel.name])
                publisher.forget(channel, CHANGED)  # of the run while it went on
                publisher.put(channel, grid, self.stamp)
            elif maker := self._makers.get(channel.name):
                maker(publisher, channel)
        except GgslamError as error:
            self.problems[channel.name] = str(error)

    # --- channel by channel ------------------------------------------------------------------------------------------

    def _frames(self, publisher: MapPublisher, channel: Channel) -> None:
        """All of the tree stands still: `odom` lies on `map`, the camera where it was last."""
        fixed = fixed_frames(self.volumes.T_floor_map(self._gaussians, self.poses))
        last = ((MAP, ODOM, np.eye(4)), (ODOM, CAMERA, self.poses[-1] @ T_OPTICAL_CAMERA))
        publisher.put(channel, Transforms((*last, *fixed.edges), fixed=True), self.stamp)

    def _pose(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, Pose(MAP, self.poses[-1] @ T_OPTICAL_CAMERA), self.stamp)

    def _path(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, Path(MAP, self.poses @ T_OPTICAL_CAMERA, self.stamps), self.stamp)

    def _lens(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, Lens(OPTICAL, self.camera), self.stamp)

    def _points_and_splats(self, publisher: MapPublisher, channel: Channel) -> None:
        self._map_contents = self._map_contents or MapContents(publisher)
        shown = self._gaussians()
        ids = shown.object_id.numpy().astype(np.uint16)
        surface = self._seen_points() if channel.kind is Points else None
        shown_map, most = MapCopy(shown, ids, surface), RunContentsTuning.harmonics
        self._map_contents.show(shown_map, self.stamp, final=True, harmonics=most, only=(channel,))

    def _seen_points(self) -> PointCloud:
        if self._surface is None:
            self._surface = saved_points(self.folder)
        return self._surface

    def _gaussians(self) -> GaussianMap:
        if self._map is None:
            self._map = self.folder.gaussians()
        return self._map

    def _objects(self, publisher: MapPublisher, channel: Channel) -> None:
        if self.folder.has_objects():
            publisher.put(channel, known_objects(self.folder.object_table()), self.stamp)

    def _movers(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, known_movers(self.folder.movers().movers, self._times), self.stamp)

    def _known_changes(self, publisher: MapPublisher, channel: Channel) -> None:
        shown = changes_of(self.folder, 0) if self._changes is None else read_changes(self._changes, 0)
        found = Things(MAP, ()) if shown is None else known_changes((c, sentence_of(c)) for c in shown.record.changes)
        publisher.put(channel, found, self.stamp)

    def _verdicts(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, self.verdicts(), self.stamp)

    def _mesh(self, publisher: MapPublisher, channel: Channel) -> None:
        before = {given.part for given in publisher.newest(channel)}  # of the run while it went on
        parts = self.volumes.mesh_parts()
        for part in parts:
            publisher.put(channel, part, self.stamp, part.part)
        for name in before - {part.part for part in parts}:
            put_gone(publisher, name, self.stamp)

    def _distance(self, publisher: MapPublisher, channel: Channel) -> None:
        publisher.put(channel, self.volumes.distance_slice(self.poses), self.stamp)

    def verdicts(self) -> Verdicts:
        """How good the run is, by its own figures."""
        found = self.folder.verdict()
        if found is None:
            return Verdicts((Verdict("ggslam: run", "warning", "this map was not judged"),))
        whole = Verdict("ggslam: run", _LEVELS[found.grade], found.failure or found.summary(), {"grade": found.grade})
        return Verdicts((whole, *(_verdict_of(name, aspect) for name, aspect in found.aspects().items())))


def _verdict_of(name: str, aspect: AspectRecord) -> Verdict:
    values = {"grade": aspect.grade or "", "value": "" if aspect.value is None else f"{aspect.value:g} {aspect.unit}"}
    return Verdict(f"ggslam: {name}", _LEVELS[aspect.grade], aspect.text, values)


def _number(time: float | None, frame: int) -> float:
    return float(frame) if time is None else float(time)


class ServedRun:
    """Publishes a finished run: a thread makes what is asked for.

    Args:
        contents: of the run.
        publisher: that takes them.
        made: names of channels whose content is published already.
    """

    def __init__(self, contents: RunContents, publisher: MapPublisher, made: Iterable[str] = ()) -> None:
        self.contents, self._publisher = contents, publisher
        self._asked: queue.SimpleQueue[Channel | None] = queue.SimpleQueue()
        self._made = set(made)
        publisher.on_join(self._asked.put)
        for channel in publisher.channels:
            if publisher.is_wanted(channel):
                self._asked.put(channel)
        self._thread = threading.Thread(target=self._work, name="publish-run", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while True:
            try:
                channel = self._asked.get(timeout=RunContentsTuning.verdict_every_s)
            except queue.Empty:
                if self._publisher.is_wanted(VERDICTS):
                    self.contents.make(self._publisher, VERDICTS)
                continue
            if channel is None:
                return
            if channel.name not in self._made:  # the publisher keeps it for who comes later
                self._made.add(channel.name)
                self.contents.make(self._publisher, channel)

    def wait_made(self, timeout_s: float) -> bool:
        """Waits until what was asked for so far is made; returns whether it is."""
        self._asked.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """Makes no more."""
        self._asked.put(None)
