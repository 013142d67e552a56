# SPDX-License-Identifier: Apache-2.0
"""What edits change where they should change nothing, as stated in docs/objects.md.

    python scripts/benchmarks/bench_editing.py RUN --remove 7 8 10 11 --move 7 --shift "0.2 0.05 -0.15"

RUN must have learned from exact masks of its recording, so that object ids are those of the masks. Every edit is made
alone, with --inpaint. PSNR is that of held-out views against the recording, before and after, over the pixels outside:
more than two pixels from the object's true mask, for a move also from where it is shown afterwards. `identical` is the
share of these pixels that no 8-bit channel changed in, `changed` the share where one changed by more than 0.02.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from held_out import held_out_poses

from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.frame import Frame

MARGIN = 2
"""Pixels around an object that count as inside."""


def shown(segmented: SegmentedMap, frame: Frame, pose: np.ndarray, object_id: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] of a view in [0, 1], and where the object weighs most, bool [H, W]."""
    rasterizer = CpuRasterizer()
    view = rasterizer.forward(segmented.gaussians, frame.camera, pose, features=False)
    own = (segmented.gaussians.object_id.numpy() == object_id).astype(np.uint16)
    return view.image.numpy().clip(0, 1).transpose(1, 2, 0), vote_label_image(rasterizer, view, own) > 0


def outside(before: RunFolder, after: RunFolder, object_id: int, moved: bool) -> list[float]:
    """PSNR before and after, percent of pixels identical and changed; means over the held-out views."""
    sequence, maps = open_recording_of(before), [before.segmented_map(), after.segmented_map()]
    rows = []
    for index, pose in held_out_poses(before).items():
        frame = sequence.frame(index)
        if frame.mask is None:
            raise SystemExit(f"frame {index} has no mask")
        (old, _), (new, place) = (shown(m, frame, pose, object_id) for m in maps)
        inside = (frame.mask == object_id) | (place if moved else False)
        keep = cv2.dilate(inside.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2, np.uint8)) == 0
        truth = frame.color[keep] / 255.0
        psnr = [-10 * np.log10(((image[keep] - truth) ** 2).mean()) for image in (old, new)]
        same = (np.rint(255 * old[keep]) == np.rint(255 * new[keep])).all(1).mean()
        rows.append([*psnr, 100 * same, 100 * (np.abs(old[keep] - new[keep]).max(1) > 0.02).mean()])
    return np.mean(rows, axis=0).tolist()


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--remove", type=int, nargs="*", default=[], metavar="ID")
    parser.add_argument("--move", type=int, nargs="*", default=[], metavar="ID")
    parser.add_argument("--shift", default="0.2 0.05 -0.15", help="of moves, metres")
    arguments = parser.parse_args()
    edits = [Edit("remove", str(i)) for i in arguments.remove]
    edits += [Edit("move", str(i), arguments.shift) for i in arguments.move]
    before = RunFolder.open(arguments.run)
    print("| edit | PSNR before | PSNR after | identical % | changed % | Gaussians added | seconds |")
    print("|" + "---|" * 7)
    for edit in edits:
        with tempfile.TemporaryDirectory() as temporary:
            start = time.perf_counter()
            outcome = edit_run(before, [edit], Path(temporary) / "edited", inpainting=True)
            seconds = time.perf_counter() - start
            cells = outside(before, outcome.folder, int(edit.objects), edit.kind == "move")
            added = outcome.filling.added if outcome.filling is not None else 0
        texts = [f"{value:.{digits}f}" for value, digits in zip(cells, (3, 3, 3, 4), strict=True)]
        print(f"| {edit.kind} {edit.objects} | {' | '.join(texts)} | {added} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
