# SPDX-License-Identifier: Apache-2.0
"""Every encoding and every storage of a bag gives back the pixels that were put in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from image_bags import (
    COLOR_TOPIC,
    HEIGHT,
    LAYOUTS,
    LOSSLESS,
    STORAGES,
    WIDTH,
    ImageMessages,
    as_png,
    compressed_depth,
    depth_mm,
    grey,
    picture,
    rgb_of,
    smooth_picture,
    write_image_bag,
    yuv,
)

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence
from ggslam.sequences.formats.ros_images import COLOR, DEPTH
from ggslam.sequences.formats.ros_topics import is_rectified

Make = Callable[[ImageMessages, float, int], Any]
FLOAT32_MM = 0.001
"""Millimetres between a whole number of them and its float32 in metres."""


def color_in(encoding: str, padding: int = 0, draw: Callable[[int], np.ndarray] = picture) -> Make:
    return lambda messages, time, i: messages.raw_image(time, encoding, LAYOUTS[encoding](draw(i)), padding)


def depth_in(encoding: str, padding: int = 0, big: bool = False) -> Make:
    def message(messages: ImageMessages, time: float, i: int) -> Any:
        pixels = depth_mm(i)
        if encoding == "32FC1":
            pixels = np.where(pixels > 0, pixels / 1000, np.nan).astype(np.float32)
        return messages.raw_image(time, encoding, pixels, padding, big)

    return message


def compressed(form: str, content: Callable[[int], bytes]) -> Make:
    return lambda messages, time, i: messages.compressed_image(time, form, content(i))


def frames_of(path: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Colours, and depths in millimetres."""
    frames = list(open_sequence(path))
    assert len(frames) == 3
    return [frame.color for frame in frames], [1000 * frame.depth.astype(float) for frame in frames]


def off(found: list[np.ndarray], wanted: Callable[[int], np.ndarray]) -> float:
    """Largest difference of any number of any frame."""
    return max(float(np.abs(image.astype(float) - wanted(i)).max()) for i, image in enumerate(found))


@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage(tmp_path: Path, storage: str) -> None:
    colors, depths = frames_of(write_image_bag(tmp_path, storage, color_in("rgb8"), depth_in("16UC1")))
    assert off(colors, picture) == 0 and off(depths, depth_mm) < FLOAT32_MM
    assert all((depth[:2] == 0).all() for depth in depths)


@pytest.mark.parametrize("storage", [storage for storage in STORAGES if not storage.startswith("ros1")])
def test_the_one_file_of_a_bag(tmp_path: Path, storage: str) -> None:
    """In its folder it is the bag; alone it is, unless metadata.yaml has to tell how it is compressed."""
    folder = write_image_bag(tmp_path, storage, color_in("rgb8"), depth_in("16UC1"))
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    assert off(frames_of(file)[0], picture) == 0
    (folder / "metadata.yaml").unlink()
    if storage.endswith(("file", "message")):
        with pytest.raises(SequenceError, match=f"{file.name}: .*compressed"):
            open_sequence(file)
    else:
        assert off(frames_of(file)[0], picture) == 0


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", LOSSLESS)
def test_colour_without_loss(tmp_path: Path, encoding: str, padding: int) -> None:
    colors, _ = frames_of(write_image_bag(tmp_path, "mcap", color_in(encoding, padding), depth_in("16UC1")))
    assert off(colors, picture) == 0


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey(tmp_path: Path, encoding: str) -> None:
    colors, _ = frames_of(write_image_bag(tmp_path, "ros1", color_in(encoding, 3), depth_in("mono16")))
    assert off(colors, lambda i: grey(picture(i))[..., None].repeat(3, 2)) == 0


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_luma_and_chroma(tmp_path: Path, encoding: str) -> None:
    """One grey value beside BT.601 in real numbers, for OpenCV counts in whole ones."""
    colors, _ = frames_of(write_image_bag(tmp_path, "mcap", color_in(encoding, 2), depth_in("16UC1")))
    assert off(colors, lambda i: rgb_of(yuv(picture(i)))) <= 1


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer(tmp_path: Path, pattern: str) -> None:
    """What a pixel's filter let through stays as it is; one colour all over comes out whole."""

    def even(i: int) -> np.ndarray:
        return np.full((HEIGHT, WIDTH, 3), (200, 90 + i, 30), np.uint8)

    encoding, inner = f"bayer_{pattern}8", (slice(2, -2), slice(2, -2))
    colors, _ = frames_of(write_image_bag(tmp_path, "mcap", color_in(encoding), depth_in("16UC1")))
    channel = np.array(["rgb".index(letter) for letter in pattern]).reshape(2, 2)
    own = np.tile(channel, (HEIGHT // 2, WIDTH // 2))[..., None]
    for i, image in enumerate(colors):
        passed = [np.take_along_axis(pixels, own, 2)[inner] for pixels in (image, picture(i))]
        assert np.array_equal(*passed)
    (tmp_path / "even").mkdir()
    colors, _ = frames_of(write_image_bag(tmp_path / "even", "mcap", color_in(encoding, 0, even), depth_in("16UC1")))
    assert off(colors, even) == 0


@pytest.mark.parametrize("storage", ["ros1", "sqlite3"])
def test_compressed_colour(tmp_path: Path, storage: str) -> None:
    png = compressed("rgb8; png compressed bgr8", lambda i: as_png(picture(i)))
    assert off(frames_of(write_image_bag(tmp_path, storage, png, depth_in("16UC1")))[0], picture) == 0

    def jpeg_of(i: int) -> bytes:
        return cv2.imencode(".jpg", smooth_picture(i)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    for number, form in enumerate(("jpeg", "rgb8; jpeg compressed bgr8")):
        folder = tmp_path / str(number)
        folder.mkdir()
        colors, _ = frames_of(write_image_bag(folder, storage, compressed(form, jpeg_of), depth_in("16UC1")))
        error = np.stack(colors).astype(float) - np.stack([smooth_picture(i) for i in range(3)])
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 38  # with red and blue exchanged: 8 dB


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_depth(tmp_path: Path, encoding: str, big: bool) -> None:
    path = write_image_bag(tmp_path, "ros1" if big else "mcap", color_in("bgr8"), depth_in(encoding, 4 * big, big))
    assert off(frames_of(path)[1], depth_mm) < FLOAT32_MM


def test_compressed_depth(tmp_path: Path) -> None:
    """Millimetres come back as they were, metres within the step of their 16 bits, z^2 / A."""
    for number, form in enumerate(("16UC1; compressedDepth png", "16UC1; compressedDepth", "16UC1; png compressed ")):
        head = 0 if number == 2 else 12
        (tmp_path / str(number)).mkdir()
        depths = compressed(form, lambda i, head=head: compressed_depth(False, depth_mm(i))[12 - head :])
        path = write_image_bag(tmp_path / str(number), "mcap", color_in("rgb8"), depths)
        assert off(frames_of(path)[1], depth_mm) < FLOAT32_MM
    metres = compressed("32FC1; compressedDepth png", lambda i: compressed_depth(True, depth_mm(i)))
    for i, depth in enumerate(frames_of(write_image_bag(tmp_path, "mcap", color_in("rgb8"), metres))[1]):
        step = 1000 * (depth_mm(i) / 1000.0) ** 2 / 10100
        assert (np.abs(depth - depth_mm(i)) <= 1.01 * step + FLOAT32_MM).all() and (depth[:2] == 0).all()


def test_every_encoding_that_is_read_is_tested_here() -> None:
    assert {name.lower() for name in LAYOUTS} == set(COLOR)
    assert set(DEPTH) == {"16uc1", "mono16", "32fc1"}


@pytest.mark.parametrize(
    ("colors", "depths", "message"),
    [
        (lambda m, t, i: m.raw_image(t, "nv21", grey(picture(i))), depth_in("16UC1"),
         r"color.*/color/image_raw .*'nv21'.*rgb8"),
        (lambda m, t, i: m.raw_image(t, "rgb16", picture(i).astype(np.uint16)), depth_in("16UC1"),
         r"/camera/color/image_raw .*'rgb16'"),
        (color_in("rgb8"), lambda m, t, i: m.raw_image(t, "64FC1", depth_mm(i) / 1e3),
         r"depth.*'64FC1'.*16uc1, mono16, 32fc1"),
        (color_in("rgb8"), compressed("16UC1; jpeg compressed", lambda i: b"none"),
         r"image_raw/compressed .*'16UC1; jpeg compressed'"),
        (color_in("rgb8"), compressed("16UC1; compressedDepth rvl", lambda i: b"none"),
         r"image_raw/compressedDepth, message 0: .*'16UC1; compressedDepth rvl'"),
        (lambda m, t, i: m.raw_image(t, "uyvy", np.zeros((24, 31, 2), np.uint8)), depth_in("16UC1"),
         r"/camera/color/image_raw, message 0: uyvy .*31"),
    ],
)  # fmt: skip
def test_encodings_that_are_not_read(tmp_path: Path, colors: Make, depths: Make, message: str) -> None:
    with pytest.raises(SequenceError, match=message) as raised:
        open_sequence(write_image_bag(tmp_path, "mcap", colors, depths))
    assert "\n" not in str(raised.value)


def test_given_by_name_they_are_not_read_either(tmp_path: Path) -> None:
    def unknown(messages: ImageMessages, time: float, i: int) -> Any:
        return messages.raw_image(time, "nv21", grey(picture(i)))

    path = write_image_bag(tmp_path, "ros1", unknown, depth_in("16UC1"))
    refuse(ggslam("inspect", path, "--topic", "color=/camera/color/image_raw"), "nv21", "/camera/color/image_raw")


@pytest.mark.parametrize("storage", ["ros1", "mcap message"])
def test_inspect_and_run(room: Path, tmp_path: Path, storage: str) -> None:
    """The most common kind of bag, raw rgb8, whose pixels are a view of the message that nobody may write into."""
    source = open_sequence(room)
    frames = [source.frame(i) for i in range(3)]
    camera = source.camera
    path = write_image_bag(
        tmp_path, storage, lambda m, t, i: m.raw_image(t, "rgb8", frames[i].color),
        lambda m, t, i: m.raw_image(t, "32FC1", frames[i].depth), size=(camera.width, camera.height),
    )  # fmt: skip
    own = ("--intrinsics", f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}")
    assert "frames        3, 0.1 s at 30.0 Hz" in succeed("inspect", path, *own)
    succeed("run", path, *own, "--stop", 3, "--iterations", 1, "--refine", 0, "--out", tmp_path / "run")
    assert (tmp_path / "run" / "map.ply").is_file()
    assert off([frame.color for frame in open_sequence(path)], lambda i: frames[i].color) == 0


def plain_bag(tmp_path: Path, **options: Any) -> Path:
    return write_image_bag(
        tmp_path, "ros1", lambda m, t, i: m.raw_image(t, "rgb8", picture(i)),
        lambda m, t, i: m.raw_image(t, "16UC1", depth_mm(i)), **options,
    )  # fmt: skip


@pytest.mark.parametrize("role", ["color", "depth", "color_info"])
def test_a_topic_of_another_kind_is_refused(tmp_path: Path, role: str) -> None:
    wrong = COLOR_TOPIC if role == "color_info" else f"{COLOR_TOPIC.rsplit('/', 1)[0]}/camera_info"
    with pytest.raises(SequenceError, match=r"sensor_msgs/\w+.*sensor_msgs/"):
        open_sequence(plain_bag(tmp_path), topics=[f"{role}={wrong}"])


def test_images_of_a_region_of_the_sensor(tmp_path: Path) -> None:
    """The camera_info is that of the whole sensor; the image begins at the region's corner."""
    whole = open_sequence(plain_bag(tmp_path, size=(WIDTH, HEIGHT))).camera
    (tmp_path / "part").mkdir()
    part = open_sequence(plain_bag(tmp_path / "part", size=(WIDTH + 12, HEIGHT + 8), region=(7, 5))).camera
    assert (part.width, part.height, part.fx, part.fy) == (WIDTH, HEIGHT, whole.fx, whole.fy)
    assert (part.cx, part.cy) == (whole.cx - 7, whole.cy - 5)


@pytest.mark.parametrize(("topic", "rectified"), [
    ("/camera/color/image_rect_color", True), ("/a/image_rect/compressed", True), ("/cam/image_rectified", True),
    ("/direct/color/image_raw", False), ("/rect/color/image_raw", False), ("/a/corrected", False),
])  # fmt: skip
def test_which_topics_are_rectified(topic: str, rectified: bool) -> None:
    assert is_rectified(topic) is rectified
