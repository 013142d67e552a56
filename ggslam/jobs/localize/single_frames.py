# SPDX-License-Identifier: Apache-2.0
"""Locates single frames, of which nothing is known, in a stored map."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from ggslam.jobs.localize.locate import LocateTuning, open_map
from ggslam.jobs.localize.settings import localize_settings
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.submaps.stores import INDOORS
from ggslam.localization.frames import FrameTracker
from ggslam.localization.localizer import Localization, Localizer
from ggslam.localization.places import StoredPlaces
from ggslam.localization.surface import PartialSurface
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame


class FrameLocalizer:
    """Finds frames by the places of a map. Use from one thread at a time.

    Args:
        path: of a run, or of a grid store.
        observer: is told what is made of the map first.

    Raises:
        GgslamError: the map cannot be read.
    """

    def __init__(self, path: Path, observer: Observer | None = None) -> None:
        self._opened = ExitStack()
        results = Path(self._opened.enter_context(tempfile.TemporaryDirectory(prefix="ggslam-")))
        try:
            self._store = open_map(path, results, self._opened, observer or SilentObserver(), lambda: INDOORS)
            self._settings = localize_settings(None).settings.tracking
            self._context, submaps = NativeContext(), self._store.settings
            own = self._settings.target
            target = replace(own, voxel=max(own.voxel, LocateTuning.min_voxel_ratio * submaps.voxel))
            self._surface = PartialSurface(self._store, target, self._context, submaps)
            self._opened.callback(self._surface.close)
        except BaseException:
            self._opened.close()
            raise
        self._places: tuple[Camera, StoredPlaces] | None = None

    def locate(self, frame: Frame) -> Localization:
        """Where a frame was taken.

        Raises:
            ConfigError: the map's places were seen by another camera.
        """
        if self._places is None or self._places[0] != frame.camera:
            self._places = frame.camera, StoredPlaces(self._store, frame.camera)
        tracker = FrameTracker(frame.camera, self._settings, self._context, None, self._places[1])
        return Localizer(self._surface, tracker, None).locate(frame)

    def close(self) -> None:
        """Removes what was made of the map."""
        self._opened.close()
