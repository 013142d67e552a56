# SPDX-License-Identifier: Apache-2.0
"""What is in a .ggz (a run's map) or a .ggc (a store's cells): what `ggslam inspect` prints of them. Checksums are
compared, nothing is decoded."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.coding.listing import list_units
from ggslam.errors import FormatError, RunFolderError
from ggslam.jobs.encode.coded_cells import CodedCells
from ggslam.objects.table import ObjectTable
from ggslam.runs.map_container import MAP, TABLE, Container, open_container
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.system.atomic import write_bytes
from ggslam.system.plurals import quantity


@dataclass
class Contents:
    """Contents of a coded file.

    Attributes:
        facts: name and words of each thing that is to be known.
        gaussians: their number.
        parts: bytes by part, of the whole file.
        problems: what is damaged.
    """

    facts: list[tuple[str, str]]
    gaussians: int
    parts: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)


def contents_of_run(path: Path) -> Contents:
    """What is in a .ggz. Raises FormatError if it is none, or damaged."""
    held = open_container(path)
    with tempfile.TemporaryDirectory(prefix="ggslam-") as folder:
        try:
            frames = _record(held, Path(folder))
            table = _table(held, Path(folder))
        except (FormatError, RunFolderError) as error:
            raise FormatError(str(error).replace(f"{folder}/", f"{path}: ")) from None
    objects = "none" if table is None else f"{len(table)}: {_some([table.record(i).label() for i in table.ids()])}"
    found = Contents([
        ("map of a run", f"version {held.head.version}, written by ggslam {held.head.ggslam}, rate {held.head.rate}"),
        ("Gaussians", str(held.head.gaussians)),
        ("keyframes", f"{len(frames.keyframes)} of {quantity(len(frames.frames), 'frame')}"),
        ("objects", objects),
    ], held.head.gaussians)  # fmt: skip
    _add_stream(found, MAP, held.members[MAP])
    for name, size in held.sizes.items():
        if name != MAP:
            found.parts[name] += size
    found.parts["of the zip archive"] = path.stat().st_size - sum(found.parts.values())
    return found


def contents_of_cells(path: Path) -> Contents:
    """What is in a .ggc. Raises FormatError if it is none."""
    cells = CodedCells(path)
    head, count = cells.head, sum(member.gaussians for member in cells.head.cells.values())
    found = Contents([
        ("cells of a store", f"version {head.version}, written by ggslam {head.ggslam}, rate {head.rate}"),
        ("grid", f"{quantity(len(head.cells), 'cell')} of {head.spacing:g} m along {head.axes}"),
        ("Gaussians", str(count)),
    ], count)  # fmt: skip
    try:
        known = cells.objects()
    except FormatError as error:
        known, found.problems = None, [str(error)]
    present = [] if known is None else known.present()
    gone = 0 if known is None else len(known.objects) - len(present)
    words = f"{len(present)}: {_some([one.label() for one in present])}" if present else "none"
    found.facts.append(("objects", words + (f"; {gone} more are gone" if gone else "")))
    found.facts.append(("visits", f"{len(head.visits)}: {_some(head.visits)}" if head.visits else "none are told"))
    for key in cells.members:
        try:
            _add_stream(found, cells.members[key], cells.content(key))
        except FormatError as error:
            found.problems.append(str(error))
            found.parts["damaged cells"] += cells.of(key).bytes
    for name, told in head.files.items():
        found.parts[name] += told.bytes
    found.parts["of the zip archive"] = path.stat().st_size - sum(found.parts.values())
    return found


def _record(held: Container, folder: Path) -> KeyframesRecord:
    write_bytes(folder / KeyframesRecord.FILE, held.members[KeyframesRecord.FILE])
    return KeyframesRecord.read(folder)


def _table(held: Container, folder: Path) -> ObjectTable | None:
    if TABLE not in held.members:
        return None
    write_bytes(folder / TABLE, held.members[TABLE])
    return ObjectTable.load(folder / TABLE)


def _add_stream(found: Contents, name: str, data: bytes) -> None:
    """Adds the parts of a stream of Gaussians: positions, colours, ..."""
    listing = list_units(data)
    for part, size in listing.parts.items():
        found.parts[_part_of(part)] += size
    found.parts["headers of streams"] += len(data) - sum(listing.parts.values())
    found.problems += [f"{name}: {problem}" for problem in listing.problems]


def _part_of(name: str) -> str:
    """The part that an attribute of a stream is of."""
    if name.startswith("sh_"):
        return "colours" if name == "sh_0" else "colours by direction"
    return {
        "geometry": "positions", "opacity": "opacities", "scale": "scales", "rotation": "rotations",
        "rotation_w": "rotations", "object_id": "object ids", "birth": "keyframes of Gaussians",
        "headers": "headers of streams",
    }.get(name, name)  # fmt: skip


def _some(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:7])}, ... {names[-1]}"
