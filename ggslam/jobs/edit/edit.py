# SPDX-License-Identifier: Apache-2.0
"""One edit of a map, as people write it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal

KINDS = ("remove", "keep", "move", "duplicate", "recolor", "merge", "rename", "assign")
OF_SELECTIONS = ("remove", "keep", "move", "recolor", "assign")
"""Those that can be done to a selection of Gaussians."""


ALL = json.dumps([{"mode": "set", "shape": {"kind": "all"}}])
"""The selection of everything."""


@dataclass(frozen=True)
class Edit:
    """One edit, as people write it.

    Attributes:
        kind: one of `KINDS`.
        objects: names or ids, e.g. "mug,7"; of merge the object that stays; of rename exactly one.
        value: what `kind` needs: "dx dy dz" in metres (move, duplicate; of the latter also "", just beside), a colour
            (recolor), the object that is merged into the other (merge), the new name (rename); else "".
        rotation: of move, "rx ry rz" in degrees, or "".
        selection: what is edited in place of objects: JSON text, see `objects.selection.read_selection`; "": objects.
            Of assign it is needed; `objects` is then the object that it is given to: an id or a name, "new" (named
            `value`, if that is not ""), or "none".
    """

    kind: Literal["remove", "keep", "move", "duplicate", "recolor", "merge", "rename", "assign"]
    objects: str
    value: str = ""
    rotation: str = ""
    selection: str = ""
