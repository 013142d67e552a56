# SPDX-License-Identifier: Apache-2.0
"""`ggslam edit`: removes, moves, copies, recolours, joins and renames objects of a run."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from ggslam.cli import options
from ggslam.cli.console import console
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity
from ggslam.system.untrusted_files import read_untrusted_text

if TYPE_CHECKING:
    from ggslam.jobs.edit.edits import Edit

EPILOG = """
Objects are named by id or name, several separated by commas; @FILE stands for a selection of Gaussians that
`ggslam view` saved. Edits are done in the order given: a later one sees
what an earlier one did. A file of Gaussians without object ids is moved as a whole: all.
Distances are metres along the axes of the first camera: x right, y down, z forward.

[bold]Examples[/]

  ggslam edit runs/kitchen --remove mug,7 --inpaint

  ggslam edit runs/kitchen --move chair "0.3 0 0.1" --rotate "0 90 0" --inpaint --out runs/kitchen_moved

  ggslam edit runs/kitchen --merge 4 9 --rename 4 table --recolor table "#3060c0" --in-place

  ggslam edit runs/kitchen --crop "0 0 2 3 2 4" --remove @floaters.json

  ggslam edit statue.sog --move all "0 0 1" --rotate "0 90 0" --out statue.spz
"""
VALUES = {"remove": 1, "keep": 1, "move": 2, "duplicate": 2, "recolor": 2, "merge": 2, "rename": 2, "rotate": 1,
          "crop": 1, "assign": 2}  # fmt: skip
"""Edits and how many values follow each; the second of --duplicate may be left out."""
_EDITS = "edits"


def _is_vector(word: str) -> bool:
    """Whether a word is meant as a shift: it starts with a number, and is not the next option or the run's folder."""
    return re.match(r"\s*[-+]?\.?\d\S*[\s,]", word) is not None


def _edit_option(values: str, text: str) -> Any:
    return typer.Option(metavar=values, help=text, rich_help_panel="Edits, repeatable, done in the order given")


Crop = Annotated[
    str | None, _edit_option('"X Y Z SX SY SZ"', "Keep what lies in a box: its middle and its size, in metres.")
]
Assign = Annotated[str | None, _edit_option("@FILE OBJECT", "Give Gaussians to an object, or to new:NAME or none.")]


class EditCommand(TyperCommand):
    """Takes the edits from the command line itself: the parser would lose their order, and knows no lists of pairs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Puts the edits into the context and lets the parser see the rest."""
        edits: list[tuple[str, list[str]]] = []
        rest, left = [], list(args)
        while left:
            word = left.pop(0)
            name, equals, first = word.partition("=")
            count = VALUES.get(name[2:]) if name.startswith("--") else None
            if count is None:
                rest.append(word)
                continue
            left = [first, *left] if equals else left
            if name == "--duplicate" and not (left[1:] and _is_vector(left[1])):
                count = 1
            values, left = left[:count], left[count:]
            found = next((i for i, value in enumerate(values) if value.startswith("--")), len(values))
            if found < count:
                raise ConfigError(f"{name}: expected {count} value{'s' * (count > 1)}, found {found}")
            edits.append((name[2:], values))
        ctx.meta[_EDITS] = edits
        return list(super().parse_args(ctx, rest))


def edit(
    ctx: typer.Context,
    run: options.MapPath,
    remove: Annotated[str | None, _edit_option("OBJECTS", "Remove objects.")] = None,
    keep: Annotated[str | None, _edit_option("OBJECTS", "Keep these objects and remove everything else.")] = None,
    move: Annotated[str | None, _edit_option('OBJECTS "DX DY DZ"', "Move objects by so many metres.")] = None,
    rotate: Annotated[
        str | None,
        _edit_option(
            '"RX RY RZ"', "After --move: also turn them about their centre, by degrees about x, then y, then z."
        ),
    ] = None,
    duplicate: Annotated[
        str | None, _edit_option('OBJECTS ["DX DY DZ"]', "Put copies of objects there, or just beside.")
    ] = None,
    recolor: Annotated[str | None, _edit_option("OBJECTS COLOR", "Give objects a colour: #rrggbb or a name.")] = None,
    merge: Annotated[str | None, _edit_option("OBJECT OTHER", "Make the other object a part of the first.")] = None,
    rename: Annotated[str | None, _edit_option("OBJECT NAME", "Give an object a name.")] = None,
    crop: Crop = None,
    assign: Assign = None,
    inpaint: Annotated[
        bool, typer.Option("--inpaint", help="Close the holes that removed and moved objects leave.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the edited run; default: RUN-edited. Of a file of Gaussians the file to write, "
                     "whose name says the format."),
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Change the run itself.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run that is already at --out.")] = False,
    sequence: options.MovedSequence = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Remove more than half of the map without asking.")
    ] = False,
) -> None:  # fmt: skip
    """Edit a run's map: remove, keep, move, duplicate, recolour, merge and rename objects; crop it."""
    from ggslam.jobs.edit.edits import edit_run
    from ggslam.runs.map_file import open_map

    edits = _edits(ctx.meta[_EDITS])
    if in_place and out is not None:
        raise ConfigError("--in-place and --out contradict each other")
    outcome = edit_run(
        open_map(run), edits, out, in_place=in_place, overwrite=overwrite, inpainting=inpaint, sequence=sequence,
        confirm=None if yes else _confirm,
    )  # fmt: skip
    lines = list(outcome.changes)
    if outcome.filling is not None:
        added = f"inpainted: {quantity(outcome.filling.added, 'Gaussian')} added, " if outcome.inpainted else ""
        lines.append(
            f"{added}{quantity(outcome.filling.dropped, 'Gaussian')} dropped that were left over from moved or "
            "removed objects"
        )
    lines += [f"note: {note}" for note in outcome.notes]
    if outcome.folder.path.is_dir():
        pictures = quantity(len(outcome.pictures), "picture")
        lines.append(f"wrote {outcome.folder.path}, {pictures} of before and after in renders/")
    else:
        lines.append(f"wrote {outcome.folder.path}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _confirm(what: str) -> bool:
    """Asks whether to remove so much.

    Raises:
        ConfigError: nobody can be asked.
    """
    if not sys.stdin.isatty():
        raise ConfigError(f"{what}: this needs --yes; nothing was changed")
    return typer.confirm(f"{what}. Remove it?")


def _selection_in(word: str) -> str:
    """The selection in a file that is named as @FILE.

    Raises:
        ConfigError: it is not named so, or holds none.
    """
    from ggslam.objects.selection import parse_selection

    if word == "@":
        raise ConfigError("@FILE: expected the name of a file behind the @")
    if not word.startswith("@"):
        raise ConfigError(f"--assign: expected @FILE, a selection that `ggslam view` saved, found {word!r}")
    text = read_untrusted_text(word[1:], ConfigError)
    try:
        parse_selection(text)
    except ConfigError as error:
        raise ConfigError(f"{word[1:]}: {error}") from None
    return text


def _edits(words: list[tuple[str, list[str]]]) -> list[Edit]:
    """The edits in their order; `--rotate` belongs to the `--move` before it.

    Raises:
        ConfigError: `--rotate` follows no `--move`.
    """
    from ggslam.jobs.edit.edit import Edit
    from ggslam.jobs.edit.selected import box_selection

    edits: list[Edit] = []
    for kind, values in words:
        if kind == "crop":
            edits.append(Edit("keep", "", selection=box_selection(values[0])))
        elif kind == "assign":
            what, colon, name = values[1].partition(":")
            if colon and what.strip().casefold() != "new":
                raise ConfigError(f"--assign: only a new object gets a name, as new:NAME; found {values[1]!r}")
            edits.append(Edit("assign", what, name, selection=_selection_in(values[0])))
        elif kind != "rotate" and values[0].startswith("@"):
            edits.append(replace(Edit(kind, "", *values[1:]), selection=_selection_in(values[0])))  # type: ignore[arg-type]
        elif kind != "rotate":
            edits.append(Edit(kind, *values))  # type: ignore[arg-type]
        elif edits and edits[-1].kind == "move" and not edits[-1].rotation:
            edits[-1] = replace(edits[-1], rotation=values[0])
        else:
            raise ConfigError("--rotate: expected right after the --move that it goes with")
    return edits
