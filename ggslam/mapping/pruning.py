# SPDX-License-Identifier: Apache-2.0
"""Removes useless Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch

from ggslam.geometry.image_parts import is_in_image_part
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.settings import PruningSettings
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import transform_points
from ggslam.sight.margin import Margin
from ggslam.system.tuning import Tuning


class PruningTuning(Tuning):
    """Removal of useless Gaussians."""

    outline_pixels = 4
    """Width, in pixels of a 320 pixel wide image, of the outlines within which depth counts as that of the nearer
    surface."""
    first_look = 10
    """Keyframes after which hidden Gaussians are searched for the first time."""


_THICKNESS = Margin()
"""How far Gaussians of a surface may lie before and behind what was measured of it."""


def prune(gaussians: GaussianMap, settings: PruningSettings) -> int:
    """Drops transparent, huge and non-finite Gaussians; returns how many.

    Transparency also catches floaters: a Gaussian in front of the surface hides what is measured behind it, so the
    colour and depth losses drive its opacity down in every keyframe that looks through it.
    """
    logit, log_scale = pruning_limits(settings)
    good = (gaussians.opacity_logits > logit) & (gaussians.log_scales.amax(1) < log_scale)
    good &= torch.isfinite(gaussians.means).all(1)
    return gaussians.keep(good)


def pruning_limits(settings: PruningSettings) -> tuple[float, float]:
    """Logit of opacity above which, and logarithm of the largest standard deviation below which, Gaussians stay."""
    return math.log(settings.min_opacity / (1 - settings.min_opacity)), math.log(settings.max_scale_m)


def is_look_due(keyframes: int) -> bool:
    """Whether one looks for what surfaces hide when there are so many keyframes: 10, 20, 40, ... As there are ever more
    of them to look from, the looks take about twice as long as the last of them."""
    turns, rest = divmod(keyframes, PruningTuning.first_look)
    return rest == 0 and turns.bit_count() == 1


def drop_moved(gaussians: GaussianMap, parts: Sequence[tuple[Keyframe, np.ndarray]]) -> None:
    """Takes out what keyframes have mapped, and measured, in parts of their images, bool [H, W]: it has moved since."""
    birth, means = gaussians.birth_keyframe.cpu().numpy(), gaussians.means.detach().cpu().numpy()
    stays = np.ones(len(gaussians), bool)
    for keyframe, part in parts:
        rows = np.flatnonzero(birth == keyframe.index)
        stays[rows] = ~is_in_image_part(transform_points(means[rows], keyframe.T_camera_world), part, keyframe.camera)
        blank_part(keyframe, part)
    gaussians.keep(torch.from_numpy(stays))


def drop_before(
    gaussians: GaussianMap, births: np.ndarray, parts: Sequence[tuple[Keyframe, np.ndarray, np.ndarray]]
) -> int:
    """Takes out what keyframes saw that is gone, but not what lies before or behind it.

    Args:
        gaussians: the map.
        births: numbers of the keyframes whose Gaussians may go.
        parts: keyframes; bool [H, W], what was there is gone; and bool [H, W], the same with its outlines.

    Returns:
        How many Gaussians went.
    """
    rows = np.flatnonzero(np.isin(gaussians.birth_keyframe.cpu().numpy(), births))
    means, goes = gaussians.means.detach().cpu().numpy()[rows], np.zeros(len(rows), bool)
    for keyframe, gone, around in parts:
        reach = 1 + 2 * max(1, round(PruningTuning.outline_pixels * keyframe.camera.width / 320))
        window, depth = np.ones((reach, reach), np.uint8), keyframe.depth_m()
        known = gone & (depth > 0)
        # Of the thing; about it images show what is farther, or nearer and hides a part of it.
        first = cv2.erode(np.where(known, depth, np.float32(np.inf)), window)
        last = cv2.dilate(np.where(known, depth, np.float32(0)), window)
        seen = transform_points(means, keyframe.T_camera_world)
        row, column, inside = keyframe.camera.project(seen)
        near, far = first[row, column], last[row, column]
        thick = _THICKNESS(far)
        within = (seen[:, 2] > near - thick) & (seen[:, 2] < far + thick)
        goes |= inside & around[row, column] & within
    stays = np.ones(len(gaussians), bool)
    stays[rows] = ~goes
    gaussians.keep(torch.from_numpy(stays))
    return int(goes.sum())


def blank_part(keyframe: Keyframe, part: np.ndarray) -> None:
    """From now on a keyframe's images say nothing in a part of them, bool [H, W]."""
    keyframe.moving = part if keyframe.moving is None else keyframe.moving | part
    keyframe.depth = np.where(part, np.uint16(0), keyframe.depth)
    if keyframe.mask is not None:
        keyframe.mask = np.where(part, np.uint16(0), keyframe.mask)


def drop_pixels(gaussians: GaussianMap, keyframes: Sequence[Keyframe], part: np.ndarray, nearest: float) -> None:
    """Takes out what keyframes have mapped, and measured, in a part of their images, bool [H, W], or nearer than some
    metres. Keyframes of other recordings, and those with images of another size, are left alone."""
    birth, means = gaussians.birth_keyframe.cpu().numpy(), gaussians.means.detach().cpu().numpy()
    stays = np.ones(len(gaussians), bool)
    for keyframe in keyframes:
        camera = keyframe.camera
        if keyframe.frame_index == FROM_EARLIER_RUN or (camera.height, camera.width) != part.shape:
            continue
        rows = np.flatnonzero(birth == keyframe.index)
        seen = transform_points(means[rows], keyframe.T_camera_world)
        stays[rows] = ~is_in_image_part(seen, part, camera) & (seen[:, 2] >= nearest)
        keyframe.depth = np.where(part | (keyframe.depth_m() < nearest), np.uint16(0), keyframe.depth)
    gaussians.keep(torch.from_numpy(stays))
