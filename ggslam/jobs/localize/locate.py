# SPDX-License-Identifier: Apache-2.0
"""Localizes a recording in a stored map: opens both, locates every frame, and writes the results."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Sequence as Several
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.driving.body import Body, CameraBody
from ggslam.driving.body_options import read_body
from ggslam.errors import ConfigError, GgslamError, SequenceError
from ggslam.jobs.localize.report import LocalizationReport, write_localization
from ggslam.jobs.localize.settings import LocalizeSettings, localize_settings
from ggslam.jobs.progress import Observer
from ggslam.jobs.submaps.sensor_settings import settings_of_scans, with_chosen
from ggslam.jobs.submaps.stores import INDOORS, cloud_voxel, is_cloud, is_store, store_of_cloud, store_of_run, visit_of
from ggslam.localization.frames import FrameTracker
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.map_picture import MapPicture
from ggslam.localization.near import Near, parse_near
from ggslam.localization.places import StoredPlaces
from ggslam.localization.reach import AUTO, AdaptiveReach, frame_ranges, parse_radius, scan_ranges
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.scan_maps import scan_places
from ggslam.localization.scan_places import ScanPlaces
from ggslam.localization.scan_tracker import ScanTracker
from ggslam.localization.scans import ScanSequence, refuse_unread_scans, scan_files
from ggslam.localization.surface import SCAN_TARGET, FullSurface, PartialSurface, Surface, point_spacing
from ggslam.native.loader import NativeContext
from ggslam.runs.folder import MARKER, RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.origin import OriginTuning
from ggslam.scene.poses import quaternion_to_matrix, separation
from ggslam.sequences.rig import one_camera
from ggslam.sequences.sequence import Sequence
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.atomic import make_folder
from ggslam.system.interrupts import delay_interrupts
from ggslam.system.plurals import quantity
from ggslam.system.settings import tuning_note
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import TargetSettings

GIVEN = "given"
"""As a start pose: the recording's own first pose."""
_CELLS = "cells"


class LocateTuning(Tuning):
    """How maps to localize in are prepared."""

    fingerprint_letters = 8
    """Letters of a run's fingerprint in the name of its store."""
    max_start_m = 1e7
    """Largest distance of a start pose from the map's origin, in metres."""
    whole_voxel_m = OriginTuning.grid_m / 4
    """Coarser voxels for scans are a whole number of these, in metres, so that origins lie on the grid of the coarse
    voxels, which are four times as wide."""
    min_voxel_ratio = 1.5
    """A target's voxels are at least this many times as wide as the voxels that thinned the map; for scans also as the
    distance between points."""


@dataclass(frozen=True)
class LocalizeRequest:
    """A request to localize a recording.

    Attributes:
        map: folder of a grid store or a run, or a cloud.
        sequence: the recording.
        start_pose: pose of the first frame or scan: 7 numbers (position, quaternion xyzw), or `GIVEN`, or None.
        no_start_pose: the first frame is looked up among the map's places, as it is without a start pose.
        near: roughly where the recording was made: "x y sigma" or "x y z sigma", metres in the map's world; only
            places within three sigma are looked at; None: all.
        full: against the whole map.
        out: folder for the results; None: localized/NAME. The cells of a run's map are kept beside it.
        radius: R' in metres; None: the store's; "auto": by what the sensor sees, see `AdaptiveReach`.
        voxel: edge of the target's voxels in metres; None: 0.03 for images, 0.15 for scans, or what the map allows.
        columns: numbers of a point in .bin scans; None: as they tell themselves.
        body: of the robot, left out of scans or depth, see `driving.body_options.read_body`; `body_frame`: the sensor's
            link in a URDF file.
        threads: None: all processors.
        overrides: settings as "name.of.setting=value", see `LocalizeSettings`.
    """

    map: Path
    sequence: SequenceRequest
    start_pose: str | None = None
    no_start_pose: bool = False
    near: str | None = None
    full: bool = False
    out: Path | None = None
    radius: float | str | None = None
    voxel: float | None = None
    columns: int | None = None
    body: Several[str] = ()
    body_frame: str | None = None
    threads: int | None = None
    overrides: Several[str] = ()


def localize(request: LocalizeRequest, observer: Observer) -> LocalizationReport:
    """Locates a recording in a map and writes trajectory.txt, localization.json and plots.

    Raises:
        GgslamError: map or recording cannot be read, or nothing says where to begin. If that happens in the middle, or
            on Ctrl-C, what was located is written all the same.
    """
    if request.start_pose is not None and request.no_start_pose:
        raise ConfigError("`start_pose` and `no_start_pose`: one of them")
    chosen, body = localize_settings(request.overrides), read_body(request.body, request.body_frame)
    if note := tuning_note(chosen.settings):
        observer.note(note)
    out = request.out or Path("localized") / request.sequence.path.resolve().name
    with ExitStack() as opened:
        recording = _open_recording(request)
        start = _start(request, recording.ground_truth)
        near = None if request.near is None else parse_near(request.near)
        scans = recording if isinstance(recording, ScanSequence) else None
        of_cloud = partial(_of_cloud, request.map, scans, chosen.submaps, observer)
        store = open_map(request.map, out.parent, opened, observer, of_cloud)
        context = NativeContext(request.threads)
        submaps = replace(store.settings, **chosen.submaps)
        radius = None if request.radius is None else parse_radius(request.radius)
        if radius == AUTO and request.full:
            raise ConfigError("`radius` auto: not with `full`, which takes the whole map")
        submaps = submaps if radius is None or radius == AUTO else replace(submaps, partial_radius=radius)
        own = SCAN_TARGET if scans is not None else chosen.settings.tracking.target
        target = _target(request, submaps, own, point_spacing(store) if scans is not None else 0.0)
        ranges = None if radius != AUTO else frame_ranges if scans is None else scan_ranges
        surface, reach = _surface(request.full, store, target, context, submaps, ranges)
        opened.callback(surface.close)
        places: StoredPlaces | ScanLookUp | None
        if isinstance(recording, ScanSequence):
            places = _scan_look_up(request, store, near, chosen.settings)
        else:
            places = _places(request, recording, store, start, near, observer)
        localizer = _localizer(chosen.settings, recording, places, surface, context, start, reach)
        results, error = _run(localizer, recording, body, observer)
        if error is not None and not results:
            raise error
        damaged = sorted({*surface.damage, *(places.damage if places is not None else [])})
        report = LocalizationReport(
            str(request.map), str(request.sequence.path), request.full, recording.timestamps[: len(results)], results,
            None if recording.ground_truth is None else recording.ground_truth[: len(results)], damaged,
            submaps.partial_radius if reach is None else reach.radius,
        )  # fmt: skip
    for warning in [*filter(None, [_start_note(start, results)]), *report.warnings()]:
        observer.note(warning)
    with delay_interrupts():
        write_localization(report, out, observer)
    if error is not None:
        observer.note(f"stopped after {len(results)} of {quantity(len(recording), 'frame')}, which are in {out}")
        raise error
    return report


def open_map(
    path: Path, results: Path, opened: ExitStack, observer: Observer, of_cloud: Callable[[], SubmapSettings]
) -> GridStore:
    """The store of a folder, of a run (made in `results` if it is not there, for the next time, too), or of a cloud
    (made in a temporary folder, with the settings that `of_cloud` gives). `opened` closes and removes what is to be. A
    run stays as it is.

    Raises:
        FormatError, RunFolderError: it is none of them, or damaged.
    """
    path = Path(path)
    if is_store(path):
        return opened.enter_context(GridStore.open(path))
    if is_cloud(path):
        observer.note(f"{path} is cut into cells; `ggslam submaps` keeps them for the next time")
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="ggslam-")))
        store = opened.enter_context(GridStore.create(folder / _CELLS, of_cloud()))
        store_of_cloud(path, store)
        return store
    return opened.enter_context(_store_beside(path, results, opened, observer))


def _of_cloud(
    path: Path, scans: ScanSequence | None, chosen: Mapping[str, Any], observer: Observer
) -> SubmapSettings:
    """Settings of the cells that a cloud is cut into: all points, lengths that suit the scanner."""
    base = INDOORS if scans is None else settings_of_scans(scans, cut=True)
    settings = with_chosen(replace(base, voxel=cloud_voxel(path)), chosen)
    if base != INDOORS:
        observer.note(f"R' {settings.partial_radius:g} m and cells of {settings.spacing:g} m suit the scanner")
    return settings


def _store_beside(path: Path, results: Path, opened: ExitStack, observer: Observer) -> GridStore:
    if path.is_dir() and not (path / MARKER).is_file():
        raise ConfigError(f"{path}: neither a grid store (no index.sqlite) nor a run (no {MARKER})")
    folder = RunFolder.open(path)
    visit = visit_of(folder)
    if folder.path.resolve() in (results.resolve(), *results.resolve().parents):  # nothing is written into a run
        results = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="ggslam-")))
    cells = results / f"{folder.path.resolve().name}-{visit[-LocateTuning.fingerprint_letters:]}.grid"
    if is_store(cells):
        store = GridStore.open(cells)
        if store.visits()[-1:] == [visit]:
            return store
        store.close()
        raise ConfigError(f"{cells}: is not the map of {path} that its name tells: remove it, or choose another `out`")
    observer.note(f"the map of {path} is cut into cells: {cells}, which the next time uses")
    make_folder(results)
    making = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix=f".{cells.name}-", dir=results))) / _CELLS
    with GridStore.create(making, INDOORS) as store:
        store_of_run(path, store)
    if not is_store(cells):  # another process may have been faster
        making.rename(cells)  # a store that was not finished has another name
    return GridStore.open(cells)


def parse_pose(text: str) -> np.ndarray:
    """T_world_sensor of "x y z qx qy qz qw". Raises ConfigError for anything else."""
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.zeros(0)
    norm = float(np.linalg.norm(numbers[3:]))
    if len(numbers) != 7 or not (np.abs(numbers) <= LocateTuning.max_start_m).all() or not 0.9 < norm < 1.1:
        expected = f'"x y z qx qy qz qw", metres and a unit quaternion, or "{GIVEN}"'
        frame = " (the first frame to use is `start`)" if text.strip().isdecimal() else ""
        raise ConfigError(f"`start_pose`: expected {expected}, found {text!r}{frame}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quaternion_to_matrix(numbers[[6, 3, 4, 5]] / norm), numbers[:3]
    return T


def _open_recording(request: LocalizeRequest) -> Sequence | ScanSequence:
    path = request.sequence.path
    if request.sequence.format is None and scan_files(path):
        wanted = request.sequence
        return ScanSequence(path, wanted.start, wanted.stop, wanted.stride, request.columns)
    refuse_unread_scans(path)
    return one_camera(request.sequence.open(), "localising")


def _start(request: LocalizeRequest, truth: np.ndarray | None) -> np.ndarray | None:
    if request.start_pose is None:
        return None
    if request.start_pose != GIVEN:
        return parse_pose(request.start_pose)
    if truth is None or not np.isfinite(truth[0]).all():
        raise SequenceError(f"{request.sequence.path}: `start_pose` {GIVEN}: the first frame has no pose")
    return truth[0]


def _target(request: LocalizeRequest, submaps: SubmapSettings, own: TargetSettings, spacing: float) -> TargetSettings:
    """Of images or (`own` is `SCAN_TARGET`) scans, whose map may lie anywhere in the world: a map moved by whole
    hundreds of metres has the same voxels."""
    voxel = max(own.voxel, LocateTuning.min_voxel_ratio * submaps.voxel, LocateTuning.min_voxel_ratio * spacing)
    if own is SCAN_TARGET and voxel < LocateTuning.whole_voxel_m:
        voxel = LocateTuning.whole_voxel_m / math.floor(LocateTuning.whole_voxel_m / voxel * (1 + 1e-9))
    return replace(own, voxel=voxel if request.voxel is None else request.voxel)


def _surface(
    full: bool, store: GridStore, target: TargetSettings, context: NativeContext, submaps: SubmapSettings,
    ranges: Callable[[Any], np.ndarray] | None,
) -> tuple[Surface, AdaptiveReach | None]:  # fmt: skip
    """The map that is aligned to, and what adapts it if it is to be, by what an item measured."""
    if full:
        return FullSurface(store, target, context), None
    surface = PartialSurface(store, target, context, submaps)
    return surface, None if ranges is None else AdaptiveReach(surface, ranges)


def _places(
    request: LocalizeRequest, recording: Sequence, store: GridStore, start: np.ndarray | None, near: Near | None,
    observer: Observer,
) -> StoredPlaces | None:  # fmt: skip
    """The places of the map; None if they cannot be used and are not needed for the start."""
    try:
        places = StoredPlaces(store, recording.camera, near=near)
    except ConfigError as error:
        if start is None:
            raise
        observer.note(f"lost frames are not looked up: {error}")
        return None
    if start is None and not len(places):
        reason = f"; left out: {places.damage[0]}" if places.damage else ""
        where = "" if near is None else f" {near}"
        raise ConfigError(f"{request.map}: has no places to look up{where}: `start_pose` is needed{reason}")
    return places


def _scan_look_up(
    request: LocalizeRequest, store: GridStore, near: Near | None, settings: LocalizeSettings
) -> ScanLookUp:
    held = None if near is None else scan_places(store, near)
    if held is not None and not len(held):
        raise ConfigError(f"`near`: {request.map} has nothing {near}")

    def make() -> ScanPlaces | MapPicture:
        return scan_places(store) if held is None else held

    return ScanLookUp(make, store.settings.axes, settings.look_up, settings.scans.min_overlap, near)


def _start_note(start: np.ndarray | None, results: Several[Localization]) -> str:
    """What became of a start pose that was not used; empty if it was, or there was none."""
    if start is None or not results or results[0].status in (LocalizationStatus.OK, LocalizationStatus.DEGENERATE):
        return ""
    first = results[0]
    if first.status is not LocalizationStatus.FOUND:
        return f"the start pose was not used: {first.reason}"
    moved, turned = separation(start, first.T_world_sensor)
    return (
        f"the start pose was not used: nothing matches there; the first one was looked up and found {moved:.1f} m and "
        f"{turned:.0f} degrees from it"
    )


def _localizer(
    settings: LocalizeSettings, recording: Sequence | ScanSequence, places: StoredPlaces | ScanLookUp | None,
    surface: Surface, context: NativeContext, start: np.ndarray | None, reach: AdaptiveReach | None,
) -> Localizer[Any]:  # fmt: skip
    if isinstance(recording, ScanSequence):
        assert isinstance(places, ScanLookUp)
        return Localizer(surface, ScanTracker(settings.scans, context, start, places), start, reach)
    assert not isinstance(places, ScanLookUp)
    front_end = FrameTracker(recording.camera, settings.tracking, context, start, places)
    return Localizer(surface, front_end, start, reach)


def _run(
    localizer: Localizer[Any], recording: Sequence | ScanSequence, body: Body | None, observer: Observer
) -> tuple[list[Localization], BaseException | None]:
    """What was located, and what stopped it before the end."""
    results: list[Localization] = []
    observer.begin("localize", len(recording))
    items: Iterable[Any]
    if isinstance(recording, ScanSequence):
        items = (scan.points if body is None else body.without(scan.points) for scan in recording.stream())
    else:
        items = recording.stream(masks=False)
        items = items if body is None else map(CameraBody(body).without, items)
    try:
        for item in items:
            results.append(localizer.locate(item))
            observer.advance(len(results), len(recording))
        if isinstance(recording, ScanSequence) and recording.all_empty:
            raise SequenceError(
                f"{recording.path}: none of {quantity(len(recording), 'scan')} has a point with a position"
            )
    except (GgslamError, KeyboardInterrupt) as stopped:  # what was located is written first
        return results, stopped
    return results, None
