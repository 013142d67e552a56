# SPDX-License-Identifier: Apache-2.0
"""RealSense cameras, live and recorded by their own tools (.bag), through pyrealsense2.

Depth is registered to colour and distortion is undone here, not by librealsense, so that live frames, recordings and
all other formats go through the same code.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.errors import MissingDependency, SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.pixel_grid import ImageGeometry, image_size
from ggslam.sequences.recording import NO_OPTIONS, DepthCamera, FrameFiles, NumberedImage, ReadOptions, Recording
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted


class RealsenseTuning(Tuning):
    """How long a camera or a file is waited for or searched."""

    timeout_ms = 5000
    """Longest wait for a frame, in milliseconds."""
    sniffed_bytes = 1 << 20
    """Bytes of a .bag file that are searched for RealSense's topics."""


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError:
        raise MissingDependency("RealSense needs pyrealsense2: pip install 'ggslam[realsense]'") from None
    return pyrealsense2


class Device:
    """A running pipeline: pairs of colour and depth images of a camera or of a recording.

    Attributes:
        calibration: of the two cameras, as a recording without frames.
    """

    def __init__(
        self, path: Path | None = None, serial: str = "", size: tuple[int, int] = (640, 480), rate: int = 30,
        options: ReadOptions = NO_OPTIONS,
    ) -> None:  # fmt: skip
        """Starts the recording `path`, or else the camera with this serial number (empty: the first one found).

        Raises:
            MissingDependency: without pyrealsense2.
            SequenceError: no such camera, or no colour or depth in the recording.
        """
        rs = self._rs = _library()
        self._place = "realsense" if path is None else str(path)
        config, self._pipeline = rs.config(), rs.pipeline()
        try:
            if path is not None:
                config.enable_device_from_file(str(path), False)
            else:
                if serial:
                    config.enable_device(serial)
                config.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate)
                config.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
            profile = self._pipeline.start(config)
            device = profile.get_device()
            if path is not None:
                device.as_playback().set_real_time(False)
            self.depth_scale = 1.0 / device.first_depth_sensor().get_depth_scale()
            color, depth = profile.get_stream(rs.stream.color), profile.get_stream(rs.stream.depth)
            self.calibration = self._calibration(color, depth, options)
        except RuntimeError as error:  # what librealsense raises for everything
            raise SequenceError(f"{self._place}: {' '.join(str(error).split())}") from None

    def _calibration(self, color: Any, depth: Any, options: ReadOptions) -> Recording:
        color_lens, depth_lens = (s.as_video_stream_profile().get_intrinsics() for s in (color, depth))
        extrinsics = depth.get_extrinsics_to(color)
        T = np.eye(4)
        T[:3, :3] = np.asarray(extrinsics.rotation, float).reshape(3, 3).T  # written column by column
        T[:3, 3] = extrinsics.translation
        distortion, fisheye = options.recorded_camera(lambda: self._distortion(color_lens)) or (None, False)
        beside = options.recorded_depth_camera(
            lambda: DepthCamera(_camera(depth_lens), T, *self._distortion(depth_lens))
        )
        return Recording(
            "realsense", Path(self._place), [], np.zeros(0), self.depth_scale, _camera(color_lens),
            depth_camera=beside, distortion=distortion, fisheye=fisheye, time_source="the camera's clock",
        )  # fmt: skip

    def _distortion(self, lens: Any) -> tuple[np.ndarray | None, bool]:
        models, values = self._rs.distortion, np.asarray(lens.coeffs, float)
        if lens.model == models.none or not np.any(values):
            return None, False
        if lens.model == models.kannala_brandt4:
            return values[:4], True
        if lens.model == models.inverse_brown_conrady:
            return _invert_distortion(values, _camera(lens)), False
        if lens.model in (models.brown_conrady, models.modified_brown_conrady):
            return values, False
        raise SequenceError(f"{self._place}: lens model {lens.model} is not supported")

    def pairs(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Time in seconds, colour uint8 [H, W, 3] RGB, depth uint16 [H, W], for as long as they come."""
        while True:
            arrived, frames = self._pipeline.try_wait_for_frames(RealsenseTuning.timeout_ms)
            if not arrived:
                return
            color, depth = frames.get_color_frame(), frames.get_depth_frame()
            if color and depth:
                image = self._rgb(color)
                yield 1e-3 * float(color.get_timestamp()), image, np.array(depth.get_data(), np.uint16)

    def _rgb(self, frame: Any) -> np.ndarray:
        formats, form, data = self._rs.format, frame.get_profile().format(), np.array(frame.get_data())
        if form == formats.rgb8:
            return data
        if form == formats.bgr8:
            return cv2.cvtColor(data, cv2.COLOR_BGR2RGB)
        if form == formats.yuyv:
            return cv2.cvtColor(data.view(np.uint8).reshape(*data.shape[:2], 2), cv2.COLOR_YUV2RGB_YUY2)
        raise SequenceError(f"{self._place}: colour of format {form} is not supported")

    def close(self) -> None:
        """Stops the pipeline."""
        self._pipeline.stop()


def _camera(lens: Any) -> Camera:
    return Camera(int(lens.width), int(lens.height), float(lens.fx), float(lens.fy), float(lens.ppx), float(lens.ppy))


def _invert_distortion(coefficients: np.ndarray, camera: Camera) -> np.ndarray:
    """OpenCV's coefficients of a lens whose polynomial turns distorted coordinates into straight ones instead.

    The model is linear in its coefficients: they are fitted on a grid of the image, within hundredths of a pixel for
    lenses that are usual.
    """
    k1, k2, p1, p2, k3 = coefficients[:5]
    distorted = camera.rays()[::8, ::8, :2].reshape(-1, 2).astype(float)
    xd, yd = distorted.T
    r = xd * xd + yd * yd
    factor = 1 + k1 * r + k2 * r**2 + k3 * r**3
    x = xd * factor + 2 * p1 * xd * yd + p2 * (r + 2 * xd * xd)
    y = yd * factor + 2 * p2 * xd * yd + p1 * (r + 2 * yd * yd)
    r = x * x + y * y
    rows_x = np.stack([x * r, x * r**2, 2 * x * y, r + 2 * x * x, x * r**3], 1)
    rows_y = np.stack([y * r, y * r**2, r + 2 * y * y, 2 * x * y, y * r**3], 1)
    wanted = np.concatenate([xd - x, yd - y])
    return np.linalg.lstsq(np.concatenate([rows_x, rows_y]), wanted, rcond=None)[0]


class Playback:
    """A recording, played as often as it takes. Frames in order are quick; going back starts it anew."""

    def __init__(self, path: Path, options: ReadOptions = NO_OPTIONS) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._options = options
        device = Device(path, options=options)
        self.calibration = device.calibration
        self.times = np.array([time for time, _, _ in device.pairs()])
        device.close()
        self._device: Device | None = None
        self._pairs: Iterator[tuple[float, np.ndarray, np.ndarray]] = iter(())
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None

    def pair(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth of frame `index`. Raises SequenceError if the recording does not play them again."""
        wanted = self.times[index]
        with self._lock:
            if self._last is None or self._last[0] > wanted:
                if self._device is not None:
                    self._device.close()
                self._device = Device(self.path, options=self._options)
                self._pairs, self._last = self._device.pairs(), (-np.inf, np.zeros(0), np.zeros(0))
            while self._last is not None and self._last[0] < wanted:
                self._last = next(self._pairs, None)
            if self._last is None or self._last[0] != wanted:
                raise SequenceError(f"{self.path}: frame {index} at {wanted:.3f} s was not played again")
            return self._last[1], self._last[2]


@dataclass(frozen=True)
class PlaybackImage(NumberedImage):
    """Colour or depth of a played frame; see `ImageSource`."""

    playback: Playback
    index: int
    part: int

    def __str__(self) -> str:
        return f"{self.playback.path}, frame {self.index}"

    def read(self) -> np.ndarray:
        return self.playback.pair(self.index)[self.part]


class RealSenseFormat:
    """A .bag that RealSense Viewer or rs-record wrote. (rosbags reads it too: --format ros1.)"""

    name = "realsense"
    layout = "one file .bag that RealSense's own tools wrote (needs pyrealsense2)"

    def matches(self, path: Path) -> bool:
        if not path.is_file() or path.suffix.lower() != ".bag":
            return False
        with open_untrusted(path, SequenceError) as file:
            return b"/device_0/sensor_" in file.read(RealsenseTuning.sniffed_bytes)

    def read(self, path: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        playback = Playback(path, options)
        recording = playback.calibration
        recording.path, recording.timestamps = path, playback.times
        recording.files = [
            FrameFiles(PlaybackImage(playback, i, 0), PlaybackImage(playback, i, 1)) for i in range(len(playback.times))
        ]
        return recording


class RealSenseCamera:
    """A live camera; see `live.LiveSource`.

    Args:
        serial: number of the camera; empty: the first one found.
        scale: size of the delivered images, in (0, 1].
    """

    def __init__(self, serial: str = "", scale: float = 1.0) -> None:
        self._device = Device(serial=serial)
        self._pairs = self._device.pairs()
        first = next(self._pairs, None)
        if first is None:
            raise SequenceError("realsense: the camera delivers no frames")
        place = FrameFiles(Path("realsense"), Path("realsense"))
        calibration, sizes = self._device.calibration, (image_size(first[1]), image_size(first[2]))
        self._geometry = ImageGeometry(calibration, place, *sizes, scale)
        self.name, self.camera = "realsense", self._geometry.camera

    def frames(self) -> Iterator[Frame]:
        """Yields the newest frame on each request; frames that arrive in between are dropped."""
        for index, (time, color, depth) in enumerate(self._pairs):
            metres = depth.astype(np.float32) / np.float32(self._device.depth_scale)
            yield Frame(
                index=index, source_index=index, timestamp=time, color=self._geometry.color(color),
                depth=self._geometry.depth(metres, color), camera=self.camera,
            )  # fmt: skip

    def close(self) -> None:
        """Stops the camera."""
        self._device.close()
