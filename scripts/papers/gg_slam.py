# SPDX-License-Identifier: Apache-2.0
"""GG-SLAM's tables, with ours beside them, on a recording with exact masks.

    python scripts/papers/gg_slam.py [--data FOLDER] [--quick]

Table 1 is in the layout of Replica's scenes and comes from `ggslam batch --replica` (replica.py). Here: table 2,
schedules of learning objects on one recording; table 3, real time at 10, 20 and 30 frames a second with objects; and an
ablation of which keyframe is trained next, and of how the map grows and is pruned, without objects. The paper's own
figures are not in the code: its cells are empty. Nothing else should run on the machine.
"""

from __future__ import annotations

import os
from pathlib import Path

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_identity import COLORS, NONE, PUBLISHED  # isort: skip
from scored_runs import scored_run  # isort: skip
from ggslam.runs.records.metrics import MetricsRecord

RECORDING = "livingroom"
SCHEDULES = {
    "no objects": NONE,
    "published schedule: whole images, every step, gradients into the map": PUBLISHED,
    "SGS-SLAM-like: colours of objects in L1, every step, gradients into the map; the nearest colour counts": COLORS,
    "ours": [],
    "ours, votes only": ["identity.schedule=votes"],
}
RATES = (10, 20, 30)
ABLATION = {
    "ours: keyframes evenly, successive ones far apart; insertion; pruning": [],
    "random keyframes": ["mapping.order=random"],
    "newest keyframes first": ["mapping.order=newest"],
    "covisible keyframes": ["mapping.order=covisible"],
    "clone and split besides insertion": ["mapping.densification=added"],
    "clone and split, sparse insertion": ["mapping.densification=instead"],
    "no pruning": ["mapping.pruning.enabled=false"],
}
ABLATION_FRAMES = 120
"""First frames of the recording, without objects."""
SHORT = ["--stop", "8", "--refine", "8"]
"""Options of `--quick`, which leaves out some rows, too."""


def scores(metrics: MetricsRecord) -> str:
    """PSNR, SSIM and LPIPS of held-out frames, and mIoU."""
    texts = []
    for name, unit, digits in (("psnr", " dB", 2), ("ssim", " SSIM", 3), ("lpips", " LPIPS", 3)):
        value = metrics.number("images", "held_out", name)
        texts += [] if value is None else [f"{value:.{digits}f}{unit}"]
    miou = metrics.number("segmentation", "held_out", "miou")
    return ", ".join([*texts, *([] if miou is None else [f"{100 * miou:.1f} % mIoU"])])


def add_schedules(paper: Paper, recording: Path, short: list[str]) -> None:
    """Table 2."""
    for name, settings in list(SCHEDULES.items())[: 3 if short else None]:
        done = scored_run(recording, settings, short)
        remark = f"{done.timing.whole_s:.0f} s from the first frame to the last identity step"
        paper.add("table 2", name, "", scores(done.metrics), remark)


def add_rates(paper: Paper, recording: Path, short: list[str]) -> None:
    """Table 3."""
    for rate in RATES[: 1 if short else None]:
        metrics = scored_run(recording, [], ["--realtime", str(rate), *short]).metrics
        speed = metrics.speed
        paper.add(
            "table 3", f"{rate} frames/s in real time, with objects", "", scores(metrics),
            f"{speed.dropped_frames} frames dropped, {speed.iterations_per_frame:.1f} steps a frame",
        )  # fmt: skip


def add_ablation(paper: Paper, recording: Path, short: list[str]) -> None:
    """Choices of training, without objects."""
    words = short or ["--stop", str(ABLATION_FRAMES)]
    for name, settings in list(ABLATION.items())[:: 3 if short else 1]:
        done = scored_run(recording, [*NONE, *settings], words)
        remark = f"{done.metrics.map.gaussians} Gaussians, {done.timing.whole_s:.0f} s"
        paper.add("ablation", name, "", scores(done.metrics), remark)


def main() -> None:
    arguments = options(__doc__).parse_args()
    recording, short = arguments.data / RECORDING, SHORT if arguments.quick else []
    if not recording.exists():
        raise SystemExit(f"{recording}: not there")
    conditions = (
        f"{RECORDING} at 320x240 with its exact masks, {os.cpu_count()} processors; held-out frames. The ablation: "
        f"frames 0 to {ABLATION_FRAMES - 1}, without objects. Identities have 16 channels in all rows; "
        "colours use 3 of them."
    )
    paper = Paper("gg_slam", "GG-SLAM", conditions)
    add_schedules(paper, recording, short)
    add_rates(paper, recording, short)
    add_ablation(paper, recording, short)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
