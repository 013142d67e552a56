# SPDX-License-Identifier: Apache-2.0
"""Rows of a paper's table or figure, with ours beside the published: printed, and kept for docs/papers.md."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ggslam.system.atomic import make_folder, write_text

ROOT = Path(__file__).parents[2]

NOT_MADE = "–"


@dataclass
class Paper:
    """What one script prints.

    Attributes:
        name: of the script's results, `NAME.json`.
        title: of the paper and its source.
        conditions: what ours ran on.
        script: its name, if not that of the results.
        rows: (table or figure, row, published, ours, remark), each text.
        pictures: file beside the results, and what it shows.
    """

    name: str
    title: str
    conditions: str = ""
    script: str = ""
    rows: list[tuple[str, str, str, str, str]] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)

    def add(self, table: str, row: str, published: str, ours: str, remark: str = "") -> None:
        """Takes and prints one row."""
        self.rows.append((table, row, published or NOT_MADE, ours or NOT_MADE, remark))
        print("| " + " | ".join(self.rows[-1]) + " |", flush=True)

    def show(self, path: Path, what: str) -> None:
        """Takes a picture, which lies in the folder of the results."""
        self.pictures.append((path.name, what))
        print(path, flush=True)

    def write(self, out: Path) -> None:
        """Keeps the rows as `out`/NAME.json, whole or not at all."""
        path = out / f"{self.name}.json"
        make_folder(out)
        write_text(path, json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n")
        print(path)

    def markdown(self) -> str:
        """The section of the page."""
        lines = ["| table | row | published | ours | remark |", "| --- | --- | --- | --- | --- |"]
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        shown = [f"\n![{what}](papers/{name})\n\n*{what}*\n" for name, what in self.pictures]
        head = f"### {self.title}\n\n`{self.script or self.name}.py`. {self.conditions}\n\n"
        return head + "\n".join(lines) + "\n" + "".join(shown)


def options(text: str | None) -> argparse.ArgumentParser:
    """The options that every script has."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("GGSLAM_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=default, help="folder with the recordings (or GGSLAM_DATA)")
    parser.add_argument("--quick", action="store_true", help="less of everything, under a minute")
    parser.add_argument("--out", type=Path, default=Path("runs/papers"), help="where results and pictures go")
    return parser
