# SPDX-License-Identifier: Apache-2.0
"""Films, read back by readers that are not ours."""

from __future__ import annotations

import resource
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats import film_files
from ggslam.formats.film_files import durations, even, find_ffmpeg, is_whole_film, write_film
from ggslam.system.tuning import overridden

FPS = 12.0


def pictures(count: int = 10, height: int = 96, width: int = 128) -> list[np.ndarray]:
    """A smooth scene of strong colours in which a square moves by two pixels a picture."""
    row, column = np.mgrid[:height, :width]
    base = np.stack([column * 255 // width, row * 255 // height, 255 - column * 255 // width], -1).astype(np.uint8)
    out = []
    for k in range(count):
        picture = base.copy()
        picture[30:60, 10 + 2 * k : 40 + 2 * k] = (230, 40, 30)
        out.append(picture)
    return out


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def write(path: Path, made: list[np.ndarray], fps: float = FPS) -> Path:
    with write_film(path, fps) as film:
        for picture in made:
            film.write(picture)
    return path


def read_video(path: Path) -> tuple[list[np.ndarray], float]:
    video, found = cv2.VideoCapture(str(path)), []
    while True:
        there, picture = video.read()
        if not there:
            return found, float(video.get(cv2.CAP_PROP_FPS))
        found.append(picture[..., ::-1])


@pytest.mark.parametrize("program", ["ffmpeg", "opencv"])
def test_mp4(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if program == "ffmpeg" and find_ffmpeg() is None:
        pytest.skip("no ffmpeg with x264 here")
    if program == "opencv":
        monkeypatch.setattr(film_files, "find_ffmpeg", lambda: None)
    made = pictures()
    found, fps = read_video(write(tmp_path / "film.mp4", made))
    assert len(found) == len(made)
    assert fps == pytest.approx(FPS)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    own = [decibels(a, b) for a, b in zip(made, found, strict=True)]
    # The square has moved by two pixels: each picture must be nearest to its own.
    next_to = [decibels(a, b) for a, b in zip(made, found[1:], strict=False)]
    assert min(own) > 32
    assert min(own) > max(next_to) + 3


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_animations(ending: str, tmp_path: Path) -> None:
    images = pytest.importorskip("PIL.Image")
    made = pictures()
    film = images.open(write(tmp_path / f"film.{ending}", made))
    assert film.n_frames == len(made)
    times = []
    for k, picture in enumerate(made):
        film.seek(k)
        film.load()  # a .webp tells its durations only then
        assert decibels(np.asarray(film.convert("RGB")), picture) > 30
        times.append(film.info["duration"])
    # Pillow tells of a .webp the time since the start for some versions; the sum is right for both.
    assert abs(sum(times) - 1000 * len(made) / FPS) <= 5
    assert film.info["loop"] == 0


@pytest.mark.parametrize(("fps", "unit"), [(30.0, 10), (24.0, 10), (12.0, 1), (29.97, 1)])
def test_durations_add_up(fps: float, unit: int) -> None:
    ends = np.cumsum(durations(200, fps, unit))
    assert np.abs(ends - 1000 * np.arange(1, 201) / fps).max() <= unit / 2 + 1e-9
    assert set(durations(200, fps, unit)) <= {unit * k for k in range(1, 200)}


def test_odd_sizes_are_made_even(tmp_path: Path) -> None:
    made = pictures(3, 95, 127)
    assert even(made[0]).shape == (96, 128, 3)
    found, _ = read_video(write(tmp_path / "film.mp4", made))
    assert found[0].shape == (96, 128, 3)
    assert decibels(found[0][:95, :127], made[0]) > 30


@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_an_interrupted_film_leaves_what_was_there(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"film.{ending}"
    path.write_bytes(b"earlier")
    with pytest.raises(KeyboardInterrupt), write_film(path, FPS) as film:
        film.write(pictures(1)[0])
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"earlier"


def test_ffmpeg_that_fails_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho 'no space for it' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(film_files, "find_ffmpeg", lambda: str(program))
    with pytest.raises(RunFolderError, match="no space for it"):
        write(tmp_path / "film.mp4", pictures())
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("program", ["ffmpeg", "opencv"])
@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_a_full_disk_is_told_of(ending: str, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if program == "ffmpeg" and find_ffmpeg() is None:
        pytest.skip("no ffmpeg with x264 here")
    if program == "opencv":
        monkeypatch.setattr(film_files, "find_ffmpeg", lambda: None)
    noise = np.random.default_rng(0)
    made = [noise.integers(0, 256, (96, 128, 3), np.uint8) for _ in range(10)]
    size = write(tmp_path / f"whole.{ending}", made).stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1000, before[1]))
    try:
        with pytest.raises(RunFolderError):
            write(tmp_path / f"film.{ending}", made)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [p.name for p in tmp_path.iterdir()] == [f"whole.{ending}"]


@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_a_film_without_its_end_is_not_whole(ending: str, tmp_path: Path) -> None:
    path = write(tmp_path / f"film.{ending}", pictures())
    content = path.read_bytes()
    assert is_whole_film(path)
    for count in range(0, len(content), len(content) // 200 + 1):
        path.write_bytes(content[:count])
        assert not is_whole_film(path), count


def test_unknown_endings_and_large_animations(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.mp4, \.gif, \.webp, found 'film.avi'"):
        write(tmp_path / "film.avi", pictures())
    with overridden(film_files.FilmTuning, animation_bytes=100_000), pytest.raises(ConfigError, match="choose .mp4"):
        write(tmp_path / "film.gif", pictures())
    with pytest.raises(ConfigError, match="at least"):
        write(tmp_path / "film.mp4", [])
    assert not list(tmp_path.iterdir())
