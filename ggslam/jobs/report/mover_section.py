# SPDX-License-Identifier: Apache-2.0
"""The section of a run's report on movers."""

from __future__ import annotations

from ggslam.jobs.report.run_data import RunData
from ggslam.reporting import page as p
from ggslam.reporting.page import Html
from ggslam.runs.records.movers import MoverRecord

_HEAD = ("id", "what", "kind", "moves in frames", "found in", "share of the image, most, %", "moved by, cm",
         "turned, deg", "scatter of single frames")  # fmt: skip
_WORDS = (
    "Moved and turned: from its place before to its place after, of what was seen to stand at both. The first frames "
    "in which it moves may be older than the one in which it was found: that was found out later, and the map is kept "
    "free of it only since it was found."
)


def movers_part(run: RunData) -> Html:
    """A table of movers, and pictures."""
    rows = [_row(mover) for mover in run.movers]
    pictures = [cell for view in run.mover_views for cell in view.pictures.items()]
    return p.join([
        p.table(_HEAD, rows, text_columns=(1, 2, 3, 8)), p.tag("p", _WORDS, class_="note"),
        *([p.cells(pictures)] if pictures else []),
    ])  # fmt: skip


def _row(mover: MoverRecord) -> list[str]:
    moves = ", ".join(f"{first}-{last}" for first, last in mover.moves)
    most = max((frame.share for frame in mover.frames), default=0.0)
    by = ["-", "-", "-"]
    if mover.displacement is not None:
        d = mover.displacement
        by = [f"{100 * d.distance_m:.1f}", f"{d.turn_deg:.1f}", f"{1000 * d.scatter_m:.1f} mm, {d.scatter_deg:.1f} deg"]
    return [str(mover.id), mover.name or "", mover.kind, moves, str(mover.found), f"{100 * most:.1f}", *by]
