#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Runs of pieces of a recording, merged, against one run of the whole.

    python scripts/benchmarks/bench_merge.py --folder /tmp/merge
    python scripts/benchmarks/bench_merge.py --folder /tmp/merge --cases livingroom renamed refused --scale 0.5

Cases:
    livingroom   frames 0-119 and 80-199, taught by exact masks
    renamed      the same, but the masks of the second piece call everything by other numbers: objects have to be found
                 again by their surfaces
    thirds       livingroom in three pieces
    redkitchen   frames 0-149 and 110-249, objects by geometry
    loop         a walk through a generated house (`ggslam synth --scene loop`) in two halves
    containers   the pieces of livingroom as files for the wire (.ggz): bytes, what the trip costs, merged from them
    refused      livingroom and redkitchen: nothing in common

Prints for each: error of the trajectory, PSNR of held-out frames and mIoU (where there are true masks) of each piece,
of the merged run and of the single run, Gaussians, objects, and the seconds that each took. Runs in the folder that are
there already are used again. Nothing else should run beside it.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.runs.folder import RunFolder
from ggslam.sequences import open_sequence
from ggslam.system.atomic import make_folder, write_bytes

sys.path.insert(0, str(Path(__file__).parents[2]))

import cv2
from commands import usage

DATA = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data"))
PIECES = {
    "livingroom": ("livingroom", [(0, 120), (80, 200)]), "renamed": ("livingroom", [(0, 120), (80, 200)]),
    "thirds": ("livingroom", [(0, 90), (60, 150), (120, 200)]), "redkitchen": ("redkitchen", [(0, 150), (110, 250)]),
    "loop": ("loop", [(0, 280), (200, 480)]),
}  # fmt: skip
"""Recording, and first frame and the one after the last of each piece."""
CASES = (*PIECES, "containers", "refused")


@dataclass(frozen=True)
class Bench:
    """Where runs go, and how they are made."""

    folder: Path
    scale: float
    every: int

    def case(self, name: str) -> None:
        """Prints one case."""
        if name in ("refused", "containers"):
            getattr(self, name)()
            return
        recording, pieces = PIECES[name]
        path = self.recording(recording)
        print(f"{name}: {path}, images at {self.scale:g}", flush=True)
        runs = []
        for number, (start, stop) in enumerate(pieces):
            masks = self.renamed_masks(path, start, stop) if name == "renamed" and number else None
            runs.append(self.run(path, recording, start, stop, masks))
        single = self.run(path, recording, pieces[0][0], pieces[-1][1])
        merged = self.folder / f"{name}-merged"
        took = usage(["merge", *map(str, runs), "--out", str(merged), "--overwrite"])
        for line in took.said.splitlines():
            if "links" in line or line.startswith(("note", "wrote")):
                print(f"    {line}")
        for folder in (*runs, merged, single):
            self.report(folder, path if name == "renamed" else None)
        print(f"    merging took {took.seconds:.0f} s, {took.peak_mb:.0f} MB", flush=True)

    def containers(self) -> None:
        """Pieces sent as one file each, decoded and merged; the pieces and their merged run are those of livingroom."""
        recording, pieces = PIECES["livingroom"]
        path, files = self.recording(recording), list[Path]()
        print(f"containers: {path}, images at {self.scale:g}", flush=True)
        for piece in pieces:
            run = self.run(path, recording, *piece)
            file = self.folder / f"{run.name}.ggz"
            encoded = usage(["encode", str(run), str(file)])
            again = self.folder / f"{run.name}-decoded"
            shutil.rmtree(again, ignore_errors=True)
            decoded = usage(["decode", str(file), str(again)])
            files.append(file)
            for line in encoded.said.splitlines():
                if "Gaussians; " in line or "the file" in line:
                    print(f"    {file.name}: {line.strip(' │')}")
            print(f"    {encoded.seconds:.0f} s there, {decoded.seconds:.0f} s back", flush=True)
            self.report(run, None)
            self.report(again, None)
        merged = self.folder / "containers-merged"
        took = usage(["merge", *map(str, files), "--out", str(merged), "--overwrite"])
        self.report(merged, None)
        print(f"    merging took {took.seconds:.0f} s, {took.peak_mb:.0f} MB", flush=True)

    def refused(self) -> None:
        """Runs that have nothing in common."""
        rooms = [self.run(self.recording(name), name, *PIECES[name][1][0]) for name in ("livingroom", "redkitchen")]
        try:
            usage(["merge", *map(str, rooms), "--out", str(self.folder / "refused")])
        except SystemExit as end:
            print(f"refused: {str(end).splitlines()[-1]}")
        else:
            print("refused: NO, these rooms were merged")

    def recording(self, name: str) -> Path:
        """A shared recording, or a generated one."""
        if name != "loop":
            return DATA / name
        path = self.folder / "recordings" / name
        if not path.is_dir():
            usage(["synth", str(path), "--scene", "loop", "--width", "320", "--height", "240"])
        return path

    def run(self, path: Path, name: str, start: int, stop: int, masks: Path | None = None) -> Path:
        """A run of a piece, made unless it is there."""
        out = self.folder / f"{name}-{start}-{stop - 1}{'-renamed' if masks else ''}"
        if not (out / "run.json").is_file():
            words = ["run", str(path), "--start", str(start), "--stop", str(stop), "--scale", str(self.scale)]
            more = ["--masks", str(masks)] if masks else []
            took = usage([*words, *more, "--out", str(out), "--no-eval", "--overwrite"])
            print(f"    {out.name}: {took.seconds:.0f} s, {took.peak_mb:.0f} MB", flush=True)
        return out

    def renamed_masks(self, recording: Path, start: int, stop: int) -> Path:
        """Masks of a piece in which object i is called something else."""
        out = self.folder / "recordings" / "renamed-masks"
        sequence = open_sequence(recording, start=start, stop=stop)
        names = np.random.default_rng(0).permutation(1000).astype(np.uint16) + 1
        make_folder(out)
        for index in range(len(sequence)):
            mask = sequence.frame(index).mask
            assert mask is not None
            renamed = np.where(mask > 0, names[mask % 1000], 0).astype(np.uint16)
            stem = Path(str(sequence.files(index).color)).stem
            write_bytes(out / f"{stem}.png", cv2.imencode(".png", renamed)[1].tobytes())
        return out

    def report(self, run: Path, truth: Path | None) -> None:
        """Scores a run and prints a line."""
        folder = RunFolder.open(run)
        if folder.metrics() is None:
            masks = [] if truth is None else ["--masks", str(truth_masks(truth))]
            usage(["eval", str(run), "--no-lpips", "--every", str(self.every), *masks])
        metrics = folder.metrics()
        assert metrics is not None and metrics.images.held_out is not None
        ate = None if metrics.trajectory is None else metrics.trajectory.ate_rmse_m
        miou = metrics.number("segmentation", "held_out", "miou")
        objects = len(folder.object_table()) if folder.has_objects() else 0
        print(
            f"    {run.name:28s} ATE {'-' if ate is None else f'{100 * ate:.2f} cm'}, held out "
            f"{metrics.images.held_out.psnr:.2f} dB, mIoU {'-' if miou is None else f'{100 * miou:.1f} %'}, "
            f"{folder.timing().gaussians} Gaussians, {objects} objects", flush=True,
        )  # fmt: skip


def truth_masks(recording: Path) -> Path:
    """Folder of a recording's own masks."""
    sequence = open_sequence(recording)
    mask = sequence.files(0).mask
    assert mask is not None
    return Path(str(mask)).parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for runs; kept, to be used again")
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES)
    parser.add_argument("--scale", type=float, default=0.5, help="of the images")
    parser.add_argument("--every", type=int, default=1, help="score only every n-th frame")
    arguments = parser.parse_args()
    make_folder(arguments.folder)
    bench = Bench(arguments.folder, arguments.scale, arguments.every)
    for name in arguments.cases:
        bench.case(name)


if __name__ == "__main__":
    main()
