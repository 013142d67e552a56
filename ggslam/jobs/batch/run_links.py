# SPDX-License-Identifier: Apache-2.0
"""Links from a batch's page to its runs: their reports, and a picture of each, where they lie beside the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from ggslam.jobs.batch.job_states import JobState
from ggslam.reporting.page import Html, join, tag
from ggslam.runs.writing import REPORT_FILE


def link_to(name: str, state: JobState) -> str:
    """A name that leads to the report of a run, where it has one."""
    report = state.run / REPORT_FILE
    return tag("a", name, href=_address(report, state.out)) if report.is_file() else name


def run_tiles(states: Sequence[JobState]) -> Html:
    """For each run its picture of recorded beside rendered, with its name below; both lead to its report."""
    return tag("div", *(_tile(state) for state in states), class_="cells columns3")


def _tile(state: JobState) -> Html:
    pictures = sorted((state.run / "renders").glob("compare*.png"))
    shown = Html("")
    if pictures:
        middle = pictures[len(pictures) // 2]
        words = f"recorded and rendered images of {state.job.name}"
        shown = Html(tag("img", src=_address(middle, state.out), alt=words, loading="lazy").removesuffix("</img>"))
    report = state.run / REPORT_FILE
    if report.is_file():
        shown = tag("a", shown, href=_address(report, state.out))
    return tag("figure", join([shown]), tag("figcaption", link_to(state.job.name, state)))


def _address(path: Path, folder: Path) -> str:
    return quote(path.relative_to(folder).as_posix())
