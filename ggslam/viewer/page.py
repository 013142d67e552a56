# SPDX-License-Identifier: Apache-2.0
"""The page: a map in space, and controls beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ggslam.viewer.cameras import vertical_fov
from ggslam.viewer.changes_tab import ChangesTab
from ggslam.viewer.model import EditableMap, ViewedMap
from ggslam.viewer.objects_tab import ObjectsTab
from ggslam.viewer.server import keep_fitting
from ggslam.viewer.stage import Stage
from ggslam.viewer.time_tab import TimeTab
from ggslam.viewer.view_tab import ViewTab

if TYPE_CHECKING:
    import viser


class Page:
    """Shows a map on all pages of a server.

    Args:
        server: with an empty page.
        model: the map.
        editable: the same if its objects can be edited, else None.
        title: above everything.
    """

    def __init__(self, server: viser.ViserServer, model: ViewedMap, editable: EditableMap | None, title: str) -> None:
        self.stage = Stage(server, model, title)
        tabs = server.gui.add_tab_group()
        self.objects: ObjectsTab | None = None
        with tabs.add_tab("View"):
            self.view = ViewTab(self.stage)
        with tabs.add_tab("Time"):
            self.time = TimeTab(self.stage)
            self.stage.edited = self.time.redraw
        if editable is not None:
            with tabs.add_tab("Objects"):
                self.objects = ObjectsTab(self.stage, editable)
        self.changes: ChangesTab | None = None
        if self.stage.changes:
            with tabs.add_tab("Changes"):
                self.changes = ChangesTab(self.stage)
        self.stage.describe()
        server.scene.set_up_direction(model.up)
        start = self.stage.start_view()
        first = server.initial_camera
        first.position, first.look_at, first.up = start.position, start.look_at, model.up
        first.fov, first.near = vertical_fov(model.camera), start.near
        keep_fitting(server, model.camera)
