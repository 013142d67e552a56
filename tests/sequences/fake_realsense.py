# SPDX-License-Identifier: Apache-2.0
"""A stand-in for the package pyrealsense2: one camera (or recording) with five frames, depth beside colour.

Colour sees depth shifted by 30 * 0.05 / z pixels; depth comes in tenths of a millimetre.
"""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import numpy as np

FRAMES, WIDTH, HEIGHT = 5, 32, 24
UNIT = 0.0001


def intrinsics(coefficients: tuple[float, ...] = (0.0,) * 5, model: str = "inverse_brown_conrady") -> Any:
    return types.SimpleNamespace(
        width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, ppx=15.5, ppy=11.5, coeffs=list(coefficients), model=model
    )


class Stream:
    def __init__(self, lens: Any) -> None:
        self.lens = lens

    def as_video_stream_profile(self) -> Stream:
        return self

    def get_intrinsics(self) -> Any:
        return self.lens

    def get_extrinsics_to(self, other: Stream) -> Any:
        return types.SimpleNamespace(rotation=np.eye(3).ravel().tolist(), translation=[-0.05, 0.0, 0.0])


class Image:
    def __init__(self, data: np.ndarray, time: float, form: str) -> None:
        self.data, self.time, self.form = data, time, form

    def __bool__(self) -> bool:
        return True

    def get_data(self) -> np.ndarray:
        return self.data

    def get_timestamp(self) -> float:
        return self.time

    def get_profile(self) -> Any:
        return types.SimpleNamespace(format=lambda: self.form)


class Pipeline:
    started, stopped = 0, 0

    def __init__(self) -> None:
        self.next = 0

    def start(self, config: Config) -> Any:
        if config.file is not None and b"/device_0/sensor_" not in Path(config.file).read_bytes():
            raise RuntimeError("Failed to resolve request.\n  No device connected")
        Pipeline.started += 1
        streams = {"color": Stream(intrinsics(config.lens)), "depth": Stream(intrinsics())}
        device = types.SimpleNamespace(
            as_playback=lambda: types.SimpleNamespace(set_real_time=lambda wanted: None),
            first_depth_sensor=lambda: types.SimpleNamespace(get_depth_scale=lambda: UNIT),
        )
        return types.SimpleNamespace(get_device=lambda: device, get_stream=lambda name: streams[name])

    def try_wait_for_frames(self, timeout: int) -> tuple[bool, Any]:
        i, self.next = self.next, self.next + 1
        if i >= FRAMES:
            return False, None
        color = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        color[:] = (200, 100, 10 * i)
        depth = np.full((HEIGHT, WIDTH), round((1 + i / 10) / UNIT), np.uint16)
        images = Image(color, 1000.0 + 33 * i, "bgr8"), Image(depth, 1000.0 + 33 * i, "z16")
        return True, types.SimpleNamespace(get_color_frame=lambda: images[0], get_depth_frame=lambda: images[1])

    def stop(self) -> None:
        Pipeline.stopped += 1


class Config:
    lens: tuple[float, ...] = (0.0,) * 5

    def __init__(self) -> None:
        self.file: str | None = None

    def enable_device_from_file(self, path: str, repeat: bool) -> None:
        self.file = path

    def enable_device(self, serial: str) -> None:
        if serial != "123":
            raise RuntimeError("No device connected")

    def enable_stream(self, *values: Any) -> None:
        pass


def module() -> Any:
    """What `import pyrealsense2` shall give."""
    names = ("none", "kannala_brandt4", "inverse_brown_conrady", "brown_conrady", "modified_brown_conrady")
    return types.SimpleNamespace(
        pipeline=Pipeline, config=Config, stream=types.SimpleNamespace(color="color", depth="depth"),
        format=types.SimpleNamespace(rgb8="rgb8", bgr8="bgr8", yuyv="yuyv", z16="z16"),
        distortion=types.SimpleNamespace(**{name: name for name in names}),
    )  # fmt: skip
