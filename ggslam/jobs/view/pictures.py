# SPDX-License-Identifier: Apache-2.0
"""Pictures for the viewer: recorded beside rendered, a view from anywhere, the object under a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ggslam.objects.rendered_ids import object_ids
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import GaussianTensors, low_pass_for
from ggslam.reporting.pictures import (
    IdentityColors,
    IdentityPictureTuning,
    color_of_depth,
    color_of_ids,
    color_to_uint8,
    depth_range,
)
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class FramePictureTuning(Tuning):
    """How recorded and rendered frames are laid out."""

    width = 320
    """Width of each picture, in pixels."""
    gap = 6
    """Pixels between pictures."""
    bar_height = 26
    """Height of the line of text above a picture, in pixels."""


class ViewPictures:
    """Renders a map; one caller at a time.

    Args:
        gaussians: the map.
        segmented: the same with its objects, if it has any.
        camera_of: tells the camera of a frame.
        recorded: gives a frame's images, None if the recording is not there.
        trained: the cameras whose pictures taught the map; none: not known.
    """

    def __init__(
        self, gaussians: GaussianMap, segmented: SegmentedMap | None, camera_of: Callable[[int], Camera],
        recorded: Callable[[int], Frame | None], trained: Sequence[Camera],
    ) -> None:  # fmt: skip
        self._gaussians, self._segmented, self._camera_of, self._recorded = gaussians, segmented, camera_of, recorded
        self._trained = trained
        self._rasterizer = CpuRasterizer()
        self.identity: IdentityColors | None = None if segmented is None else _identity_colors(segmented)

    def compare(self, frame: int, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `ViewedMap.frame_picture`."""
        segmented, whole = self._segmented, self._camera_of(frame)
        camera = whole.resize(FramePictureTuning.width, round(whole.height * FramePictureTuning.width / whole.width))
        view = self._rasterizer.forward(
            self._gaussians, camera, inverse(T_world_camera), features=segmented is not None,
            low_pass=low_pass_for(camera, self._trained),
        )  # fmt: skip
        rendered, alpha = color_to_uint8(view.image.numpy()), view.alpha.numpy()
        depth = np.where(alpha > 0.5, view.expected_depth.numpy(), 0)
        found = self._recorded(frame)
        near, far = depth_range(depth if found is None or not found.depth.any() else found.depth)
        cells = [("rendered", rendered), ("depth, rendered", color_of_depth(depth, near, far))]
        if found is not None:
            measured = color_of_depth(found.depth, near, far)
            cells = [("recorded", found.color), cells[0], ("depth, recorded", measured), cells[1]]
        if segmented is not None:
            ids = object_ids(self._rasterizer, view, segmented)
            cells.append(("objects", color_of_ids(ids, segmented.table.palette(), outlines=True)))
        if self.identity is not None and view.features is not None:
            cells.append(("identity (PCA)", self.identity.picture(view.features.numpy(), alpha)))
        return table_of(cells, (camera.width, camera.height)), rendered if found is None else found.color

    def picture(self, camera: Camera, T_world_camera: np.ndarray, hidden: set[int]) -> np.ndarray:
        """See `ViewedMap.picture`."""
        part = self._visible(hidden)
        low_pass = low_pass_for(camera, self._trained)
        view = self._rasterizer.forward(part, camera, inverse(T_world_camera), features=False, low_pass=low_pass)
        return color_to_uint8(view.image.numpy())

    def _visible(self, hidden: set[int]) -> GaussianMap | GaussianTensors:
        """The Gaussians that are not hidden."""
        g = self._gaussians
        if not hidden:
            return g
        kept = np.flatnonzero(~np.isin(g.object_id.numpy(), list(hidden)))
        return GaussianTensors(
            g.means[kept], g.quaternions[kept], g.log_scales[kept], g.opacity_logits[kept], g.sh[kept],
            g.features[kept],
        )  # fmt: skip


def table_of(cells: list[tuple[str, np.ndarray]], size: tuple[int, int]) -> np.ndarray:
    """Pictures of one size (width, height), two a row, each with its name above; uint8 [H, W, 3] on dark grey."""
    width, height = size
    rows = -(-len(cells) // 2)
    gap, bar = FramePictureTuning.gap, FramePictureTuning.bar_height
    sheet = np.full((rows * (height + bar + gap) - gap, 2 * width + gap, 3), 36, np.uint8)
    for number, (name, picture) in enumerate(cells):
        left, top = number % 2 * (width + gap), number // 2 * (height + bar + gap)
        cv2.putText(sheet, name, (left + 2, top + 18), cv2.FONT_HERSHEY_SIMPLEX, 0.62, (225, 225, 225), 1, cv2.LINE_AA)
        shown = picture
        if picture.shape[:2] != (height, width):
            shown = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        sheet[top + bar : top + bar + height, left : left + width] = shown
    return sheet


def _identity_colors(segmented: SegmentedMap) -> IdentityColors | None:
    """Colours of identity vectors, fitted to those of the labelled Gaussians; None if there are none."""
    if not segmented.gaussians.feature_channels:
        return None
    labelled = np.flatnonzero(segmented.gaussians.object_id.numpy() > 0)
    if not len(labelled):
        return None
    return IdentityColors(
        segmented.gaussians.features.numpy()[labelled[:: max(1, len(labelled) // IdentityPictureTuning.fitted)]]
    )
