# SPDX-License-Identifier: Apache-2.0
"""Every fault, what the user sees, what was kept.

    python scripts/tools/fault_table.py                        # all, a table
    python scripts/tools/fault_table.py --only yaml,disk       # those with one of these words in their names
    python scripts/tools/fault_table.py --markdown docs/faults.md --json faults.json

Each fault happens in a folder of its own: a small recording or run is damaged, or a command is cut off, in a process
with limits of memory (4 GB) and time (120 s). A row is bad if there is a traceback, a crash, a hang, a control
character, or nothing was kept; then the exit code is 1. Faults that need a small disk of their own need root.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("COLUMNS", "1000")
os.environ["NO_COLOR"] = "1"

from fault_bench import FEW, UNTOUCHED, Place, Row, command  # noqa: E402
from fault_cases import FAULTS, NotHere  # noqa: E402

import ggslam.cli.main  # noqa: E402, F401  (what all processes share)
import ggslam.jobs.run.pipeline  # noqa: E402, F401

FRAMES = 14
HEAD = """# Faults

What goes wrong, the line of ggslam's answer that matters (shortened), the exit code, and what is kept of the work.
Existing files are untouched wherever nothing else is said. Every fault happened, in a folder of its own (here `.`):
`python scripts/tools/fault_table.py --markdown docs/faults.md` writes this page.

Exit codes: 0 done (3 with `--strict` where something seems wrong), 1 the machine's fault or ours, or most frames were
lost, 2 the input's fault, 128 + n after signal n, -9 after a kill, where the line is that of the command that goes on.
"""
MOST = 52
"""Characters of a message on the page."""
FEWEST = 3
"""Faults that a section of the page is made for."""


def make_inputs(folder: Path) -> tuple[Path, Path]:
    """A small recording and a finished run of it."""
    recording, run = folder / "recording", folder / "run"
    for words in (
        ["synth", str(recording), "--frames", str(FRAMES), "--width", "96", "--height", "72"],
        ["run", str(recording), "--out", str(run), *FEW],
    ):
        ended = command(words, folder, None, 8 << 30)
        if ended.code:
            raise SystemExit(f"{' '.join(words)}: {ended.text}")
    return recording, run


def happen(name: str, folder: Path, recording: Path, run: Path) -> Row | None:
    """Lets a fault happen; None if this machine cannot."""
    folder.mkdir()
    place = Place(folder, recording, run)
    try:
        FAULTS[name](place)
        return place.row(name)
    except NotHere as reason:
        print(f"left out: {name}: {reason}", file=sys.stderr)
        return None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def brief(said: str) -> str:
    """What a message says, without its kind, the file that the fault names, and remarks; cut off between words."""
    text = re.sub(r"^(\./\S+|[\w/]+\.\w+):? ", "", said.removeprefix("error: "))
    text = re.sub(r"cannot write \S+:", "cannot write:", re.sub(r" \([^()]*\)", "", text)).replace("./recording/", "")
    words = text.split()
    short = words[:1]
    for word in words[1:]:
        if len(" ".join([*short, word])) > MOST:
            return " ".join(short).rstrip(".,;:") + " …"
        short.append(word)
    return " ".join(short)


def kept(row: Row) -> str:
    """What was kept besides existing files, and what was bad."""
    parts = row.kept.split("; ")
    words = "; ".join(re.sub(r"^an? (\w+ )run of", r"\1run,", part) for part in parts if part != UNTOUCHED)
    if UNTOUCHED not in parts:
        words += ", but an existing file has changed"
    return words + (f" **{', '.join(row.problems)}**" if row.problems else "")


def table(rows: list[Row]) -> str:
    """A row of a Markdown table for each fault."""
    lines = ["| fault | message | exit | kept |", "|---|---|---|---|"]
    lines += [f"| {row.fault} | {row.said} | {row.code} | {kept(row)} |" for row in rows]
    return "\n".join(lines)


def page(rows: list[Row]) -> str:
    """A page of docs: a section for every outcome that several faults have, and one for the others."""
    outcomes: dict[tuple[int, str], dict[str, list[str]]] = {}
    for row in rows:
        outcomes.setdefault((row.code, kept(row)), {}).setdefault(brief(row.said), []).append(row.fault)
    sections, others = [HEAD], []
    for (code, what), said in outcomes.items():
        lines = [f"- {'; '.join(faults)}: *{text.replace('<', '&lt;')}*" for text, faults in said.items()]
        if sum(len(faults) for faults in said.values()) >= FEWEST:
            sections += [f"## Exit code {code}, {'kept: ' if what else 'nothing new is written'}{what}\n", *lines, ""]
        else:
            others += [f"{line} (exit {code}{'; kept: ' if what else ''}{what})" for line in lines]
    sections += ["## Other outcomes\n", *others] if others else []
    return "\n".join(sections).rstrip() + "\n"


def write(rows: list[Row], markdown: Path | None, records: Path | None) -> None:
    """What is known so far."""
    if markdown is not None:
        markdown.write_text(page(rows))
    if records is not None:
        records.write_text(json.dumps([asdict(row) for row in rows], indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="words, by commas")
    parser.add_argument("--markdown", type=Path, help="write a page with the table there")
    parser.add_argument("--json", type=Path, help="write the rows there")
    given = parser.parse_args()
    words = [word for word in given.only.split(",") if word]
    names = [name for name in FAULTS if not words or any(word in name for word in words)]
    rows, start = [], time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="ggslam-faults-") as temporary:
        folder = Path(temporary)
        inputs = make_inputs(folder)
        for number, name in enumerate(names):
            row = happen(name, folder / f"fault{number}", *inputs)
            if row is not None:
                rows.append(row)
                print(table([row]).splitlines()[-1], flush=True)
                write(rows, given.markdown, given.json)
    bad = [row for row in rows if row.problems]
    print(f"{len(rows)} faults in {time.perf_counter() - start:.0f} s, {len(bad)} bad")
    for row in bad:
        print(f"bad: {row.fault}: {', '.join(row.problems)}")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
