# SPDX-License-Identifier: Apache-2.0
"""A film of a map, shot by shot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import ConfigError, SequenceError
from ggslam.formats.film_files import film_ending, write_film
from ggslam.jobs.render.artist import Artist
from ggslam.jobs.render.key_path import DEFAULT_FOV, key_shots, page_fov, read_camera_keys
from ggslam.jobs.render.orbit_path import orbit_shots
from ggslam.jobs.render.outputs import write_beside
from ggslam.jobs.render.recorded_path import RecordedPathTuning, recorded_shots
from ggslam.jobs.render.shots import Shot, ShotTuning, Size
from ggslam.reporting.pictures import depth_range, side_by_side
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.annotations import CameraKeysRecord
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.sequence import Sequence as Recording
from ggslam.system.tuning import Tuning

BESIDE = "side-by-side"
"""Among the kinds of pictures: the recorded picture left of each."""
Progress = Callable[[int, int], None]
"""Called with the pictures that are done, and all."""


class FilmJobTuning(Tuning):
    """How films of maps are made."""

    depth_samples = 12
    """Pictures from which the range of depths of the whole film is found."""
    gif_fps = 15.0
    """Pictures a second of a .gif that is not told otherwise."""
    gap = 4
    """Pixels between pictures side by side."""


def render_film(
    run: str | Path | RunFolder,
    out: str | Path,
    *,
    path: str | Path = "recorded",
    fps: float | None = None,
    seconds: float | None = None,
    size: Size | None = None,
    what: Sequence[str] = ("color",),
    smoothing: float = RecordedPathTuning.smoothing_s,
    recording: str | Path | None = None,
    progress: Progress = lambda done, count: None,
) -> str | None:
    """Renders a film of a run's map, as `ggslam render --film` does.

    Args:
        run: the run, or its folder; or a file of Gaussians, for which `path` is orbit or a file of keys.
        out: the film, .mp4, .gif or .webp. It appears when it is whole.
        path: "recorded", the camera's own way; "orbit", round the map; "keys", through those set on the run's page; or
            a JSON file of camera keys, see `key_path`.
        fps: pictures a second; None: 30, of a .gif 15, of keys as they say.
        seconds: that the film takes; None: as long as the recording or the keys, of an orbit 12 s.
        size: (width, height) of each picture; None: as the run saw it, of keys 1280x720.
        what: of color, depth, alpha and, of a run with objects, ids and pca, which are put beside one another. With
            "side-by-side" the recorded picture is left of each, for color and depth along the recorded way.
        smoothing: of the recorded way, a standard deviation in seconds. "side-by-side" is not smooth_poses.
        recording: where the recording is now, if it was moved; for "side-by-side".

    Returns:
        What a user should know of the file; None: nothing.

    Raises:
        ConfigError: what is asked for does not exist or does not go together.
        RunFolderError: no run, objects are asked of a run that has none, or the film cannot be written.
        SequenceError: the recording is needed and not there.
    """
    folder = run if isinstance(run, RunFolder) else open_map(run)
    ending, out, beside = film_ending(Path(out)), Path(out), BESIDE in what
    kinds = [kind for kind in what if kind != BESIDE] or ["color"]
    rate = FilmJobTuning.gif_fps if fps is None and ending == ".gif" else fps
    shots = shots_along(folder, path, rate, seconds, size, smoothing, beside)
    artist = Artist(folder, kinds)
    recorded = _RecordedPictures(folder, kinds, path, recording) if beside else None
    if "depth" in kinds:
        artist.depth_limits = _depth_limits(artist, shots)
    step = shots[1].time - shots[0].time if len(shots) > 1 else 1 / (rate or ShotTuning.fps)
    with write_beside(out), write_film(out, 1 / step) as film:
        for done, shot in enumerate(shots):
            pictures = artist.pictures(shot.camera, shot.T_world_camera)
            film.write(_sheet(pictures) if recorded is None else recorded.beside(artist, shot, pictures))
            progress(done + 1, len(shots))
    return film.note


def shots_along(
    folder: RunFolder, path: str | Path, fps: float | None, seconds: float | None, size: Size | None,
    smoothing: float = RecordedPathTuning.smoothing_s, at_frames: bool = False,
) -> list[Shot]:  # fmt: skip
    """The shots of a film along a way, see `render_film`."""
    rate = ShotTuning.fps if fps is None else fps
    if str(path) == "recorded":
        return recorded_shots(folder, rate, seconds, size, smoothing, at_frames)
    if str(path) == "orbit":
        return orbit_shots(folder, rate, seconds, size)
    file = folder.path / CameraKeysRecord.FILE if str(path) == "keys" and folder.path.is_dir() else Path(path)
    if not file.is_file():
        expected = "expected recorded, orbit, keys (set on the run's page) or a JSON file of camera keys"
        raise ConfigError(f"`path`: {expected}, found no file {str(file)!r}")
    fov = page_fov(folder.sequence().camera) if folder.has_poses else DEFAULT_FOV
    return key_shots(read_camera_keys(file), fps, seconds, size, fov)


def _depth_limits(artist: Artist, shots: list[Shot]) -> tuple[float, float]:
    """Nearest and farthest depth worth showing in a film, so that its colours do not flicker."""
    chosen = np.unique(np.linspace(0, len(shots) - 1, FilmJobTuning.depth_samples).round().astype(int))
    small = [shots[i].camera.scale(min(1.0, 160 / shots[i].camera.width)) for i in chosen]
    return depth_range(
        np.concatenate([artist.depth(c, shots[i].T_world_camera).ravel() for c, i in zip(small, chosen, strict=True)])
    )


def _sheet(pictures: dict[str, np.ndarray]) -> np.ndarray:
    """The pictures of a moment beside one another, uint8 [H, W, 3]."""
    return side_by_side([_as_color(picture) for picture in pictures.values()], FilmJobTuning.gap)


def _as_color(picture: np.ndarray) -> np.ndarray:
    return picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, 2)


class _RecordedPictures:
    """What was recorded, as it is put left of what is rendered."""

    def __init__(
        self, folder: RunFolder, kinds: list[str], path: str | Path, recording: str | Path | None
    ) -> None:
        if str(path) != "recorded":
            raise ConfigError(f"`what` {BESIDE}: goes with `path` recorded; nothing was recorded elsewhere")
        if not set(kinds) <= {"color", "depth"}:
            raise ConfigError(f"`what` {BESIDE}: goes with color and depth, found {','.join(kinds)}")
        self._sequence: Recording = open_recording_of(folder, None if recording is None else Path(recording))
        self._camera_of = folder.sequence().camera_of
        self._last: tuple[int | None, Frame | None] = (None, None)

    def beside(self, artist: Artist, shot: Shot, pictures: dict[str, np.ndarray]) -> np.ndarray:
        """Recorded and rendered, a row for each kind, uint8 [H, W, 3]."""
        frame = self._frame(shot.frame)
        rows = []
        for kind, rendered in pictures.items():
            recorded = np.zeros_like(rendered)
            if frame is not None and shot.frame is not None:
                picture = frame.color if kind == "color" else artist.color_depth(frame.depth)
                recorded = as_seen_by(picture, self._camera_of(shot.frame), shot.camera)
            rows.append(side_by_side([recorded, rendered], FilmJobTuning.gap))
        gap = np.zeros((FilmJobTuning.gap, *rows[0].shape[1:]), np.uint8)
        return np.concatenate([part for row in rows for part in (row, gap)][:-1])

    def _frame(self, number: int | None) -> Frame | None:
        if number is not None and self._last[0] != number:
            try:
                self._last = (number, self._sequence.frame(number))
            except SequenceError:  # a damaged frame; the run went on without it
                self._last = (number, None)
        return self._last[1]


def as_seen_by(picture: np.ndarray, source: Camera, target: Camera) -> np.ndarray:
    """A picture [H, W, 3] of one pinhole camera as another one in its place sees it."""
    if source == target:
        return picture
    ax, ay = source.fx / target.fx, source.fy / target.fy
    warp = np.array([[ax, 0, source.cx - ax * target.cx], [0, ay, source.cy - ay * target.cy]])
    if ax > 1:  # smaller pictures would flicker
        picture = cv2.GaussianBlur(picture, (0, 0), 0.4 * ax)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, warp, (target.width, target.height), flags=flags)
