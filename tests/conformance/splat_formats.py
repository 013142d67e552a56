# SPDX-License-Identifier: Apache-2.0
"""The splat formats of `ggslam export`: who reads them, and how near to the map what is read has to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from sog_reader import from_sog, from_streamed_sog
from splat_maps import C0, DIRECTIONS, Splats, from_compressed_ply, from_glb, from_ply, from_splat, from_spz
from usd_reader import from_usda

UPRIGHT = np.diag([1.0, -1.0, -1.0])
"""From the map's axes to those of a file whose y axis points upwards and whose z axis backwards."""
Bars = tuple[float, float, float, float]
"""One for each degree of spherical harmonics."""


@dataclass(frozen=True)
class SplatFormat:
    """How a format is read, and the most that may be wrong in the maps of these tests. Those of formats that round are
    what was found, and a little more.

    Attributes:
        suffix: of its files.
        read: the reader.
        decibels: of pictures of what was read against pictures of the map, at least.
        trained: the same of a map that was trained, seen from where it was recorded.
        position: metres.
        shape: of covariances, against their norm.
        opacity: 0 to 1.
        color: mean error, seen from three sides.
        upright: the file's y axis points upwards, its z axis backwards.
        keeps_ids: whether it has the object ids of a run that has objects.
        base_colors: they are the same from all sides, and from 0 to 1.
        recolored: they are those of the objects.
        package: without which it is not written.
    """

    suffix: str
    read: Callable[[Path], Splats]
    decibels: Bars
    trained: float = 120.0
    position: float = 1e-6
    shape: float = 1e-5
    opacity: float = 1e-6
    color: Bars = (1e-5, 1e-5, 1e-5, 1e-5)
    upright: bool = False
    keeps_ids: bool = False
    base_colors: bool = False
    recolored: bool = False
    package: str | None = None

    @property
    def turn(self) -> np.ndarray:
        """Rotation from the map's axes to the file's; its own inverse."""
        return UPRIGHT if self.upright else np.eye(3)

    def check(self, seen: Splats, written: Splats, degree: int) -> None:
        """What a reader of the file found, against the map."""
        seen = seen.take(rows_of(seen.means @ self.turn, written.means))
        assert np.abs(seen.means @ self.turn - written.means).max() <= self.position
        expected = self.turn @ written.covariances() @ self.turn.T
        difference = np.linalg.norm(seen.covariances() - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
        assert difference.max() <= self.shape
        assert np.abs(seen.opacities - written.opacities).max() <= self.opacity
        assert seen.sh.shape[1] == (1 if self.base_colors else (degree + 1) ** 2)
        for direction in DIRECTIONS:
            found, given = seen.colors(self.turn @ direction), written.colors(direction)
            assert np.abs(found - given).mean() <= self.color[degree]
        if seen.object_ids is not None:
            np.testing.assert_array_equal(seen.object_ids, written.object_ids)

    def require(self) -> None:
        """Skips a test where the package that writes the format is not installed."""
        if self.package is not None:
            pytest.importorskip(self.package, reason=f"{self.package} is not installed (it writes the format)")

    def pose(self, T_camera_world: np.ndarray) -> np.ndarray:
        """The same pose in the file's axes."""
        T = T_camera_world.copy()
        T[:3, :3] = T[:3, :3] @ self.turn.T
        return T


def rows_of(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """For each position the row that is nearest to it, each row once: formats may store Gaussians in an order of their
    own."""
    rows = cKDTree(found).query(wanted)[1]
    assert len(found) == len(wanted) == len(np.unique(rows))
    return rows


def with_colors(splats: Splats, colors: np.ndarray) -> Splats:
    """In colours that are the same from all sides, [N, 3]."""
    sh = (colors[:, None] - 0.5) / C0
    return Splats(splats.means, splats.log_scales, splats.quaternions, splats.opacities, sh, splats.object_ids)


EXACT = (120.0, 120.0, 120.0, 120.0)
SPLAT_FORMATS = {
    "ply": SplatFormat(".ply", from_ply, EXACT, keeps_ids=True),
    "segmented": SplatFormat(".ply", from_ply, EXACT, keeps_ids=True, recolored=True),
    "gltf": SplatFormat(".glb", from_glb, EXACT, upright=True, keeps_ids=True),
    "compressed-ply": SplatFormat(
        ".compressed.ply", from_compressed_ply, (54.0, 50.5, 47.3, 45.6), 56.0, position=0.0075,
        shape=0.008, opacity=0.51 / 255, color=(0.0012, 0.0045, 0.007, 0.0095),
    ),
    "spz": SplatFormat(
        ".spz", from_spz, (47.7, 47.3, 44.0, 46.8), 53.0, position=0.51 / 4096, shape=0.075,
        opacity=0.51 / 255, color=(0.0022, 0.0026, 0.0028, 0.0034), upright=True, package="gaussforge",
    ),
    "splat": SplatFormat(
        ".splat", from_splat, (49.0, 49.0, 49.0, 49.0), 53.0, shape=0.04, opacity=0.51 / 255, color=(0.0015,) * 4,
        base_colors=True,
    ),
    "sog": SplatFormat(
        ".sog", from_sog, (55.5, 57.0, 57.5, 55.5), 60.0, position=3e-4, shape=0.035, opacity=0.51 / 255,
        color=(0.001, 0.0013, 0.0017, 0.0022), keeps_ids=True,
    ),
    "usd": SplatFormat(".usda", from_usda, EXACT, upright=True, keeps_ids=True, package="pxr"),
}  # fmt: skip
SPLAT_FORMATS["spz4"] = SPLAT_FORMATS["spz"]
SPLAT_FORMATS["streamed-sog"] = replace(SPLAT_FORMATS["sog"], suffix="", read=from_streamed_sog)
OTHER_FORMATS = {"points", "pcd", "mesh", "trajectory", "colmap", "nerfstudio"}
"""Of `ggslam export`; other files of these tests are about them."""
