# SPDX-License-Identifier: Apache-2.0
"""Pictures of what an edit did."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ggslam.objects.editing import Change
from ggslam.objects.hole_views import CameraView, HoleViewTuning, mark_removed
from ggslam.objects.segmented_rows import join_gaussians
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians
from ggslam.reporting.pictures import color_to_uint8, compare_pictures
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class EditPictureTuning(Tuning):
    """Which frames show an edit."""

    pictures = 4
    """Pictures that are written."""
    candidates = 60
    """Most frames among which the best are chosen."""


def before_and_after(
    original: GaussianMap, edited: GaussianMap, changes: Sequence[Change], camera_of: Callable[[int], Camera],
    record: KeyframesRecord,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Before, after and difference (colour, and depth below) from the frames that show the edits best.

    Args:
        original: the map before.
        edited: the map after.
        changes: what was done; changes that cannot be seen make no pictures.
        camera_of: tells the camera of a frame.
        record: of the run.

    Returns:
        Pictures uint8 [H, W, 3] by file name.
    """
    visible = [change for change in changes if len(change.before.means) or len(change.after.means)]
    if not visible:
        return {}
    poses = record.poses()
    numbers = np.array(sorted(poses))
    looked_at = numbers[np.unique(np.linspace(0, len(numbers) - 1, EditPictureTuning.candidates).round().astype(int))]
    views = [CameraView(camera_of(frame), inverse(poses[frame]), frame) for frame in looked_at.tolist()]
    before, after = (join_gaussians([getattr(c, name) for c in visible]) for name in ("before", "after"))
    areas = _areas(original, before, views) + _areas(edited, after, views)
    pictures, rasterizer = {}, CpuRasterizer()
    for number in _best(areas, EditPictureTuning.pictures):
        images = []
        for gaussians in (original, edited):
            out = rasterizer.forward(gaussians, views[number].camera, views[number].T_camera_world, features=False)
            depth = np.where(out.alpha.numpy() > 0.5, out.expected_depth.numpy(), 0)
            images.append((color_to_uint8(out.image.numpy()), depth))
        (color, depth), (new_color, new_depth) = images
        pictures[f"edit{looked_at[number]:06d}.png"] = compare_pictures(color, new_color, depth, new_depth)
    return pictures


def _areas(gaussians: Gaussians, part: Gaussians, views: Sequence[CameraView]) -> np.ndarray:
    """Pixels of each view in which `part` of a map is seen."""
    if not len(part.means):
        return np.zeros(len(views), int)
    rasterizer, both, out = CpuRasterizer(), mark_removed(gaussians, part), []
    for view in views:
        image = rasterizer.forward(both, view.camera, view.T_camera_world).features
        out.append(0 if image is None else int((image[0].numpy() > HoleViewTuning.covered / 2).sum()))
    return np.array(out)


def _best(areas: np.ndarray, count: int) -> list[int]:
    """Numbers of views with large areas, apart from each other: the best view of each stretch of the recording."""
    apart = max(1, len(areas) // (2 * count))
    chosen: list[int] = []
    for number in np.argsort(-areas, kind="stable").tolist():
        good = areas[number] > 0.3 * areas.max() and all(abs(number - other) >= apart for other in chosen)
        if good and len(chosen) < count:
            chosen.append(number)
    return sorted(chosen)
