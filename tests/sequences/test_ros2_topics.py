# SPDX-License-Identifier: Apache-2.0
"""A live camera of ROS 2 topics on a network in memory."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from live_topics import ADDRESS, CAMERA, COMPRESSED, IMAGE, INFO, PATIENT, TF, TopicCamera, color_of, depth_of

pytest.importorskip("rosbags")
sys.path.insert(0, str(Path(__file__).parent.parent / "middleware"))
from local_node import LocalNetwork

from ggslam.errors import GgslamError, SequenceError
from ggslam.messages.contents import Lens
from ggslam.messages.ros2_images import camera_info_message, header
from ggslam.middleware.node import Qos, Received
from ggslam.scene.camera import Camera
from ggslam.sequences.formats.ros2_infos import InfoTuning
from ggslam.sequences.formats.ros2_topics import LiveTopicsTuning, Ros2Camera
from ggslam.sequences.live import LiveSequence
from ggslam.system.tuning import overridden


@pytest.fixture
def network() -> LocalNetwork:
    return LocalNetwork()


def opened(network: LocalNetwork, address: str = ADDRESS, scale: float = 1.0) -> Ros2Camera:
    return Ros2Camera(address, scale, network.node("run"))


def started(network: LocalNetwork, camera: TopicCamera, address: str = PATIENT, scale: float = 1.0) -> Ros2Camera:
    """A run that sees frame 0, sent once it listens."""
    camera.send_later(0, 10.0)
    return opened(network, address, scale)


@pytest.mark.parametrize("compressed", [False, True], ids=["raw", "compressed"])
@pytest.mark.parametrize("metres", [False, True], ids=["16UC1", "32FC1"])
def test_frames(network: LocalNetwork, compressed: bool, metres: bool) -> None:
    camera = TopicCamera(network.node("camera"), compressed=compressed, metres=metres)
    source = started(network, camera)
    assert source.camera == CAMERA and source.name.startswith("camera-color")
    frames = source.frames()
    for i in range(3):
        if i:
            camera.send(i, 10.0 + i / 30)
        frame = next(frames)
        assert (frame.index, frame.timestamp) == (i, pytest.approx(10.0 + i / 30)) and frame.depth_delay == 0
        if compressed:
            assert np.abs(frame.color.astype(int) - color_of(i)).mean() < 5  # JPEG
        else:
            np.testing.assert_array_equal(frame.color, color_of(i))
        exact = not (compressed and metres)
        np.testing.assert_allclose(frame.depth, depth_of(i), rtol=0 if exact else 0.02, atol=0 if exact else 1e-3)
    counts = source.counts()
    assert counts == {"color": 3, "depth": 3, "pairs": 3, "taken": 3} | dict.fromkeys(
        ("waiting", "unmatched", "overwritten", "damaged", "lost", "overrun"), 0
    )
    source.close()


def test_newest_wins(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"))
    source = started(network, camera)
    frames = source.frames()
    next(frames)
    for i in range(1, 8):
        camera.send(i, 10.0 + i / 30)
        network.settle()
    frame = next(frames)
    assert frame.timestamp == pytest.approx(10 + 7 / 30) and frame.index == 1
    np.testing.assert_array_equal(frame.color, color_of(7))
    assert source.counts()["overwritten"] == 6 and source.counts()["taken"] == 2


def test_what_is_missing(network: LocalNetwork) -> None:
    with pytest.raises(SequenceError, match=r"nobody publishes `/camera/color` and `/camera/depth` within 0.8 s; seen"):
        opened(network)
    camera = TopicCamera(network.node("camera"))
    with pytest.raises(SequenceError, match=r"no message on `/camera/color` and `/camera/depth` and `/camera/cam"):
        opened(network)
    camera.depth.send = lambda content: None  # type: ignore[method-assign]
    camera.send_later(0, 10.0)
    with pytest.raises(SequenceError, match=r"no message on `/camera/depth` within 0.8 s; seen: /camera/camera_info"):
        opened(network)
    del camera.depth.send
    with pytest.raises(SequenceError, match=r"`/camera/camera_info` \(for depth\): holds sensor_msgs/CameraInfo, exp"):
        opened(network, "ros2://camera/color,camera/camera_info?wait=0.8")
    camera.send_later(0, 10.0, 0.05)
    with pytest.raises(SequenceError, match=r"no two images were taken within 0.02 s of one another; .* 0.050 s apart"):
        opened(network)
    camera.send_later(0, 10.0, 0.05)
    opened(network, PATIENT + "&tolerance=0.1").close()
    camera.send_later(0, 10.0)
    with pytest.raises(SequenceError, match=r"/camera/depth holds 16UC1 and /camera/color rgb8: expected colour first"):
        opened(network, "ros2://camera/depth,camera/color?wait=0.8")


def test_camera_info_without_calibration(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"))
    camera.send_info = lambda: camera.info.send(camera.types.encode(INFO, _zero(camera)))  # type: ignore[method-assign]
    camera.send_later(0, 10.0)
    with pytest.raises(SequenceError, match=r"`/camera/camera_info`: tells no camera within 0.8 s"):
        opened(network)


def _zero(camera: TopicCamera) -> object:
    message = camera_info_message(camera.types, Lens("color_optical", CAMERA), 1.0)
    message.k[:] = 0
    return message


def test_other_camera_later(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"))
    source = started(network, camera)
    said: list[str] = []
    source.follow(lambda: True, said.append)
    camera.send_info(2.0)
    camera.send_info(3.0, Camera(64, 48, 70.0, 70.0, 31.5, 23.5))
    network.settle()
    next(source.frames())
    assert [text for text in said if "another camera than at the start" in text] == said and len(said) == 1
    assert source.camera == CAMERA


def tf_static(camera: TopicCamera, shift: float) -> bytes:
    """/tf_static with the depth camera `shift` metres to the right of colour."""
    make = camera.types.make
    transform = make(
        "geometry_msgs/msg/Transform", translation=make("geometry_msgs/msg/Vector3", x=shift, y=0.0, z=0.0),
        rotation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )  # fmt: skip
    link = make(
        "geometry_msgs/msg/TransformStamped", header=header(camera.types, "color_optical", 0.0),
        child_frame_id="depth_optical", transform=transform,
    )  # fmt: skip
    return camera.types.encode(TF, make(TF, transforms=[link]))


def test_depth_of_another_camera(network: LocalNetwork) -> None:
    """Where it stands is told by /tf_static, sent once, before or a moment after; without it that is said."""
    camera = TopicCamera(network.node("camera"))
    camera.frames = ("color_optical", "depth_optical")
    with overridden(InfoTuning, transform_s=0.2):
        source = started(network, camera)
    assert len(source.warnings) == 1 and "/tf_static does not tell where it is" in source.warnings[0]
    assert LiveSequence(source).warnings == source.warnings
    source.close()
    threading.Timer(0.5, lambda: camera.fixed.send(tf_static(camera, 2.0))).start()
    source = started(network, camera)
    beside = source._frames._recording.depth_camera
    assert not source.warnings and beside is not None and beside.T_color_depth[0, 3] == 2.0
    frame = next(source.frames())
    assert frame.depth.shape == (48, 64) and (frame.depth[:, 0] == 0).all()  # it does not see the left border
    source.close()


def test_lens(network: LocalNetwork) -> None:
    """Distortion is undone of plain images, not of rectified ones, whose camera is P."""
    for name, distorted in (("camera", True), ("image_rect", False)):
        camera = TopicCamera(network.node(f"{name}_node"), f"/{name}")
        camera.send_info = partial(send_lens, camera)  # type: ignore[method-assign]
        color = camera.color if distorted else camera.node.publisher("/image_rect/rect_color", IMAGE, Qos())
        camera.color = color
        camera.send_later(0, 10.0)
        source = opened(network, f"ros2:/{color.topic},{camera.depth.topic}?wait=5")
        assert (source._frames._recording.distortion is not None) is distorted
        assert source.camera.fx == (60.0 if distorted else 50.0)
        source.close()


def send_lens(camera: TopicCamera) -> None:
    message = camera_info_message(camera.types, Lens("color_optical", CAMERA), 1.0)
    message.d[:2] = (0.1, -0.05)
    message.p[0] = message.p[5] = 50.0
    camera.info.send(camera.types.encode(INFO, message))


def test_clock_that_goes_back(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"))
    source = started(network, camera)
    said: list[str] = []
    source.follow(lambda: True, said.append)
    frames, times = source.frames(), []
    for i, stamp in enumerate((10.0, 10.1, 5.0, 5.1)):
        if i:
            camera.send(i, stamp)
            network.settle()
        times.append(next(frames).timestamp)
    assert times == pytest.approx([10.0, 10.1, 10.2, 10.3])
    assert any("went back by 5.1 s (played again?)" in text for text in said)
    assert any("frame 2: time went back" in text for text in said)


def test_headers_without_time(network: LocalNetwork) -> None:
    """Zeros, image for image: then times are those of coming. One zero is a time like others."""
    camera = TopicCamera(network.node("camera"))
    camera.send_later(0, 0.0)
    source = opened(network, PATIENT)
    frames = source.frames()
    assert next(frames).timestamp == 0.0
    for i in (1, 2):
        camera.send(i, 0.0)
        assert abs(next(frames).timestamp - time.time()) < 60
    camera.send(3, 0.0)
    assert source.counts()["pairs"] == 3 and not source._inbox.matcher.jumps


def test_silence(network: LocalNetwork) -> None:
    """The publisher goes and another comes: the run goes on, and says so; it ends by itself only where asked."""
    camera = TopicCamera(network.node("camera"))
    source = started(network, camera, PATIENT + "&idle=0.8")
    said: list[str] = []
    source.follow(lambda: True, said.append)
    frames = source.frames()
    with overridden(LiveTopicsTuning, silent_s=0.2):
        next(frames)
        camera.node.close()
        again = TopicCamera(network.node("again"))
        threading.Timer(0.4, lambda: again.send(1, 11.0)).start()
        assert next(frames).timestamp == 11.0
        assert said[0].startswith("no images from `/camera/color` and `/camera/depth`, for ")
        assert said[1].startswith("images come again after")
        threading.Timer(0.1, lambda: again.send(2, 12.0, 0.3)).start()
        assert list(frames) == [] and "idle=0.8" in said[-1]
        assert "no two images were taken within 0.02 s of one another; the closest are 0.300 s apart" in said[-2]


def test_interrupt_while_nothing_comes(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"))
    sequence = LiveSequence(started(network, camera))
    threading.Timer(0.5, sequence.end).start()
    begin = time.monotonic()
    assert len(list(sequence.stream())) == 1 and time.monotonic() - begin < 2.0
    assert sequence.since == "arrival"


def damaged_messages(camera: TopicCamera, count: int) -> Iterator[tuple[bool, bytes]]:
    """Colour and depth by turns, with bytes changed, cut, or invented; most with times that fit together."""
    rng = np.random.default_rng(0)
    whole = [camera.message(which, 0, 10.0) for which in ("color", "depth")]
    for n in range(count):
        content = bytearray(whole[n % 2])
        how = rng.integers(4)
        if how == 0:
            content = content[: rng.integers(len(content))]
        elif how == 1:
            content = bytearray(rng.bytes(int(rng.integers(200))))
        else:
            for _ in range(int(rng.integers(1, 5))):
                content[int(rng.integers(4 if how == 2 else 100))] = int(rng.integers(256))
        if rng.random() < 0.9 and len(content) > 12:
            content[:12] = bytes((0, 1, 0, 0)) + np.array([20 + n // 2, 0], np.uint32).tobytes()
        yield bool(n % 2), bytes(content)


@pytest.mark.parametrize("compressed", [False, True], ids=["raw", "compressed"])
def test_damaged_messages(network: LocalNetwork, compressed: bool) -> None:
    """10,000 of them: counted and named, and the next whole one is a frame."""
    camera = TopicCamera(network.node("camera"), compressed=compressed)
    source = started(network, camera)
    said: list[str] = []
    source.follow(lambda: True, said.append)
    frames = source.frames()
    next(frames)
    takers = source._inbox.taker("color"), source._inbox.taker("depth")
    for is_depth, content in damaged_messages(camera, 5000):
        takers[is_depth](Received(content, 1.0))
        pair = source._inbox.take(0.0)
        try:
            if pair is not None:
                source._frames.frame(0, pair)
        except GgslamError as error:
            source._inbox.note_damage("/camera/color or /camera/depth", str(error))
    for stamp in (1e9, 1e9 + 1):  # whatever time the last damaged one had
        camera.send(1, stamp)
        network.settle()
    np.testing.assert_array_equal(next(frames).depth, depth_of(1))
    assert source.counts()["damaged"] > 1500
    assert 1 <= sum("damaged message of /camera/" in text for text in said) <= 3


def test_qos(network: LocalNetwork) -> None:
    """Best effort meets every writer; reliable does not meet a sensor's."""
    camera = TopicCamera(network.node("camera"), qos=Qos(reliable=False))
    started(network, camera).close()
    with pytest.raises(SequenceError, match="no message on `/camera/color`"):
        started(network, camera, ADDRESS + "&qos=reliable")


def test_namespace_and_kinds(network: LocalNetwork) -> None:
    camera = TopicCamera(network.node("camera"), "/robot1/camera", compressed=True)
    source = started(network, camera, PATIENT + "&namespace=robot1")
    assert source._topics["color"] == "/robot1/camera/color/compressed"
    assert {camera.color.kind, camera.depth.kind} == {COMPRESSED} and IMAGE not in network.node("x").topics().values()
