# SPDX-License-Identifier: Apache-2.0
"""Removes an object from a run's map, closes the hole, and renders what is there now.

ggslam run demo/room --out demo/run
python examples/remove_object.py demo/run sofa demo/without_sofa
"""

from __future__ import annotations

import sys
from pathlib import Path

from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.render.frames import render_frames, select_frames
from ggslam.runs.folder import RunFolder


def main(run: str, name: str, out: str) -> None:
    """`name`: a name or id of objects.json, or several: "mug,7"."""
    folder = RunFolder.open(run)
    print("objects:", ", ".join(record.label() for record in folder.object_table().objects))
    outcome = edit_run(folder, [Edit("remove", name)], Path(out), inpainting=True, overwrite=True)
    for line in [*outcome.changes, *outcome.notes]:
        print(line)
    frames = select_frames(outcome.folder, None, every=None, count=3)
    for path in render_frames(outcome.folder, frames, ["color", "depth"], Path(out) / "renders", width=None):
        print(f"wrote {path}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 4 else sys.exit(__doc__)
