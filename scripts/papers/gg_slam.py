# SPDX-License-Identifier: Apache-2.0
"""GG-SLAM's tables, with ours beside them, on a recording with exact masks.

    python scripts/papers/gg_slam.py [--data FOLDER] [--quick]

Table 1 is in the layout of Replica's scenes and comes from `ggslam batch --replica` (replica.py). Here: table 2,
schedules of learning objects on one recording; table 3, real time at 10, 20 and 30 frames a second with objects. The
paper's own figures are not in the code: its cells are empty. Nothing else should run on the machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_identity import NONE, PUBLISHED  # isort: skip
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import TimingRecord

RECORDING = "livingroom"
SCHEDULES = {
    "no objects": NONE,
    "published schedule: whole images, every step, gradients into the map": PUBLISHED,
    "ours": [],
    "ours, votes only": ["identity.schedule=votes"],
}
RATES = (10, 20, 30)


def run(recording: Path, quick: bool, words: list[str], settings: list[str]) -> tuple[MetricsRecord, TimingRecord]:
    """One run in a process of its own; its scores and times."""
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "run"
        command = [
            sys.executable, "-m", "ggslam", "run", str(recording), "--scale", "0.5", "--out", str(out), *words,
            *(["--stop", "20", "--refine", "20"] if quick else []),
            *[part for setting in settings for part in ("--set", setting)],
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stdout}\n{done.stderr}")
        return MetricsRecord.read(out), TimingRecord.read(out)


def scores(metrics: MetricsRecord) -> str:
    """PSNR, SSIM and LPIPS of held-out frames, and mIoU."""
    texts = []
    for name, unit, digits in (("psnr", " dB", 2), ("ssim", " SSIM", 3), ("lpips", " LPIPS", 3)):
        value = metrics.number("images", "held_out", name)
        texts += [] if value is None else [f"{value:.{digits}f}{unit}"]
    miou = metrics.number("segmentation", "held_out", "miou")
    return ", ".join([*texts, *([] if miou is None else [f"{100 * miou:.1f} % mIoU"])])


def main() -> None:
    arguments = options(__doc__).parse_args()
    recording, quick = arguments.data / RECORDING, arguments.quick
    if not recording.exists():
        raise SystemExit(f"{recording}: not there")
    conditions = f"{RECORDING} at 320x240 with its exact masks, {os.cpu_count()} processors; held-out frames."
    paper = Paper("gg_slam", "GG-SLAM", conditions)
    for name, settings in SCHEDULES.items():
        metrics, timing = run(recording, quick, [], settings)
        wall = timing.wall_s + timing.mapping.identity_finish
        paper.add("table 2", name, "", scores(metrics), f"{wall:.0f} s from the first frame to the last identity step")
    for rate in RATES:
        metrics, _ = run(recording, quick, ["--realtime", str(rate)], [])
        speed = metrics.speed
        paper.add(
            "table 3", f"{rate} frames/s in real time, with objects", "", scores(metrics),
            f"{speed.dropped_frames} frames dropped, {speed.iterations_per_frame:.1f} steps a frame",
        )  # fmt: skip
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
