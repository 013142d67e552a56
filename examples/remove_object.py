# SPDX-License-Identifier: Apache-2.0
"""Removes an object from a run's map, closes the hole, and renders what is there now.

ggslam run demo/room --out demo/run
python examples/remove_object.py demo/run sofa demo/without_sofa
"""

from __future__ import annotations

import sys
from pathlib import Path

import ggslam


def main(run: str, name: str, out: str) -> None:
    """`name`: a name or id of objects.json, or several: "mug,7"."""
    folder = ggslam.RunFolder.open(Path(run))
    print("objects:", ", ".join(record.label() for record in folder.object_table().objects))
    outcome = ggslam.edit_run(folder, [ggslam.Edit("remove", name)], Path(out), inpainting=True, overwrite=True)
    for line in [*outcome.changes, *outcome.notes]:
        print(line)
    for path in ggslam.render_run(outcome.folder, Path(out) / "renders", count=3):
        print(f"wrote {path}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 4 else sys.exit(__doc__)
