# SPDX-License-Identifier: Apache-2.0
"""Points and splats of a map: the whole of it now and then, thinned, and the tiles that changed in full."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ggslam.jobs.serve.channels import MAP, POINT_TILES, POINTS, SPLAT_TILES, SPLATS
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.seen_points import PointCloud
from ggslam.jobs.serve.tiles import (
    SentTiles,
    ThinPoints,
    Tile,
    TileTuning,
    at_most,
    middle_of,
    rows_by_key,
    thin_points,
    tile_of,
)
from ggslam.messages.contents import Channel, Points, Splats
from ggslam.rendering.types import Gaussians
from ggslam.scene.gaussian_map import SH_C0
from ggslam.system.tuning import Tuning
from ggslam.viewer.splats import colors_to_uint8, most_visible, opacities_of


class MapContentsTuning(Tuning):
    """How often, and how much, of a growing map is sent."""

    whole_every_s = 5.0
    """Seconds between two messages with the whole map."""
    max_splats = 15_000
    """Most splats of a message with the whole map: the most visible ones."""


@dataclass(frozen=True)
class MapCopy:
    """A map that nobody changes any more.

    Attributes:
        gaussians: on the CPU.
        ids: uint16 [N], object of each, 0: none.
        surface: points of its surface; None: the middles of its Gaussians, which lie about it.
        whole: whether there is nothing else: of a run whose memory is limited parts are on disk.
    """

    gaussians: Gaussians
    ids: np.ndarray
    surface: PointCloud | None = None
    whole: bool = True


class MapContents:
    """Hands a map's points and splats over to a publisher, as far as somebody listens.

    Args:
        publisher: that takes them.
    """

    def __init__(self, publisher: MapPublisher) -> None:
        self._publisher = publisher
        self._tiles = {channel.name: SentTiles() for channel in (POINT_TILES, SPLAT_TILES)}
        self._whole_at: dict[str, float] = {}

    @property
    def is_wanted(self) -> bool:
        """Whether there is anything to do for a map."""
        return any(self._is_due(channel) for channel in (POINTS, SPLATS)) or any(
            self._publisher.is_wanted(channel) for channel in (POINT_TILES, SPLAT_TILES)
        )

    def show(
        self, shown: MapCopy, stamp: float, final: bool = False, harmonics: int = 1,
        only: Collection[Channel] = (POINTS, POINT_TILES, SPLATS, SPLAT_TILES),
    ) -> None:  # fmt: skip
        """Publishes what changed.

        Args:
            shown: the map as it is.
            stamp: when it was so, seconds.
            final: whether it stays so: the least change counts, and all is sent at once.
            harmonics: most coefficients of a splat's colour.
            only: channels that are looked at.
        """
        wanted = [c for c in (POINT_TILES, SPLAT_TILES) if c in only and self._publisher.is_wanted(c)]
        due = [c for c in (POINTS, SPLATS) if c in only and self._is_due(c, final)]
        solid = _solid_gaussians(shown) if SPLAT_TILES in wanted or shown.surface is None else None
        seen = shown.surface or solid
        if POINT_TILES in wanted and seen is not None:
            self._point_tiles(shown, thin_points(seen.xyz, seen.rgb, seen.ids), stamp, final)
        if SPLAT_TILES in wanted and solid is not None:
            self._splat_tiles(shown, thin_points(solid.xyz, solid.rgb, solid.ids), stamp, final, harmonics)
        if POINTS in due and seen is not None:
            self._whole_at[POINTS.name] = time.monotonic()
            thin = at_most(seen.xyz, seen.rgb, seen.ids, TileTuning.max_points)
            self._publisher.put(POINTS, points_of(thin), stamp)
        if SPLATS in due:
            self._whole_at[SPLATS.name] = time.monotonic()
            rows = most_visible(shown.gaussians, MapContentsTuning.max_splats)
            self._publisher.put(SPLATS, splats_of(shown, rows, harmonics), stamp)

    def _is_due(self, channel: Channel, final: bool = False) -> bool:
        rested = time.monotonic() - self._whole_at.get(channel.name, -1e9) > MapContentsTuning.whole_every_s
        return self._publisher.is_wanted(channel) and (final or rested)

    def _point_tiles(self, shown: MapCopy, thin: ThinPoints, stamp: float, final: bool) -> None:
        for tile, rows in self._tiles[POINT_TILES.name].find_changes(thin, final, shown.whole).items():
            if len(rows):
                self._publisher.put(POINT_TILES, points_of(thin, rows), stamp, part_name(tile))
            else:
                self._send_empty(POINT_TILES, tile, _no_points(tile), stamp)

    def _splat_tiles(self, shown: MapCopy, thin: ThinPoints, stamp: float, final: bool, harmonics: int) -> None:
        """Splats of the tiles whose points changed."""
        changed = self._tiles[SPLAT_TILES.name].find_changes(thin, final, shown.whole)
        if not changed:
            return
        seen = most_visible(shown.gaussians, len(shown.ids))
        of_tiles = rows_by_key(tile_of(shown.gaussians.means.numpy()[seen]))
        for tile in changed:
            rows = of_tiles.get(tile)
            if rows is not None and len(changed[tile]):
                self._publisher.put(SPLAT_TILES, splats_of(shown, seen[rows], harmonics), stamp, part_name(tile))
            else:
                self._send_empty(SPLAT_TILES, tile, _no_splats(tile), stamp)

    def _send_empty(self, channel: Channel, tile: Tile, empty: Points | Splats, stamp: float) -> None:
        self._publisher.put(channel, empty, stamp, part_name(tile), keep=False)
        self._publisher.forget(channel, part_name(tile))


def _solid_gaussians(shown: MapCopy) -> PointCloud:
    """The middles of those that belong to surfaces."""
    g = shown.gaussians
    solid = opacities_of(g) >= TileTuning.min_opacity
    rgb = colors_to_uint8(0.5 + SH_C0 * g.sh.numpy()[solid, 0])
    return PointCloud(g.means.numpy()[solid], rgb, shown.ids[solid])


def part_name(tile: Tile) -> str:
    """Name of a tile."""
    return ",".join(map(str, tile))


def points_of(thin: ThinPoints, rows: np.ndarray | None = None) -> Points:
    """Some points, or all; `count` tells how many one stands for, `id` its object."""
    chosen = slice(None) if rows is None else rows
    values = {"count": thin.count[chosen], "id": thin.ids[chosen]}
    return Points(MAP, thin.xyz[chosen], thin.rgb[chosen], values)


def splats_of(shown: MapCopy, rows: np.ndarray, harmonics: int) -> Splats:
    """Some Gaussians [M] of a map."""
    g = shown.gaussians
    quaternions = g.quaternions.numpy()[rows]
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    opacities = (1 / (1 + np.exp(-np.clip(g.opacity_logits.numpy()[rows], -30, 30)))).astype(np.float32)
    return Splats(MAP, g.means.numpy()[rows], np.exp(g.log_scales.numpy()[rows]), quaternions.astype(np.float32),
                  opacities, np.ascontiguousarray(g.sh.numpy()[rows, :harmonics]), shown.ids[rows])  # fmt: skip


def _no_points(tile: Tile) -> Points:
    nothing = np.zeros(1, np.uint16)
    return Points(MAP, middle_of(tile), np.zeros((1, 3), np.uint8), {"count": nothing, "id": nothing})


def _no_splats(tile: Tile) -> Splats:
    one = np.zeros((1, 4), np.float32)
    one[0, 0] = 1
    return Splats(MAP, middle_of(tile), np.full((1, 3), 1e-3, np.float32), one, np.zeros(1, np.float32),
                  np.zeros((1, 1, 3), np.float32), np.zeros(1, np.uint16))  # fmt: skip
