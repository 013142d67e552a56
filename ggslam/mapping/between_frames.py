# SPDX-License-Identifier: Apache-2.0
"""Frames between keyframes that the final refinement trains on, too.

A map that is trained on few images learns their noise (of JPEG, of pixels that lie on edges); frames between them have
other noise. They are kept coded, without depth: keyframes tell where surfaces are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.system.array_forms import Form, MaybeNan, Pose
from ggslam.system.images import claimed_size
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class BetweenTuning(Tuning):
    """Training on frames between keyframes."""

    most_noise = 0.15
    """Noise of depth in the image, pixels, from which poses are not known well enough. Exact depth at 640x480 has 0.05,
    a phone 0.19, a Kinect 0.9."""
    jpeg_quality = 95
    """JPEG quality of kept images, of 100. A map trained on them is within 0.001 dB of one trained on the originals."""
    header_bytes = 4096
    """First bytes of a JPEG file in which its size is looked for."""
    kept_bytes = 40 << 20
    """Most bytes of kept images. Keyframes that come later have no frames beside them."""
    most_gain = 0.02
    """How much brighter or darker than the map a frame may be, as a natural logarithm. At one exposure frames of a
    living room are within 0.006, all but a twentieth of those of a kitchen within 0.015."""
    least_sharpness = 0.8
    """Least contrast of a frame between neighbouring pixels, against the map's, as a share of its keyframe's. Of images
    in focus it is 0.96 or more, blurred by 3 pixels 0.37."""
    own_every = 2
    """A keyframe is trained itself every so manyth of its visits, else a frame beside it, which teaches colours only: 3
    instead gains 0.04 dB, and depth is an eighth less accurate."""
    depth_factor = 2.0
    """Factor on the weight of depth in a keyframe's own visits: frames beside it have none."""
    depth_factor_fine = 1.6
    """The same for large images, which tell themselves where edges are."""
    end_share = 2.0
    """Iterations of the final refinement per iteration before it: with more images there is more to be learned."""
    end_share_fine = 3.0
    """The same for large images."""
    fine_pixels = 200_000
    """Pixels of a large image."""


@savable(fixed="color")
@dataclass(frozen=True)
class BetweenFrame:
    """A frame that was located and is no keyframe.

    Attributes:
        keyframe: number of the keyframe that its pose hangs on.
        T_keyframe_camera: float64 [4, 4], its pose relative to that keyframe.
        color: its colours as a JPEG file, uint8.
    """

    frame_index: int
    timestamp: MaybeNan
    keyframe: int
    T_keyframe_camera: Pose
    color: Annotated[np.ndarray, Form("u1", None)]

    def check(self, keyframe: Keyframe) -> None:
        """Raises FormatError if its image does not claim to be of its keyframe's size: it may come from a file."""
        if claimed_size(self.color[: BetweenTuning.header_bytes].tobytes()) != _size_of(keyframe):
            raise _foreign()

    def view(self, keyframe: Keyframe) -> Keyframe:
        """The frame as a keyframe without depth, with the number of the one that it hangs on.

        Raises:
            FormatError: its image is not of the keyframe's size: it may come from a file.
        """
        image = self.decode(keyframe)
        return Keyframe(
            keyframe.index, self.frame_index, self.timestamp, keyframe.camera, image,
            np.zeros(image.shape[:2], np.uint16), inverse(keyframe.T_world_camera @ self.T_keyframe_camera),
            camera_number=keyframe.camera_number, depth_unit=keyframe.depth_unit,
        )  # fmt: skip

    def decode(self, keyframe: Keyframe) -> np.ndarray:
        """Its colours, uint8 [H, W, 3]; raises FormatError as `view`."""
        self.check(keyframe)
        image = cv2.imdecode(self.color, cv2.IMREAD_COLOR)
        if image is None or image.shape[1::-1] != _size_of(keyframe):
            raise _foreign()
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _size_of(keyframe: Keyframe) -> tuple[int, int]:
    return keyframe.camera.width, keyframe.camera.height


def _foreign() -> FormatError:
    return FormatError("frames between keyframes: the image of one is not of this recording")


def code_frame(frame: Frame, keyframe: int, T_keyframe_camera: np.ndarray) -> BetweenFrame:
    """A frame as it is kept; arguments as the attributes of `BetweenFrame`."""
    how = [cv2.IMWRITE_JPEG_QUALITY, BetweenTuning.jpeg_quality]
    how += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]  # hues as sharp as grey values
    coded = cv2.imencode(".jpg", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR), how)[1]
    return BetweenFrame(frame.index, frame.timestamp, keyframe, T_keyframe_camera, coded.reshape(-1))


def depth_factor(camera: Camera) -> float:
    """Factor on the weight of depth where a keyframe with this camera has frames beside it."""
    return float(BetweenTuning.depth_factor_fine if _is_fine(camera) else BetweenTuning.depth_factor)


def end_share(camera: Camera) -> float:
    """Iterations of the final refinement per iteration before it where keyframes with this camera have frames beside
    them."""
    return float(BetweenTuning.end_share_fine if _is_fine(camera) else BetweenTuning.end_share)


def _is_fine(camera: Camera) -> bool:
    return camera.width * camera.height >= BetweenTuning.fine_pixels


def frame_of_turn(turn: int, beside: Sequence[BetweenFrame]) -> BetweenFrame | None:
    """What the `turn`-th visit of a keyframe with these frames beside it trains; None: the keyframe itself, on every
    second visit (`BetweenTuning.own_every`) and if there are none."""
    own = BetweenTuning.own_every
    if turn % own == 0 or not beside:
        return None
    return beside[(turn - turn // own - 1) % len(beside)]
