# SPDX-License-Identifier: Apache-2.0
"""What to say of a path at which there is nothing."""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

from ggslam.system.tuning import Tuning


class MissingPathTuning(Tuning):
    """When another name is proposed."""

    closeness = 0.75
    """Likeness, 0 to 1, of a name beside the missing one that is proposed instead."""
    looked_at = 10_000
    """Most names of a folder that are compared."""


_ADDRESS = re.compile(r"(?P<scheme>https?|ftp|s3|gs|file):/+(?P<rest>.*)", re.IGNORECASE)


def why_missing(path: str | Path, sentence: str = "no such folder or file") -> str:
    """Why nothing can be read at a path that is not there: an address of the network, a link to nothing, or a name
    that is not there, with the nearest one that is.

    Args:
        path: at which nothing is.
        sentence: that says so.
    """
    text = str(path)
    if _ADDRESS.fullmatch(text):
        return "is an address, and ggslam fetches nothing from the network: download it, unpack it, and give its folder"
    if os.path.islink(text):  # noqa: PTH114 (Path's raises for impossible names)
        return f"is a link to {os.readlink(text)}, which is not there"  # noqa: PTH115
    near = _nearest(Path(text))
    return sentence + (f"; did you mean {near}?" if near is not None else "")


def _nearest(path: Path) -> Path | None:
    """What is called nearly like it in the same folder; of a folder that is not there either, none."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry, _ in zip(entries, range(MissingPathTuning.looked_at), strict=False)]
    except (OSError, ValueError):
        return None
    same = [name for name in names if name.casefold() == path.name.casefold()]
    found = same or difflib.get_close_matches(path.name, names, 1, MissingPathTuning.closeness)
    return path.with_name(found[0]) if found else None
