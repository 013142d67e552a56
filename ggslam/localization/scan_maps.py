# SPDX-License-Identifier: Apache-2.0
"""Prepares each kind of map for looking up laser scans."""

from __future__ import annotations

from ggslam.localization.map_picture import MapPicture, picture_of_store
from ggslam.localization.near import Near
from ggslam.localization.scan_places import ScanPlaces, recorded_places
from ggslam.submaps.grid import GridStore


def scan_places(store: GridStore, near: Near | None = None) -> ScanPlaces | MapPicture:
    """The places that scans were recorded at, or of a map without them a picture of all that is there.

    Args:
        store: the map.
        near: only places near a position.
    """
    recorded = recorded_places(store, near)
    return recorded if recorded.any_recorded else picture_of_store(store, near)
