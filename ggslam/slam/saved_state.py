# SPDX-License-Identifier: Apache-2.0
"""The whole state of a `Slam` between two steps, so that another one can go on from there, bit for bit.

Every class says beside its own declaration what of it is saved (`ggslam.system.savable`); here stand what a state as a
whole must fulfil and the settings, which are saved as they are.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Sequence
from typing import Any

import numpy as np

from ggslam.errors import ConfigError, FormatError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.slam.config import Config
from ggslam.slam.filters.earlier_views import EarlierViews
from ggslam.slam.parts import run_library
from ggslam.slam.slam import Slam
from ggslam.system.object_tree import Keeper, Kept, describe, restore
from ggslam.system.savable import Rule, Rules, savable_classes
from ggslam.system.settings import group_of


def describe_state(slam: Slam, keeper: Keeper | None = None) -> tuple[Any, list[np.ndarray]]:
    """The state of a run between two steps as plain values and arrays (not copied: write them before the next step).

    Args:
        slam: which is not changed.
        keeper: keeps what never changes; None: everything is among the arrays.

    Raises:
        ConfigError: runs of this kind cannot be saved; see `reason_against_saving`.
    """
    reason = reason_against_saving(slam.config)
    if reason is not None:
        raise ConfigError(f"the state of the run cannot be saved: {reason}")
    return describe(slam, rules_of_state(), keeper)


def restore_state(slam: Slam, tree: Any, arrays: Sequence[np.ndarray], kept: Kept | None = None) -> None:
    """Brings a fresh `Slam` of the same camera and settings to a state that `describe_state` gave.

    Raises:
        FormatError: it is none, or one of other settings.
    """
    restore(tree, rules_of_state(), arrays, kept, into=slam)
    check_state(slam)


def reason_against_saving(config: Config) -> str | None:
    """Why the state of a run with these settings cannot be saved; None: it can."""
    if config.memory_limit_mb:
        return "memory is limited (memory_limit_mb)"
    on_cpu = config.device == "cpu" or (config.device == "auto" and run_library(config)[0] is None)
    return None if on_cpu else f"the map is on a GPU (device: {config.device})"


def check_state(slam: Slam) -> None:
    """Raises FormatError if parts of a state do not fit together, which compiled code would not survive."""
    mapper, surface = slam.mapper, slam.surface
    for number, keyframe in enumerate(mapper.keyframes):
        camera = keyframe.camera  # of another recording, which may have had more
        if keyframe.frame_index != FROM_EARLIER_RUN:
            if not 0 <= keyframe.camera_number < len(slam.cameras):
                raise FormatError(f"keyframe {number}: its camera is not the one of this recording")
            camera = slam.cameras[keyframe.camera_number]
        shape = (camera.height, camera.width)
        images = (keyframe.color, keyframe.depth)
        empty = all(image.size == 0 for image in images)
        good = empty or (keyframe.color.shape == (*shape, 3) and keyframe.depth.shape == shape)
        typed = keyframe.color.dtype == np.uint8 and keyframe.depth.dtype == np.uint16
        if not (good and typed and keyframe.index == number and keyframe.T_camera_world.shape == (4, 4)):
            raise FormatError(f"keyframe {number}: its camera is not the one of this recording")
    if not all(view.fits() for view in slam.movers.detector.views):
        raise FormatError("views for moving things: their camera is not the one of this recording")
    if not slam.filters.get(EarlierViews).check():
        raise FormatError("views of the starting map: their cameras are not those of its keyframes")
    slam.color_poses.check()
    counts = [len(surface), slam.poses.keyframes_made, len(mapper.keyframes)]
    if slam.loops is not None:
        counts += [len(slam.loops), len(slam.loops.places), len(slam.loops.parts.of)]
    if len(set(counts)) > 1:
        raise FormatError(f"the parts of the state disagree about the number of keyframes: {counts}")


def rules_of_state() -> Rules:
    """Classes whose objects a state may hold: those that declare themselves, and the settings of a run."""
    return {**dict.fromkeys(_settings_classes(Config) - {Config}, Rule(checked=True)), **savable_classes}


@functools.cache
def _settings_classes(kind: type) -> frozenset[type]:
    """A settings class and those of its groups."""
    groups = (group_of(declared) for declared in typing.get_type_hints(kind).values())
    return frozenset({kind}).union(*(_settings_classes(group) for group in groups if group is not None))
