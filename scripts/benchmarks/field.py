# SPDX-License-Identifier: Apache-2.0
"""What ggslam makes of recordings from the field: cases that failed, and whole recordings by the defaults.

    python scripts/benchmarks/field.py --data FOLDER                              # every case, met or not
    python scripts/benchmarks/field.py --data FOLDER --only dark_start,shift1  # whose names have one of these words
    python scripts/benchmarks/field.py --scale 0.5 --stop 60 data/redkitchen data/shelf  # these, by the defaults

FOLDER holds recordings/ and maps/ with a folder for each case of `field_cases.py`. A case is met if the mistake is
named, or if what comes out is right. Tables are Markdown; `--out` keeps the runs. Exit code 1 if a case is not met.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from commands import ROOT
from field_cases import CASES, Case, Outcome
from rich.console import Console
from rich.progress import Progress

from ggslam.cli.argument_names import with_options
from ggslam.errors import GgslamError
from ggslam.runs.folder import RunFolder

SECONDS = 600
"""That a command may take."""
WIDEST = 110
"""Characters of a sentence in the table."""


def outcome_of(command: Sequence[str], out: Path) -> Outcome:
    """Runs a command; `out` is where its run is."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {
        "OMP_WAIT_POLICY": "PASSIVE", **os.environ, "NO_COLOR": "1", "COLUMNS": "1000",
        "PYTHONPATH": os.pathsep.join(paths),
    }  # fmt: skip
    try:
        ended = subprocess.run(
            command, cwd=out.parent, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace", timeout=SECONDS,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Outcome(f"error: took more than {SECONDS} s", -9, out)
    return Outcome(ended.stdout, ended.returncode, out)


def line(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |"


def short(text: str) -> str:
    """As much of a sentence as fits."""
    return text if len(text) <= WIDEST else text[: WIDEST - 1] + "…"


def run_cases(cases: Sequence[Case], data: Path, out: Path, progress: Progress) -> tuple[int, int]:
    """Prints the table; returns how many are not met, and how many are not there."""
    columns = ("case", "what is said", "value", "right", "met")
    progress.console.print(line(columns), line(["---"] * len(columns)), sep="\n")
    task, failed, absent = progress.add_task("cases", total=len(cases)), 0, 0
    for number, case in enumerate(cases):
        progress.update(task, description=case.title, completed=number)
        if not (data / case.below / case.name).is_dir():
            cells, absent = [case.title, "", "", case.right, "not there"], absent + 1
        else:
            found = outcome_of(case.command(data, out / f"case{number:02d}"), out / f"case{number:02d}")
            found = replace(found, text=found.text.replace(str(data / case.below / case.name), "."))  # names tell much
            met = case.met(found)
            failed += not met
            said = case.said(found).replace(str(data), ".")
            cells = [case.title, short(said), case.value(found), case.right, "yes" if met else "**no**"]
        progress.console.print(line(cells))
    progress.update(task, completed=len(cases))
    return failed, absent


def run_recordings(recordings: Sequence[Path], more: Sequence[str], out: Path, progress: Progress) -> None:
    """Prints what comes out of recordings by the defaults."""
    columns = ("recording", "frames", "lost", "ATE cm", "PSNR held out", "verdict", "to try", "exit code")
    progress.console.print(line(columns), line(["---"] * len(columns)), sep="\n")
    task = progress.add_task("recordings", total=len(recordings))
    for number, recording in enumerate(recordings):
        progress.update(task, description=recording.name, completed=number)
        folder = out / f"{number:02d}_{re.sub(r'[^A-Za-z0-9_.-]', '_', recording.name)}"
        command = [sys.executable, "-m", "ggslam", "run", str(recording.absolute()), *more]
        found = outcome_of([*command, "--out", str(folder), "--overwrite"], folder)
        progress.console.print(line([recording.name, *figures(found), str(found.code)]))
    progress.update(task, completed=len(recordings))


def figures(found: Outcome) -> list[str]:
    """Frames, lost ones, ATE, PSNR, verdict and what to try, as texts."""
    numbers = [found.figure(name) for name in ("frames", "lost", "ATE", "PSNR")]
    texts = ["-" if n is None else format(n, form) for n, form in zip(numbers, ("g", "g", ".2f", ".2f"), strict=True)]
    try:
        verdict = RunFolder.open(found.run).verdict()
    except GgslamError as error:
        return [*texts, short(str(error)), ""]
    return [*texts, *(("-", "") if verdict is None else (verdict.summary(), short(with_options(verdict.next))))]


def parse_arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path, help="run these by the defaults, instead of the cases")
    parser.add_argument("--data", type=Path, help="folder of the cases")
    parser.add_argument("--only", default="", help="of the cases those with one of these words, by commas")
    parser.add_argument("--scale", type=float, help="of recordings: factor of their images")
    parser.add_argument("--stop", type=int, help="of recordings: frame to stop before")
    parser.add_argument("--out", type=Path, help="keep the runs in this folder")
    given = parser.parse_args()
    if (given.data is None) == (not given.recordings):
        parser.error("give --data FOLDER for the cases, or recordings")
    return given


def main() -> None:
    """Runs what was asked for."""
    given = parse_arguments()
    console = Console(soft_wrap=True, highlight=False, markup=False)
    with (
        tempfile.TemporaryDirectory(prefix="ggslam-field-") as temporary,
        Progress(console=console, transient=True, disable=not console.is_terminal) as progress,
    ):
        out = (given.out or Path(temporary)).absolute()
        out.mkdir(parents=True, exist_ok=True)
        if given.recordings:
            options = [("--scale", given.scale), ("--stop", given.stop)]
            more = [word for name, value in options if value is not None for word in (name, str(value))]
            run_recordings(given.recordings, more, out, progress)
            return
        words = [word for word in given.only.split(",") if word]
        cases = [case for case in CASES if not words or any(word in case.title for word in words)]
        failed, absent = run_cases(cases, given.data.absolute(), out, progress)
        lacking = f", {absent} not there" if absent else ""
        console.print(f"\n{len(cases) - failed - absent} of {len(cases)} cases met{lacking}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
