# SPDX-License-Identifier: Apache-2.0
"""Writes docs/papers.md: the tables of Replica's scenes that papers print, with ours beside them.

    python scripts/papers/replica.py                         # ours stay empty, and say so
    python scripts/papers/replica.py --batch runs/Replica    # ours from `ggslam batch --replica X --by-paper-rules`
    python scripts/papers/replica.py --check                 # whether the page's published figures are the code's

The other scripts of this folder print a paper each; what they wrote with `--out docs/papers` follows on the page.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from rows import Paper

from ggslam.jobs.batch.manifest import REPLICA
from ggslam.jobs.batch.published import PUBLISHED, Published

PAGE = Path(__file__).parents[2] / "docs" / "papers.md"
HEAD = """# Papers' tables

GG-SLAM's tables are in the layout of Replica's eight scenes, 2,000 frames of 1200x680 each. The recordings are not part
of this repository. With them,

```bash
ggslam batch --replica data/Replica --by-paper-rules
```

makes our rows, scored by each paper's own rules, and `python scripts/papers/replica.py --batch runs/Replica` writes
this page. A dash says that a figure was not made here. GG-SLAM's own figures are not in the code, so there is no row of
them.
"""
OTHERS = """
## Other papers

The other scripts in `scripts/papers/` print a paper each, ours beside what is published (`--quick`: less of
everything): `replica_day.py` (`batch --replica` on generated rooms), `gg_slam.py` (ways of learning objects, real time
with objects, an ablation), `embedded.py` (odometry by 100 frames, coding by quantiser and scale, clients),
`octomap_quantised.py`, `srt_pm.py` (partial maps) and `gpu_mapping.py`. A dash under "published" is a figure that is
not in the code; recordings that are not to be had are replaced by generated ones, which the rows name. What they wrote
with `--out docs/papers` {what}.

"""


def sections(folder: Path) -> str:
    """What the other scripts wrote, in the order of their names."""
    papers = [Paper(**json.loads(path.read_text())) for path in sorted(folder.glob("*.json"))]
    what = "follows" if papers else "would follow here; nothing yet"
    return OTHERS.format(what=what) + "\n".join(paper.markdown() for paper in papers)


def own_figures(batch: Path | None, paper: Published) -> dict[str, str]:
    """Ours by a paper's rules, by scene, out of a batch's table.csv."""
    if batch is None:
        return {}
    column = f"{paper.beside}, ours by {paper.title}'s rules ({paper.rule_words})"
    with (batch / "table.csv").open(newline="") as file:
        return {row["recording"]: row.get(column, "") for row in csv.DictReader(file) if row["settings"] == "default"}


def table(paper: Published, batch: Path | None) -> str:
    """One figure of one paper, all scenes."""
    own, figures = own_figures(batch, paper), [paper.values[scene] for scene in REPLICA]
    mean = sum(figures) / len(figures)
    rows = [
        ["", *REPLICA, "mean"], ["---", *["---:"] * 9],
        [paper.title, *(f"{value:g}" for value in figures), f"{mean:.4g}"],
        ["ours", *(own.get(scene) or "–" for scene in REPLICA), own.get("mean") or "–"],
    ]  # fmt: skip
    lines = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    return f"\n## {paper.beside}: {paper.title}\n\n{paper.source}; ours by its rule: {paper.rule_words}.\n\n{lines}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=Path, help="folder of the batch")
    parser.add_argument("--papers", type=Path, default=PAGE.parent / "papers", help="what the other scripts wrote")
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    tables = [table(paper, arguments.batch) for paper in PUBLISHED if set(REPLICA) <= set(paper.values)]
    if arguments.check:
        lines = [line for text in tables for line in text.splitlines()]
        published = [line for line in lines if line.startswith("| ") and "ours" not in line]
        page = PAGE.read_text()
        sys.exit("docs/papers.md is not up to date" if [line for line in published if line not in page] else 0)
    PAGE.write_text(HEAD + "".join(tables) + sections(arguments.papers))
    print(PAGE)


if __name__ == "__main__":
    main()
