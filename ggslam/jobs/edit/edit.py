# SPDX-License-Identifier: Apache-2.0
"""One edit of a map, as people write it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

KINDS = ("remove", "keep", "move", "duplicate", "recolor", "merge", "rename")


@dataclass(frozen=True)
class Edit:
    """One edit, as people write it.

    Attributes:
        kind: one of `KINDS`.
        objects: names or ids, e.g. "mug,7"; of merge the object that stays; of rename exactly one.
        value: what `kind` needs: "dx dy dz" in metres (move, duplicate; of the latter also "", just beside), a colour
            (recolor), the object that is merged into the other (merge), the new name (rename); else "".
        rotation: of move, "rx ry rz" in degrees, or "".
    """

    kind: Literal["remove", "keep", "move", "duplicate", "recolor", "merge", "rename"]
    objects: str
    value: str = ""
    rotation: str = ""
