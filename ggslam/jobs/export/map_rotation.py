# SPDX-License-Identifier: Apache-2.0
"""Turns a map so that an axis of the written file points up, by the map's own floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.formats.splat_columns import UPRIGHT
from ggslam.formats.writer import Writer
from ggslam.jobs.export.up_axis import UpAxis
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import skew
from ggslam.system.tuning import Tuning
from ggslam.volumes.map_upright import upright_of


class MapRotationTuning(Tuning):
    """How the direction up is found."""

    samples = 100_000
    """Gaussians that it is found from, about."""


_R_AXES_LEVEL = {
    UpAxis.y: UPRIGHT, UpAxis.minus_y: np.eye(3), UpAxis.z: np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]),
}  # fmt: skip
"""From x right, y down, z forward to x right, and up along the axis; z forward becomes -z, z and y."""


@dataclass(frozen=True)
class UpwardTurn:
    """Turns Gaussians about the origin of the map.

    Attributes:
        R: rotation [3, 3] from the map's axes to those that are written.
        text: what was done, for people.
    """

    R: np.ndarray
    text: str

    def __call__(self, gaussians: GaussianMap) -> None:
        """Turns all of them in place, their colours too."""
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = torch.from_numpy(self.R)
        gaussians.move(torch.arange(len(gaussians)), T)


def upward_turn(folder: RunFolder, axis: UpAxis | str, writer: Writer) -> UpwardTurn:
    """The turn after which `axis` of a file points away from the map's floor, and the first camera's x axis points as
    nearly as possible to where it did.

    Up is what most flat surfaces near the cameras' own up direction agree on; where none do, the cameras' mean.

    Args:
        folder: of the map.
        axis: of the file.
        writer: of the format that will be written.

    Raises:
        ConfigError: the format has another up axis.
    """
    axis = _axis_named(axis)
    if writer.y_up and axis is not UpAxis.y:
        raise ConfigError(f"`up` {axis.value}: files of the format {writer.name} have y upwards")
    found = upright_of(_sample(folder), np.stack(list(folder.keyframes().poses().values())))
    source = "by its floor" if found.support > 0 else "as the cameras were held: no floor was found"
    R = level(found.up) if writer.y_up else _R_AXES_LEVEL[axis] @ level(found.up)
    degrees = np.degrees(np.arccos(np.clip(-found.up[1], -1, 1)))
    return UpwardTurn(R, f"{axis.value} is up, {source}, {degrees:.1f} degrees from the first camera's up")


def level(up: np.ndarray) -> np.ndarray:
    """The smallest rotation [3, 3] that brings a unit vector [3] to (0, -1, 0)."""
    target = np.array([0.0, -1.0, 0.0])
    cosine = float(up @ target)
    if cosine < -1 + 1e-12:
        return UPRIGHT.copy()
    K = skew(np.cross(up, target))
    return np.eye(3) + K + K @ K / (1 + cosine)  # Rodrigues' formula


def _axis_named(axis: UpAxis | str) -> UpAxis:
    try:
        return UpAxis(axis)
    except ValueError:
        known = ", ".join(known.value for known in UpAxis)
        raise ConfigError(f"`up`: expected one of {known}, found {axis!r}") from None


def _sample(folder: RunFolder) -> GaussianMap:
    """Some of the Gaussians, of all parts of the map."""
    rows = folder.map_in_parts().rows
    out = GaussianMap(rows.like.sh_degree, rows.like.feature_channels, with_moments=False)
    step = max(1, len(rows) // MapRotationTuning.samples)
    for block in rows.blocks():
        out.append(block.take(torch.arange(0, len(block), step)))
    return out
