# SPDX-License-Identifier: Apache-2.0
"""Frames of pairs of image messages, made as those of a bag are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.middleware.node import Received
from ggslam.middleware.types import MessageTypes
from ggslam.scene.frame import Frame
from ggslam.sequences.formats.ros2_address import SCHEME
from ggslam.sequences.formats.ros2_inbox import ImagePair
from ggslam.sequences.formats.ros_calibration import DepthInfo, is_registered, lens_of, place_of_depth
from ggslam.sequences.formats.ros_images import color_image, depth_in_unit, in_metres, is_depth, pixel_encoding
from ggslam.sequences.formats.ros_topics import fixed_transform, is_rectified
from ggslam.sequences.images import metric_depth, no_returns
from ggslam.sequences.pixel_grid import ImageGeometry, image_size
from ggslam.sequences.recording import FrameFiles, Recording
from ggslam.system.opencv import opencv_errors

FixedFrames = Callable[[Callable[[list[Any]], bool]], list[Any]]
"""Messages of /tf_static, waited for until they tell what is asked."""


@dataclass(frozen=True)
class TopicInfos:
    """The topics of images, and what camera_info says of them; of depth it may be missing."""

    color: str
    depth: str
    color_info: str
    color_message: Any
    depth_info: str | None
    depth_message: Any


@dataclass(frozen=True)
class TopicImage:
    """Where images come from, with the names of an `ImageSource`, for messages."""

    topic: str

    @property
    def name(self) -> str:
        return self.topic

    @property
    def stem(self) -> str:
        return self.topic

    def __str__(self) -> str:
        return self.topic

    def read(self) -> np.ndarray:
        raise SequenceError(f"{self.topic}: live images are not read again")


class FrameMaker:
    """Makes frames; the first pair tells sizes and units.

    Args:
        types: message types.
        kinds: type of each topic.
        told: the topics and their cameras.
        first: pair of images.
        scale: size of the delivered images, in (0, 1].
        fixed: of frames that stand still to each other.

    Raises:
        SequenceError: the first pair cannot be read, or does not fit the cameras.
    """

    def __init__(
        self, types: MessageTypes, kinds: dict[str, str], told: TopicInfos, first: ImagePair, scale: float,
        fixed: FixedFrames,
    ) -> None:  # fmt: skip
        self._types, self._told = types, told
        self._kinds = (kinds[told.color], kinds[told.depth])
        color, depth = self._decode(first)
        if is_depth(color) or is_depth(depth) is False:
            found = f"{told.color} holds {pixel_encoding(color)} and {told.depth} {pixel_encoding(depth)}"
            raise SequenceError(f"{found}: expected colour first, then depth")
        self._metres = in_metres(depth)
        lens = lens_of(told.color_info, told.color_message, is_rectified(told.color))
        self._recording = Recording(
            SCHEME, Path(told.color.strip("/").replace("/", "-")), [], np.zeros(0), 1.0 if self._metres else 1000.0,
            lens.camera, distortion=lens.distortion, fisheye=lens.fisheye, time_source=f"headers of {told.color}",
        )  # fmt: skip
        self._place_depth(color, depth, fixed)
        self._files = FrameFiles(TopicImage(told.color), TopicImage(told.depth))
        images = self._images(color, depth)
        with opencv_errors(told.color, SequenceError):
            sizes = image_size(images[0]), image_size(images[1])
            self._geometry = ImageGeometry(self._recording, self._files, *sizes, scale)
        self.camera = self._geometry.camera
        self.warnings = self._recording.warnings

    def _decode(self, pair: ImagePair) -> tuple[Any, Any]:
        return self._message(0, pair.color.content), self._message(1, pair.depth.content)

    def _message(self, which: int, received: Received) -> Any:
        return self._types.decode(self._kinds[which], received.content)

    def _images(self, color: Any, depth: Any) -> tuple[np.ndarray, np.ndarray]:
        """Colour as stored, depth in the unit of the first message."""
        return color_image(self._told.color, color), depth_in_unit(self._told.depth, depth, self._metres)

    def _place_depth(self, color: Any, depth: Any, fixed: FixedFrames) -> None:
        """Tells how the depth camera stands to the colour camera, or warns."""
        told = self._told
        if told.depth_info is None or is_registered(told.depth):
            return
        if told.depth_message is None:
            self._recording.warnings.append(f"{told.depth_info} does not come: depth is taken as registered to colour")
            return
        assert self._recording.camera is not None

        def transform(to: str, start: str) -> np.ndarray | None:
            messages = fixed(lambda held: fixed_transform(held, to, start) is not None)
            return fixed_transform(messages, to, start)

        info = DepthInfo(told.depth_info, told.depth_message, is_rectified(told.depth))
        frames = str(color.header.frame_id), str(depth.header.frame_id)
        stand = place_of_depth(self._recording.camera, info, *frames, transform)
        self._recording.depth_camera = stand.camera
        self._recording.warnings += [stand.doubt] if stand.doubt else []

    def frame(self, index: int, pair: ImagePair) -> Frame:
        """The frame of a pair.

        Raises:
            GgslamError: it is damaged, or of another size than the first one.
        """
        with opencv_errors(f"{self._told.color}, frame {index}", SequenceError):
            color, raw = self._images(*self._decode(pair))
            depth, geometry = metric_depth(raw, self._recording.depth_scale), self._geometry
            geometry.check(color, depth, self._files)
            found, missing = geometry.depth(depth, color), no_returns(raw)
            return Frame(
                index=index, source_index=index, timestamp=pair.color.stamp, color=geometry.color(color), depth=found,
                camera=self.camera, valid=geometry.valid,
                no_return=None if missing is None else geometry.no_return(missing, depth, found, color, self._files),
                depth_delay=pair.depth.stamp - pair.color.stamp,
            )  # fmt: skip
