# SPDX-License-Identifier: Apache-2.0
"""Depth that is not what it is taken for is recognised in exact recordings made so, its remedy gives the depth back,
and nothing is said of healthy ones."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences import inspect_sequence, open_sequence
from ggslam.sequences.depth_doubts import CODES, DepthDoubts
from ggslam.sequences.depth_kind import DepthKind, read_depth_kind
from ggslam.sequences.orientation import orientation_in, orientation_of
from ggslam.sequences.verdicts import judge_inverse_scale, judge_times

Change = Callable[[np.ndarray], np.ndarray]
"""Depth images as stored, uint16 [n, H, W], 5000 units a metre -> others."""
UNITS = 5000.0


def lengths(camera: Camera) -> np.ndarray:
    return np.linalg.norm(camera.rays(), axis=2)


def stored(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 65535)).astype(np.uint16)


def enlarged(depth: np.ndarray, scale: float) -> np.ndarray:
    """What a camera with a `scale` times wider view sees of it: smaller, in the middle."""
    height, width = depth.shape
    rows, columns = (np.rint((np.arange(n) - (n - 1) / 2) * scale + (n - 1) / 2).astype(int) for n in (height, width))
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    found = depth[np.clip(rows, 0, height - 1)][:, np.clip(columns, 0, width - 1)]
    return np.where(inside, found, 0).astype(np.uint16)


def changes(camera: Camera) -> dict[str, Change]:
    ray = lengths(camera)
    return {
        "ray": lambda d: stored(d * ray),
        "inverse": lambda d: stored(np.where(d > 0, 20000 * UNITS / np.maximum(d, 1), 0)),
        "inverted": lambda d: stored(np.where(d > 0, 1.25 * d.max() - d, 0)),
        "mirrored": lambda d: d[:, :, ::-1],
        "turned": lambda d: d[:, ::-1, ::-1],
        "late": lambda d: np.concatenate([d[1:], d[-1:]]),
        "early": lambda d: np.concatenate([d[:1], d[:-1]]),
        "wide": lambda d: np.stack([enlarged(image, 1.5) for image in d]),
        "saturated": lambda d: np.where(d == 0, 65535, d).astype(np.uint16),
        "coded": lambda d: np.where(d == 0, 32001, d).astype(np.uint16),
        "doubled": lambda d: d[np.arange(len(d)) // 2 * 2],
    }


def write(source: Path, folder: Path, change: str, poses: bool = True) -> Path:
    """A copy of a recording with other depth."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("depth", "masks", *(() if poses else ("poses.txt",))))
    (folder / "depth").mkdir()
    paths = sorted((source / "depth").iterdir())
    depth = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths])
    for path, image in zip(paths, changes(open_sequence(source).camera)[change](depth), strict=True):
        assert cv2.imwrite(str(folder / "depth" / path.name), image)
    return folder


def depth_verdicts(folder: Path, **options: object) -> list[tuple[str, str, str]]:
    report = inspect_sequence(open_sequence(folder, **options))  # type: ignore[arg-type]
    return [(verdict.code, verdict.severity, verdict.text) for verdict in report.verdicts]


def test_depth_that_was_subtracted_from_a_constant_is_no_disparity(room: Path, tmp_path: Path) -> None:
    folder = write(room, tmp_path / "inverted", "inverted")
    ((code, severity, text),) = depth_verdicts(folder)
    assert (code, severity) == ("depth_kind", "wrong") and "`depth_kind`" not in text
    largest = max(frame.depth.max() for frame in open_sequence(room).stream()) * UNITS
    assert float(text.partition("is about ")[2].split(",")[0]) == pytest.approx(1.25 * largest, rel=0.1)


CASES = [
    ("ray", "depth_kind", "wrong", "try `depth_kind` ray", {"depth_kind": "ray"}, 0),
    ("inverse", "depth_kind", "wrong", "try `depth_kind` inverse:20000", {"depth_kind": "inverse:20000"}, 0),
    ("mirrored", "depth_side", "wrong", "back, else try `depth_kind` mirrored", {"depth_kind": "mirrored"}, 0),
    ("turned", "depth_side", "wrong", "try `depth_kind` mirrored,flipped", {"depth_kind": "mirrored,flipped"}, 0),
    ("late", "depth_delay", "wrong", "try `depth_delay` 1f", {"depth_delay": "1f"}, 1),
    ("early", "depth_delay", "wrong", "try `depth_delay` -1f", {"depth_delay": "-1f"}, 0),
    ("coded", "depth_codes", "doubtful", "try `depth_kind` none:32001", {"depth_kind": "none:32001"}, 0),
]


@pytest.mark.parametrize(("change", "code", "severity", "remedy", "options", "first"), CASES)
def test_recognised_and_undone(
    room: Path, tmp_path: Path, change: str, code: str, severity: str, remedy: str, options: dict[str, str], first: int
) -> None:
    folder = write(room, tmp_path / change, change)
    ((found, how_sure, text),) = depth_verdicts(folder)
    assert (found, how_sure) == (code, severity) and remedy in text
    true, mended = open_sequence(room), open_sequence(folder, **options)  # type: ignore[arg-type]
    off = []
    for frame in (mended[0], mended[7]):
        right = true[frame.index + first].depth
        off.append(np.abs(frame.depth - right)[right > 0].max())
        assert ((frame.depth > 0) == (right > 0)).mean() > 0.999
    assert max(off) < 0.002, "metres"
    assert depth_verdicts(folder, **options) == []


@pytest.mark.parametrize("change", ["ray", "inverse", "mirrored", "late", "early"])
def test_recognised_without_poses(room: Path, tmp_path: Path, change: str) -> None:
    ((code, severity, _),) = depth_verdicts(write(room, tmp_path / change, change, poses=False))
    assert severity == "wrong" and code in CODES


def test_unregistered_depth(room: Path, tmp_path: Path) -> None:
    """The calibration that is named is that of the camera that took it: fx 120 / 1.5."""
    ((code, severity, text),) = depth_verdicts(write(room, tmp_path / "wide", "wide", poses=False))
    assert (code, severity) == ("registration", "wrong") and "`depth_camera`" in text
    enlarged_by = float(text.split("when enlarged ")[1].split()[0])
    focal = float(text.split("fx is about ")[1].split()[0])
    assert enlarged_by == pytest.approx(1.5, rel=0.04) and focal == pytest.approx(80, rel=0.04)


def test_the_largest_code_is_no_depth(room: Path, tmp_path: Path) -> None:
    folder = write(room, tmp_path / "saturated", "saturated")
    assert depth_verdicts(folder) == []
    np.testing.assert_array_equal(open_sequence(folder)[3].depth, open_sequence(room)[3].depth)


def test_repeats(room: Path, tmp_path: Path) -> None:
    folder = write(room, tmp_path / "doubled", "doubled")
    (text,) = [text for code, _, text in depth_verdicts(folder) if code == "depth_repeats"]
    assert "depth images repeat" in text and text.endswith("try `stride` 2")
    for path in sorted((folder / "rgb").iterdir())[1::2]:  # now both repeat: nothing new, nothing wrong
        shutil.copy(path.with_name(f"{int(path.stem) - 1:06d}{path.suffix}"), path)
    assert not any("repeat" in text for _, _, text in depth_verdicts(folder))


@pytest.mark.parametrize("grey", [0, 128])
def test_blank_colour_is_no_repeated_image(room: Path, tmp_path: Path, grey: int) -> None:
    folder = write(room, tmp_path / "blank", "saturated")
    for path in (folder / "rgb").iterdir():
        cv2.imwrite(str(path), np.full_like(cv2.imread(str(path)), grey))
    (text,) = [text for code, _, text in depth_verdicts(folder) if code == "color_repeats"]
    assert text.startswith("colour images are blank: ") and "of another time" not in text


@pytest.mark.parametrize(("seed", "noise", "size"), [(3, True, (160, 120)), (4, False, (128, 96)), (5, True, (96, 72))])
def test_nothing_is_said_of_healthy_rooms(tmp_path: Path, seed: int, noise: bool, size: tuple[int, int]) -> None:
    from ggslam.synthetic import write_synthetic_sequence

    folder = tmp_path / "healthy"
    write_synthetic_sequence(folder, frames=20, width=size[0], height=size[1], seed=seed, noise=noise)
    assert depth_verdicts(folder) == []
    (folder / "poses.txt").unlink()
    assert depth_verdicts(folder) == []


@pytest.mark.long("nine recordings")
def test_nothing_is_said_of_shared_recordings(shared_data: Path) -> None:
    names = (
        "livingroom", "redkitchen", "shelf", "phone_scan", "hololens_walk", "rgbd_dataset_freiburg3_cabinet",
        "livingroom_visit2", "livingroom_movers", "livingroom_movers_static",
    )  # fmt: skip
    for name in names:
        assert DepthDoubts(open_sequence(shared_data / name)).judge() == [], name


@pytest.fixture
def field(shared_data: Path) -> Path:
    folder = shared_data / "field" / "recordings"
    if not folder.is_dir():
        pytest.skip(f"no recordings from the field at {folder}")
    return folder


@pytest.mark.parametrize(
    ("name", "code", "remedy", "options"),
    [
        ("ray_depth", "depth_kind", "try `depth_kind` ray", {"depth_kind": "ray"}),
        ("inverse_depth", "depth_kind", "try `depth_kind` inverse:20000", {"depth_kind": "inverse:20000"}),
        ("mirror_depth", "depth_side", "try `depth_kind` mirrored", {"depth_kind": "mirrored"}),
        ("exif3", "orientation", "try `upright`", {"upright": True}),
        ("shift1", "depth_delay", "try `depth_delay` 1f", {"depth_delay": "1f"}),
        ("onebased", "depth_delay", "try `depth_delay` -1f", {"depth_delay": "-1f"}),
        ("scale_inverse", "depth_scale", "try `depth_scale` 5000 (1 / 0.0002)", {"depth_scale": 5000.0}),
    ],
)
def test_field_cases(field: Path, name: str, code: str, remedy: str, options: dict[str, object]) -> None:
    report = inspect_sequence(open_sequence(field / name, on_bad_frame="skip"))
    ((found, severity, text),) = [(v.code, v.severity, v.text) for v in report.verdicts]
    assert (found, severity) == (code, "wrong") and remedy in text
    mended = inspect_sequence(open_sequence(field / name, on_bad_frame="skip", **options))  # type: ignore[arg-type]
    assert mended.verdicts == [] and mended.pose_depth_error is not None and mended.pose_depth_error < 0.006


def test_depth_of_a_camera_beside(field: Path) -> None:
    """A D435's depth as it comes: 1.6 times, 10 of 640 pixels to the right."""
    folder = field / "d435_unregistered"
    ((code, severity, text),) = depth_verdicts(folder)
    assert (code, severity) == ("registration", "wrong")
    assert float(text.split("when enlarged ")[1].split()[0]) == pytest.approx(1.6, abs=0.05)
    assert float(text.split("and moved ")[1].split()[0]) == pytest.approx(5, abs=2)  # of 320 pixels
    assert depth_verdicts(folder, depth_camera=field / "calibrations" / "d435_0.015.yaml") == []


def test_good_field_cases(field: Path) -> None:
    assert depth_verdicts(field / "kinect_corner") == []
    assert depth_verdicts(field / "saturated") == []
    ((code, _, text),) = depth_verdicts(field / "kitti00_learned_depth")
    assert code == "depth_scale" and float(text.split("try `depth_scale` ")[1]) == pytest.approx(470, rel=0.05)
    assert depth_verdicts(field / "kitti00_learned_depth", depth_scale=470.0) == []
    warnings = inspect_sequence(open_sequence(field / "tum_slowdepth")).warnings
    assert any(text.startswith("15 of 20 colour images") and text.endswith("are left out") for text in warnings)
    with pytest.raises(SequenceError, match=r"90 degrees.* 6\b.*`upright`"):
        open_sequence(field / "exif6")
    assert depth_verdicts(field / "exif6", upright=True) == []


def test_delays_by_time(room: Path) -> None:
    """The frames come at 30 a second: 33 ms is one frame, 12 ms is left to the tracker."""
    true = open_sequence(room)
    for delay, step, left in (("33.4ms", 1, 0.0), ("0.0334s", 1, 0.0), ("-33ms", -1, 0.0), ("12ms", 0, 0.012)):
        moved = open_sequence(room, depth_delay=delay)
        assert len(moved) == len(true) - abs(step)
        frame = moved[2]
        color = frame.index + max(step, 0)
        np.testing.assert_array_equal(frame.depth, true[color - step].depth)
        assert frame.depth_delay == pytest.approx(left, abs=5e-4)
        np.testing.assert_array_equal(frame.color, true[color].color)
        np.testing.assert_array_equal(frame.T_world_camera, true[color].T_world_camera)


@pytest.mark.parametrize("text", ["1", "f", "1.5f", "10 m", "99f", ""])
def test_delays_that_are_none(room: Path, text: str) -> None:
    with pytest.raises(SequenceError, match="depth_delay"):
        open_sequence(room, depth_delay=text)


def test_words_of_kinds() -> None:
    kind = read_depth_kind("inverse:20000, mirrored,none:4095")
    assert kind == DepthKind("inverse", 20000.0, mirrored=True, none=(4095.0,)) and kind.told
    assert kind.with_words("mirrored") == "inverse:20000,none:4095"
    assert DepthKind(mirrored=True).with_words("mirrored") == "z"
    assert DepthKind(none=(4095.0,)).with_words("ray") == "ray,none:4095"
    for text in ("disparity", "ray:2", "inverse:0", "none", "none:x", "ray,inverse", ""):
        with pytest.raises(SequenceError, match="depth_kind"):
            read_depth_kind(text)


def test_ray_of_a_lens_that_distorts() -> None:
    """Along the ray of the lens as it is, not of a pinhole."""
    rays = np.dstack([np.full((2, 2), 0.75), np.zeros((2, 2)), np.ones((2, 2))]).astype(np.float32)
    z = DepthKind("ray").to_z(np.full((2, 2), 2.5, np.float32), rays, 1000)
    np.testing.assert_allclose(z, 2.0, rtol=1e-6)


def jpeg_with_tag(tag: int, order: str) -> bytes:
    def number(value: int, size: int) -> bytes:
        return value.to_bytes(size, "little" if order == "II" else "big")

    entry = number(0x0112, 2) + number(3, 2) + number(1, 4) + number(tag, 2) + b"\0\0"
    tiff = order.encode() + number(42, 2) + number(8, 4) + number(1, 2) + entry + number(0, 4)
    exif = b"Exif\0\0" + tiff
    image = cv2.imencode(".jpg", np.arange(48 * 32 * 3, dtype=np.uint8).reshape(48, 32, 3))[1].tobytes()
    return image[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + image[2:]


def test_orientation_tags(tmp_path: Path) -> None:
    for tag in range(1, 9):
        for order in ("II", "MM"):
            assert orientation_in(jpeg_with_tag(tag, order)) == tag
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg_with_tag(6, "MM"))
    assert orientation_of(path) == 6 and orientation_of(tmp_path / "none.jpg") == 1
    assert orientation_in(b"\xff\xd8\xff\xe1\0\x0aExif\0\0II") == 1 and orientation_in(b"") == 1


def test_inverse_scales() -> None:
    assert "try `depth_scale` 5000 (1 / 0.0002)" in judge_inverse_scale(0.0002, 6.3e7)[0].text
    assert judge_inverse_scale(0.5, 3.0) == [] and judge_inverse_scale(1.0, 1e5) == []


def test_gaps_of_numbers_are_frames() -> None:
    times = np.delete(np.arange(100), np.arange(40, 70)) / 30
    assert "(the longest: 30 frames before frame 40)" in judge_times(times, nominal=True)[0].text
    assert "(the longest: 1.03 s before frame 40)" in judge_times(times)[0].text
