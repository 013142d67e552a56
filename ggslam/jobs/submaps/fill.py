# SPDX-License-Identifier: Apache-2.0
"""The work behind `ggslam submaps`: fills grid stores and says what is in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.driving.body import CameraBody
from ggslam.driving.body_options import read_body
from ggslam.errors import ConfigError, FormatError, SequenceError
from ggslam.formats.trajectory import read_trajectory
from ggslam.jobs.progress import Observer
from ggslam.jobs.submaps.sensor_settings import in_words, settings_of_cloud, settings_of_scans, with_chosen
from ggslam.jobs.submaps.stores import (
    INDOORS,
    Cloud,
    is_cloud,
    is_store,
    open_or_create,
    read_cloud,
    store_of_cloud,
    store_of_run,
)
from ggslam.localization.scans import LaserScan, ScanSequence, refuse_unread_scans, scan_files
from ggslam.localization.visits import FrameSights, ScanSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.runs.folder import MARKER
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.frame import Frame
from ggslam.sequences.rig import one_camera
from ggslam.submaps.cell_records import CellChange
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings
from ggslam.submaps.store_objects import ObjectEvent, StoreObjects, read_objects
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

AddRun = Callable[[Path, GridStore, "str | None", "float | None"], object]
"""Writes a run (its folder) into a store that is open for writing, as a visit of a name at a time."""


class StoreFillTuning(Tuning):
    """What a recording must bring to a store."""

    max_missed = 0.1
    """Largest share of frames that leave nothing in the store without a note."""
    max_time_gap_s = 0.02
    """Largest difference between the times of a frame and of a pose from another file, in seconds."""


@dataclass(frozen=True)
class SubmapsRequest:
    """A request to fill a grid store.

    Attributes:
        source: folder of a run, a cloud, or folder of a recording.
        store: folder of the store.
        visit: name; None: the source's.
        poses: trajectory file of a recording, in the store's world; None: the recording's own poses.
        at: seconds at which the visit began, on the clock of all visits; None: the recording's own clock.
        settings: fields of `SubmapSettings` that are not the default's (of a new store) or the store's.
        sequence: how the recording is read.
        columns: numbers of a point in .bin scans; None: as they tell themselves.
        body: of the robot, left out of a recording's scans or depth, see `driving.body_options.read_body`;
            `body_frame`: the sensor's link in a URDF file.
    """

    source: Path
    store: Path
    visit: str | None
    poses: Path | None
    at: float | None
    settings: Mapping[str, Any]
    sequence: SequenceRequest
    columns: int | None = None
    body: tuple[str, ...] = ()
    body_frame: str | None = None


@dataclass(frozen=True)
class PartTotal:
    """Of one part, over all cells: cells that have it, things in it, bytes."""

    cells: int
    count: int
    bytes: int


@dataclass(frozen=True)
class VisitTotal:
    """Cells that a visit added, and those it refreshed."""

    name: str
    added: int
    refreshed: int


@dataclass(frozen=True)
class StoreListing:
    """What is in a store."""

    path: Path
    settings: SubmapSettings
    cells: int
    bytes: int
    parts: Mapping[str, PartTotal]
    visits: Sequence[VisitTotal]
    since: str | None
    changes: Sequence[CellChange] | None
    problems: Sequence[str] = ()
    """What is wrong with files of it; the rest can be used."""
    objects: StoreObjects | None = None
    """None: nothing is known of objects, or the file that tells is damaged (see `problems`)."""
    events: Sequence[ObjectEvent] | None = None
    """What happened to objects since the visit asked for; None: no visit was, or nothing is known of objects."""
    unknown: Sequence[str] = ()
    """Visits, of those asked for, that nothing is known of as far as objects go."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON; how far things moved is in it, too."""
        values = asdict(self)
        for event, entry in zip(self.events or [], values["events"] or [], strict=True):
            motion = event.motion()
            entry["moved_m"], entry["turned_deg"] = (None, None) if motion is None else motion
        return values


def make_store(request: SubmapsRequest, observer: Observer, add_run: AddRun = store_of_run) -> None:
    """Makes a store, or adds a visit to one.

    Args:
        request: what is asked for.
        observer: receives progress updates.
        add_run: writes a run into a store as a visit.

    Raises:
        GgslamError: the source or the store cannot be read, or the recording has no poses.
    """
    source = request.source
    if is_store(source):
        raise ConfigError(f"{source}: is a grid store already; `out` wants a run, a cloud or a recording")
    if is_cloud(source) and not source.is_file():
        raise FormatError(f"cannot read {source}: no such file")
    cloud = read_cloud(source, request.columns) if is_cloud(source) else None
    settings = _settings(request, cloud, observer)
    recording = None if cloud is not None or (source / MARKER).is_file() else _open(request, settings)
    if recording is None and request.body:
        raise ConfigError(f"`body` is left out of a recording's scans or depth; {source} is none")
    with open_or_create(request.store, settings) as store:
        if recording is not None:
            items, poses, sights = recording
            observer.begin("record", len(poses))
            watched = _with_progress(items, observer, len(poses))
            written = record_visit(store, watched, poses, sights, request.visit or source.resolve().name, request.at)
            observer.note(f"{quantity(len(written), 'cell')} written")
            if missed := _words_of_missed(store, poses):
                observer.note(missed)
        elif cloud is not None:
            store_of_cloud(source, store, request.visit, request.at, cloud=cloud)
        else:
            add_run(source, store, request.visit, request.at)


def list_store(path: Path, since: str | None = None) -> StoreListing:
    """What is in a store; `since` a visit: with the cells that changed.

    Raises:
        FormatError: no store, or damaged.
        ConfigError: there was no such visit.
    """
    if Path(path).exists() and not is_store(path):
        raise ConfigError(f"{path}: no grid store (no index.sqlite); `out` names the store to make of it")
    with GridStore.open(path) as store:
        records = [store.cell(key) for key in store.cells()]
        parts: dict[str, PartTotal] = {}
        for record in records:
            for name, part in record.parts.items():
                total = parts.get(name, PartTotal(0, 0, 0))
                parts[name] = PartTotal(total.cells + 1, total.count + part.count, total.bytes + part.bytes)
        visits = [_visit_total(store, name, following) for name, following in _with_next(store.visits())]
        changes = None if since is None else store.changed_since(since)
        size = sum(record.bytes for record in records)
        problems, objects = list(store.problems()), None
        try:
            objects = read_objects(store)
        except FormatError as error:  # the cells are as good as before
            problems.append(str(error))
        names = store.visits()
        asked = names if since is None else names[names.index(since) :]
        known = set() if objects is None else {entry.visit for entry in objects.visits if entry.compared is not None}
        return StoreListing(
            Path(path), store.settings, len(records), size, dict(sorted(parts.items())), visits, since, changes,
            problems, objects, None if objects is None or since is None else objects.events_since(asked),
            [name for name in asked if name not in known],
        )  # fmt: skip


def _with_next(names: list[str]) -> Iterator[tuple[str, str | None]]:
    yield from zip(names, [*names[1:], None], strict=False)  # none have none


def _visit_total(store: GridStore, name: str, following: str | None) -> VisitTotal:
    """What a visit alone did is not kept: cells that a later visit also wrote count with the later ones only."""
    later = {c.key for c in store.changed_since(following)} if following else set()
    own = [c for c in store.changed_since(name) if c.key not in later]
    return VisitTotal(name, sum(c.added for c in own), sum(not c.added for c in own))


def _settings(request: SubmapsRequest, cloud: Cloud | None, observer: Observer) -> SubmapSettings:
    """Of the store if there is one, else what suits the sensor; with what was set on purpose."""
    if is_store(request.store):
        with GridStore.open(request.store) as store:
            return replace(store.settings, **request.settings)
    base = INDOORS
    if cloud is not None:
        base = settings_of_cloud(cloud[0])
    elif scan_files(request.source):
        base = settings_of_scans(_scans(request))
    settings = with_chosen(base, request.settings)
    if base != INDOORS:
        whose = "cloud" if cloud is not None else "scanner"
        observer.note(f"the store's settings suit the {whose}: {in_words(settings)}")
    return settings


def _scans(request: SubmapsRequest) -> ScanSequence:
    wanted = request.sequence
    return ScanSequence(request.source, wanted.start, wanted.stop, wanted.stride, request.columns)


def _open(
    request: SubmapsRequest, settings: SubmapSettings
) -> tuple[Iterator[Frame | LaserScan], np.ndarray, FrameSights | ScanSights]:
    """Items, their poses and what takes sights from them."""
    wanted, body = request.sequence, read_body(request.body, request.body_frame)
    if scan_files(request.source):
        scans = _scans(request)
        items = scans.stream()
        if body is not None:
            items = (replace(scan, points=body.without(scan.points)) for scan in items)
        return items, _poses(request, scans.timestamps, scans.ground_truth), ScanSights(settings.axes)
    refuse_unread_scans(request.source)
    frames = one_camera(wanted.open(), "a store of cells")
    sights = FrameSights(frames.camera, NativeContext())
    poses = _poses(request, frames.timestamps, frames.ground_truth, frames.pose_problem)
    stream = frames.stream(masks=False)
    return stream if body is None else map(CameraBody(body).without, stream), poses, sights


def _poses(
    request: SubmapsRequest, timestamps: np.ndarray, own: np.ndarray | None, problem: str = ""
) -> np.ndarray:
    """Of the items, [n, 4, 4]; `problem`: why the recording's own cannot be used."""
    if request.poses is None:
        if own is None or not np.isfinite(own).all((1, 2)).any():
            why = f" ({problem})" if problem else ""
            raise SequenceError(
                f"{request.source}: no poses{why}; `ggslam localize` finds them, `poses` names their file"
            )
        return own
    found = read_trajectory(request.poses)
    poses = np.full((len(timestamps), 4, 4), np.nan)
    order = np.argsort(found.timestamps, kind="stable")
    times = found.timestamps[order]
    after = np.clip(np.searchsorted(times, timestamps), 1, max(len(times) - 1, 1))
    before = after - 1
    last = np.minimum(after, len(times) - 1)
    nearest = np.where(np.abs(times[before] - timestamps) <= np.abs(times[last] - timestamps), before, last)
    near = np.abs(times[nearest] - timestamps) <= StoreFillTuning.max_time_gap_s
    poses[near] = found.T_world_camera[order][nearest[near]]
    if not near.any():
        raise FormatError(f"{request.poses}: none of its times is within {StoreFillTuning.max_time_gap_s} s of a frame")
    return poses


def _words_of_missed(store: GridStore, poses: np.ndarray) -> str:
    """What to say of items, of poses [n, 4, 4], in cells that nothing is recorded of; empty if those are few."""
    known = poses[np.isfinite(poses).all((1, 2)), :3, 3]
    missed = sum(store.key_of(position) not in store for position in known)
    if missed <= StoreFillTuning.max_missed * len(known):
        return ""
    s, grid = store.settings, store.grid
    enough = math.ceil(50 * s.spacing * math.sqrt(grid.spans.sum())) / 100
    return (
        f"{missed} of {quantity(len(known), 'pose')} lie in cells that nothing was recorded of: none came within R "
        f"{s.radius:g} m of their centres; `--set submaps.radius={enough:g}` records every cell that is passed"
    )


def _with_progress(items: Iterator[Frame | LaserScan], observer: Observer, total: int) -> Iterator[Frame | LaserScan]:
    for done, item in enumerate(items, 1):
        yield item
        observer.advance(done, total)
