# SPDX-License-Identifier: Apache-2.0
"""Objects: select by click or from the list, name, hide, move, delete, export; save what was edited."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ggslam.errors import ConfigError
from ggslam.scene.poses import matrix_to_quaternion, quaternion_to_matrix
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import upright_axes
from ggslam.viewer.model import EditableMap, ListedObject
from ggslam.viewer.safe_text import plain
from ggslam.viewer.stage import Stage

if TYPE_CHECKING:
    import viser

NOTHING = "(none)"


class ObjectsTabTuning(Tuning):
    """How objects are listed and moved."""

    list_height = 260
    """Largest height of the list, in pixels."""
    gizmo_size = 110.0
    """Size of the handles that move an object, in pixels."""


class ObjectsTab:
    """The list and what can be done to the object that is selected."""

    def __init__(self, stage: Stage, model: EditableMap) -> None:
        self._stage, self._model = stage, model
        gui: Any = stage.server.gui
        self.selected: int | None = None
        self._records: dict[int, ListedObject] = {}
        self._gizmo: viser.TransformControlsHandle | None = None
        self._motion = np.eye(4)
        self._turn = threading.RLock()
        self._choice = gui.add_dropdown("Selected", [NOTHING], hint="Or click an object in the map")
        self._act = gui.add_button_group("Object", ["Hide", "Delete", "Export"])
        self._only = gui.add_button_group("Show", ["Only this", "All"])
        self._name = gui.add_text("Name", "")
        self._rename = gui.add_button("Rename", icon="pencil")
        self._moving = gui.add_checkbox("Move with gizmo", False, hint="Drag arrows and rings, then keep or put back")
        self._keep = gui.add_button_group("Moved", ["Keep", "Put back"], visible=False)
        self._list = gui.add_html("")
        with gui.add_folder("Edits"):
            self._done = gui.add_markdown("")
            self._undo = gui.add_button("Undo", icon="arrow-back-up")
            place = f"A new folder in {model.save_folder()}"
            self._target = gui.add_text("Save as", model.default_target(), hint=place)
            self._inpaint = gui.add_checkbox("Close holes", False, hint="As `ggslam edit --inpaint` does; takes longer")
            self._save = gui.add_button("Save edited run", icon="device-floppy")
        self._connect()
        self.refresh()

    def _connect(self) -> None:
        alone = self._alone
        self._choice.on_update(alone(lambda event: self._on_choice() if event.client is not None else None))
        self._act.on_click(alone(lambda event: self._on_action(event.client)))
        self._only.on_click(alone(lambda event: self._on_show()))
        self._rename.on_click(alone(lambda event: self._edit(self._model.rename(self._one(), self._name.value))))
        self._moving.on_update(alone(lambda event: self._set_gizmo()))
        self._keep.on_click(alone(lambda event: self._on_move()))
        self._undo.on_click(alone(lambda event: self._edit(self._model.undo())))
        self._save.on_click(self._stage.guard(lambda event: self._on_save(event.client)))  # may take minutes
        self._stage.server.scene.on_click()(alone(self._on_click))

    def _alone(self, action: Callable[[Any], str | None]) -> Callable[[Any], None]:
        """A callback that waits for those of other pages: what is selected and drawn is common to all."""

        def in_turn(event: Any) -> str | None:
            with self._turn:
                return action(event)

        return self._stage.guard(in_turn)

    # --- selecting ---------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Lists the objects anew."""
        self._records = {record.id: record for record in self._model.objects()}
        if self.selected not in self._records:
            self.selected = None
        self._choice.options = [NOTHING, *(record.label for record in self._records.values())]
        self._mark()
        edits = self._model.edits()
        self._done.content = "\n".join(f"- {plain(text)}" for text in edits) or "*Nothing was edited yet.*"
        self._undo.disabled = self._save.disabled = not edits

    def select(self, object_id: int | None) -> None:
        """Selects an object, or none."""
        self._put_back()
        self.selected = object_id
        self._mark()
        self._set_gizmo()

    def _mark(self) -> None:
        record = None if self.selected is None else self._records[self.selected]
        self._choice.value = NOTHING if record is None else record.label
        self._name.value = (record.name or "") if record else ""
        for control in (self._act, self._only, self._name, self._rename, self._moving):
            control.visible = record is not None or (control is self._only and bool(self._stage.hidden))
        if record is None:
            self._stage.nodes.drop_box()
        else:
            self._stage.nodes.set_box(record.center, record.axes, record.size, self._model.up, record.label)
        self._list.content = object_list(list(self._records.values()), self._stage.hidden, self.selected)

    def _one(self) -> int:
        if self.selected is None:  # another page was faster
            raise ConfigError("no object is selected any more")
        return self.selected

    def _on_choice(self) -> None:
        found = [record.id for record in self._records.values() if record.label == self._choice.value]
        self.select(found[0] if found else None)

    def _on_click(self, event: Any) -> None:
        camera = event.client.camera
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        origin, direction = np.array(event.ray_origin, float), np.array(event.ray_direction, float)
        self.select(self._model.object_at(origin, direction, focal, self._stage.hidden) or None)

    # --- doing -------------------------------------------------------------------------------------------------------

    def _on_action(self, client: viser.ClientHandle) -> str | None:
        action, object_id = self._act.value, self._one()
        if action == "Delete":
            return self._edit(self._model.remove(object_id))
        if action == "Export":
            name, content = self._model.export(object_id)
            client.send_file_download(name, content, save_immediately=True)
            return f"{name}: {quantity(self._records[object_id].gaussians, 'Gaussian')}, {len(content):,} bytes"
        self._hide(self._stage.hidden ^ {object_id})
        return None

    def _on_show(self) -> None:
        if self._only.value == "All":
            self._hide(set())
        elif self.selected is not None:
            self._hide({0, *self._records} - {self.selected})

    def _hide(self, hidden: set[int]) -> None:
        for object_id in hidden ^ self._stage.hidden:
            self._stage.nodes.set_visible(object_id, object_id not in hidden)
        self._stage.hidden = hidden
        self._mark()

    def _edit(self, text: str) -> str:
        """After an edit: everything is drawn anew."""
        self._stage.hidden &= {0, *(record.id for record in self._model.objects())}
        self._stage.draw_map()
        self._motion = np.eye(4)
        self.refresh()
        self._set_gizmo()
        self._stage.describe()
        self._stage.edited()
        return text

    def _on_save(self, client: viser.ClientHandle | None) -> str:
        if client is not None:
            client.add_notification("Saving", "The edits are done to the run's files.", auto_close_seconds=4.0)
        self._save.disabled = True
        try:
            return self._model.save(self._target.value, self._inpaint.value)
        finally:
            self._save.disabled = False

    # --- moving ------------------------------------------------------------------------------------------------------

    def _set_gizmo(self) -> None:
        """Puts the gizmo where the selected object is, or away."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        self._keep.visible = bool(self._moving.value and self.selected is not None)
        if not self._keep.visible:
            self._put_back()
            return
        record = self._records[self._one()]
        upright = upright_axes(self._model.up)
        gizmo = self._stage.server.scene.add_transform_controls(
            "/selected/gizmo", scale=ObjectsTabTuning.gizmo_size, fixed=True, position=record.centroid,
            wxyz=matrix_to_quaternion(upright),
        )  # fmt: skip
        self._gizmo = gizmo

        @gizmo.on_update
        def _on_drag(event: Any) -> None:
            R = quaternion_to_matrix(np.array(gizmo.wxyz)) @ upright.T
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, np.array(gizmo.position) - R @ record.centroid
            self._motion = T
            self._stage.nodes.displace(record.id, T)

    def _on_move(self) -> str | None:
        if self._keep.value == "Put back" or np.allclose(self._motion, np.eye(4)):
            self._put_back()
            self._set_gizmo()
            return None
        return self._edit(self._model.move(self._one(), self._motion))

    def _put_back(self) -> None:
        if self.selected is not None and not np.allclose(self._motion, np.eye(4)):
            self._stage.nodes.displace(self.selected, np.eye(4))
        self._motion = np.eye(4)


def object_list(records: list[ListedObject], hidden: set[int], selected: int | None) -> str:
    """The objects in HTML: colour, number, name, Gaussians; hidden ones are dimmed."""
    rows = []
    for record in records:
        style = "display:flex;gap:8px;align-items:center;padding:1px 6px;border-radius:3px;"
        style += "opacity:.4;" if record.id in hidden else ""
        style += "background:rgba(64,130,230,.45);" if record.id == selected else ""
        swatch = f"background:rgb{record.color};width:11px;height:11px;border-radius:2px;flex:none"
        label = html.escape(record.label)
        clipped = "flex:1;min-width:0;overflow:hidden;text-overflow:ellipsis;white-space:nowrap"
        rows.append(
            f'<div style="{style}"><span style="{swatch}"></span><span style="{clipped}">{label}</span>'
            f"<span>{record.gaussians:,}</span></div>"
        )
    limits = f"max-height:{ObjectsTabTuning.list_height}px;overflow-y:auto;margin:4px 10px;font-size:13px"
    return f'<div style="{limits}">{"".join(rows)}</div>'
