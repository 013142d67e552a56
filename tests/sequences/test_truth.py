# SPDX-License-Identifier: Apache-2.0
"""True poses of every kind of file are those of the frames; what is wrong with them is said and hinders nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from tiny_recordings import FRAMES, pose, tum_line, write_color, write_depth

from ggslam.errors import SequenceError
from ggslam.runs.folder import RunFolder
from ggslam.sequences import Sequence, open_sequence
from ggslam.sequences.stamps import times_of_names, unit_of_stamps

Make = Callable[[str], Path]
ALL = [pose(i) for i in range(FRAMES)]
EPOCH = 1_600_000_000
QUICK = ["--set", "mapping.iterations_per_frame=1", "--set", "mapping.first_frame_iterations=1", "--refine", 0]


def line(i: int, *before: object, after: str = "") -> str:
    """tx ty tz qx qy qz qw with numbers before and behind them."""
    return " ".join([*map(str, before), tum_line(0, i).split(maxsplit=1)[1].strip(), after]).strip()


def truth_of(sequence: Sequence) -> np.ndarray:
    assert sequence.ground_truth is not None, sequence.warnings
    return sequence.ground_truth


@pytest.mark.parametrize(
    "text_of",
    [
        lambda i: line(i), lambda i: line(i, i / 10), lambda i: line(i, i / 10, after=str(i)),
        lambda i: " ".join(map(str, pose(i)[:3].ravel())), lambda i: ", ".join(map(str, pose(i).ravel())),
    ],
    ids=["7", "8", "9", "12", "16"],
)  # fmt: skip
def test_every_kind_of_line(make: Make, text_of: Callable[[int], str]) -> None:
    folder = make("folder")
    (folder / "poses.txt").write_text("# poses\n" + "\n".join(map(text_of, range(FRAMES))))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(truth_of(sequence), ALL, atol=1e-6)
    assert sequence.warnings == []


def test_a_line_of_names_is_no_pose(make: Make) -> None:
    folder = make("folder")
    (folder / "poses.txt").write_text("tx,ty,tz,qx,qy,qz,qw\n" + "\n".join(map(line, range(FRAMES))))
    np.testing.assert_allclose(truth_of(open_sequence(folder)), ALL, atol=1e-6)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_units_of_time(make: Make, unit: str) -> None:
    """More poses than frames, at times in each unit; images have seconds."""
    folder, size = make("folder"), {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    (folder / "timestamps.txt").write_text("\n".join(f"{EPOCH + i / 10:.6f}" for i in range(FRAMES)))
    rows = [line(0, int((EPOCH - 1) * size)), *(line(i, int((10 * EPOCH + i) * size / 10)) for i in range(FRAMES))]
    if unit == "s":
        rows = [line(0, EPOCH - 1), *(line(i, f"{EPOCH + i / 10:.6f}") for i in range(FRAMES))]
    (folder / "poses.txt").write_text("\n".join(rows))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(truth_of(sequence), ALL, atol=1e-4)
    assert sequence.warnings == ([] if unit == "s" else [
        f"poses.txt: its times are read as {unit}, which agrees with the times of the images"
    ])  # fmt: skip


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_times_of_poses_where_images_have_none(make: Make, unit: str) -> None:
    folder, size = make("folder"), {"ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    (folder / "poses.txt").write_text("\n".join(line(i, EPOCH * size + i * size // 10) for i in range(FRAMES)))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.1, atol=1e-6)
    assert sequence.time_source == f"poses.txt, read as {unit}"


def test_numbers_of_frames_are_no_times(make: Make) -> None:
    """`0 tx ty ...`, `1 ...`: poses of frames 0, 1, 2, 4, and a recording of 30 frames/s, not of one."""
    folder = make("folder")
    (folder / "poses.txt").write_text("\n".join(line(i, i) for i in range(FRAMES)))
    assert np.diff(open_sequence(folder).timestamps) == pytest.approx(1 / 30)
    (folder / "poses.txt").write_text("\n".join(line(i, i) for i in (0, 1, 2, 4)))
    truth = truth_of(open_sequence(folder))
    assert np.isnan(truth[3]).all()
    np.testing.assert_allclose(truth[[0, 1, 2, 4]], [ALL[i] for i in (0, 1, 2, 4)], atol=1e-6)


@pytest.mark.parametrize("rows", ["broken", "nan", "inf", "quaternion", "short"])
def test_one_bad_line_costs_one_pose(make: Make, rows: str) -> None:
    folder = make("tum")
    path = folder / "groundtruth.txt"
    lines = path.read_text().splitlines()
    bad = next(i for i, text in enumerate(lines) if not text.startswith("#")) + 2
    words = lines[bad].split()
    lines[bad] = {
        "broken": "what is this", "nan": " ".join([*words[:2], "nan", *words[3:]]), "short": " ".join(words[:5]),
        "inf": " ".join([*words[:2], "inf", *words[3:]]), "quaternion": " ".join([*words[:4], "0 0 0 0"]),
    }[rows]  # fmt: skip
    whole = truth_of(open_sequence(folder))
    path.write_text("\n".join(lines))
    sequence = open_sequence(folder)
    known = np.isfinite(truth_of(sequence)).all((1, 2))
    assert known.sum() >= FRAMES - 1
    np.testing.assert_allclose(truth_of(sequence)[known], whole[known], atol=5e-3)  # between neighbours, or nearest
    if not known.all():
        assert f"groundtruth.txt, line {bad + 1}: " in sequence.warnings[-1]


def names_of(folder: Path, names: list[str], depth_names: list[str], suffix: str = ".png") -> Path:
    for i, name in enumerate(names):
        write_color(folder / "rgb" / f"{name}.png", i)
    (folder / "depth").mkdir(exist_ok=True)
    for i, name in enumerate(depth_names):
        if suffix == ".npy":
            np.save(folder / "depth" / f"{name}.npy", np.full((24, 32), 1 + i / 10, np.float32))
        else:
            write_depth(folder / "depth" / f"{name}.png", i, 1000)
    return folder


@pytest.mark.parametrize(
    ("write", "unit"),
    [(lambda t: f"{t / 1e9:.6f}", "s"), (lambda t: f"{t // 10**6}", "ms"), (lambda t: f"{t // 10**3}", "us"),
     (lambda t: f"{t}", "ns")],
)  # fmt: skip
def test_names_that_are_times(tmp_path: Path, write: Callable[[int], str], unit: str) -> None:
    """Depth is taken 4 ms after colour; the second and the fourth colour image have none, and no pair is shifted."""
    times = [EPOCH * 10**9 + round(i * 1e9 / 15) for i in range(6)]
    depth_times = [times[i] + 4_000_000 for i in (0, 2, 4, 5)]
    folder = names_of(tmp_path, [write(t) for t in times], [write(t) for t in depth_times])
    sequence = open_sequence(folder, intrinsics="30 31 15 11", depth_scale=1000)
    assert [round(float(frame.color[12, 16, 0])) for frame in sequence] == [0, 20, 40, 50]
    np.testing.assert_allclose([frame.depth[12, 16] for frame in sequence], [1, 1.1, 1.2, 1.3], atol=1e-6)
    np.testing.assert_allclose(sequence.timestamps, [times[i] / 1e9 for i in (0, 2, 4, 5)], atol=1e-3)
    told = "2 of 6 colour images (rgb) have no depth image of the same time (depth) within 0.02 s and are left out"
    assert sequence.warnings == [told]


def test_names_that_are_no_times(tmp_path: Path) -> None:
    assert times_of_names([Path(f"{i:06d}.png") for i in range(3)]) is None
    assert times_of_names([Path(f"{i:010d}.png") for i in range(3)]) is None  # KITTI
    assert times_of_names([Path("rgb_1.5.png"), Path("rgb_1.6.png")]) is None
    assert times_of_names([Path("1600000000123456789.png")]) == pytest.approx(1600000000.123456789, abs=1e-6)
    assert unit_of_stamps(np.array([0.0, 33.3, 66.7]), None) == "ms"
    assert unit_of_stamps(np.array([0.0, 0.033, 0.066]), None) == "s"


def test_npy_depth(tmp_path: Path) -> None:
    folder = names_of(tmp_path, ["0", "1"], ["0", "1"], ".npy")
    sequence = open_sequence(folder, intrinsics="30 31 15 11", depth_scale=1)
    np.testing.assert_allclose([frame.depth[12, 16] for frame in sequence], [1, 1.1], atol=1e-7)
    (folder / "depth" / "0.npy").rename(folder / "depth" / "0.exr")
    (folder / "depth" / "1.npy").unlink()
    with pytest.raises(SequenceError, match=r"depth: .*0\.exr"):
        open_sequence(folder, intrinsics="30 31 15 11", depth_scale=1)


def test_runs_do_not_depend_on_the_truth(room: Path, tmp_path: Path) -> None:
    """Fewer poses than frames: scores over those; none that can be used: a run without; --no-eval: not a word."""
    folder = tmp_path / "room"
    folder.mkdir()
    for name in ("rgb", "depth", "camera.yaml"):
        (folder / name).symlink_to(room / name)
    rows = [" ".join(map(str, T[:3].ravel())) for T in truth_of(open_sequence(room))]
    (folder / "poses.txt").write_text("\n".join(rows[:5]))
    told = succeed("run", folder, "--stop", 8, "--scale", 0.5, "--out", tmp_path / "fewer", *QUICK)
    assert "; over 5 frames" in told
    metrics = RunFolder.open(tmp_path / "fewer").metrics()
    assert metrics.trajectory is not None and metrics.trajectory.frames_compared == 5
    assert metrics.trajectory.ate_rmse_m is not None and metrics.trajectory.ate_rmse_m < 0.01
    (folder / "poses.txt").write_bytes(b"\xff\xfe\x00\x01")
    words = " ".join(succeed("run", folder, "--stop", 4, "--scale", 0.5, "--out", tmp_path / "none", *QUICK).split())
    assert "no true poses: " in words and "poses.txt: cannot be read as text" in words
    quiet = succeed("run", folder, "--stop", 4, "--scale", 0.5, "--out", tmp_path / "quiet", "--no-eval", *QUICK)
    assert "poses" not in quiet
    assert not (tmp_path / "quiet" / "ground_truth.txt").exists()
    for command in (("volumes", folder, "--out", tmp_path / "v"), ("submaps", folder, "--out", tmp_path / "s.grid")):
        refuse(ggslam(*command), "poses", "poses.txt: cannot be read as text")


@pytest.mark.parametrize(
    ("case", "options", "words"),
    [
        ("tum_gt_otherclock", (), "groundtruth.txt: no pose within 0.02 s of any image"),
        ("tum_gt_otherclock", ("--no-eval",), ""),
        ("kitti_fewer", ("--stop", 17), "; over 15 frames"),
    ],
)
def test_runs_from_the_field(
    shared_data: Path, tmp_path: Path, case: str, options: tuple[object, ...], words: str
) -> None:
    recording = shared_data / "field" / "recordings" / case
    if not recording.is_dir():
        pytest.skip(f"no recording from the field at {recording}")
    camera = ("--intrinsics", "120 120 79.5 59.5") if case.startswith("tum") else ()
    told = succeed("run", recording, *camera, *options, "--scale", 0.5, "--out", tmp_path / "out", *QUICK)
    assert " ".join(words.split()) in " ".join(told.split())


def test_places_that_are_no_recording(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    refuse(ggslam("inspect", tmp_path / "pipe"), "pipe: is neither a folder nor a regular file")
    refuse(ggslam("inspect", tmp_path / "link"), "link: is a link to ", "gone, which is not there")
