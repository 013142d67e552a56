# SPDX-License-Identifier: Apache-2.0
"""Speed and quality of whole runs, as printed in docs/results.md.

    python scripts/benchmarks/bench_slam.py                       # the table: every recording, k = 1, 2, 4, 8
    python scripts/benchmarks/bench_slam.py --only livingroom --iterations 4 --refine 1000
    python scripts/benchmarks/bench_slam.py --realtime 10 --only redkitchen

Nothing else should run on the machine. Every line is one run in a process of its own, so that peak memory is its own.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from scored_runs import ScoredRun, scored_run

RECORDINGS = ("livingroom", "redkitchen", "rgbd_dataset_freiburg3_cabinet", "shelf")
BIG_STEPS = {"rgbd_dataset_freiburg3_cabinet", "shelf"}
COLUMNS = (
    ("frames/s", 1), ("iterations/frame", 1), ("tracking ms", 1), ("iteration ms", 1), ("insertion ms", 1),
    ("PSNR held out", 2), ("keyframes", 2), ("all", 2), ("all unmasked", 2), ("SSIM", 3), ("LPIPS", 3),
    ("depth L1 cm", 2), ("ATE cm", 3), ("Gaussians k", 0), ("MB", 0), ("lost", 0), ("dropped", 0),
)  # fmt: skip


def run(recording: Path, k: int, arguments: argparse.Namespace, refine: int, realtime: float) -> ScoredRun:
    """One run with scores in a fresh process."""
    out = Path(arguments.out) / f"{recording.name}-k{k}-r{refine}" if arguments.out else None
    words = ["--iterations", str(k), "--refine", str(refine), *(["--realtime", str(realtime)] if realtime else [])]
    return scored_run(recording, arguments.set, words, arguments.scale, out)


def cells(outcome: ScoredRun) -> list[float | None]:
    """The numbers of one line of the table."""
    metrics, mapping = outcome.metrics, outcome.timing.mapping
    speed, images = metrics.speed, metrics.images
    insertion = 1e3 * mapping.insertion / max(1, mapping.keyframes)
    depth, ate = images.number("all", "depth_l1_m"), metrics.number("trajectory", "ate_rmse_m")
    return [
        speed.frames_per_s, speed.iterations_per_frame, speed.tracking_ms, speed.mapping_iteration_ms, insertion,
        images.number("held_out", "psnr"), images.number("keyframes", "psnr"), images.number("all", "psnr"),
        images.number("all", "psnr_unmasked"), images.number("held_out", "ssim"), images.number("held_out", "lpips"),
        None if depth is None else 100 * depth, None if ate is None else 100 * ate,
        metrics.map.gaussians / 1000, metrics.memory.peak_rss_mb, len(outcome.lost), speed.dropped_frames,
    ]  # fmt: skip


def line(name: str, k: str, values: list[float | None]) -> str:
    """A line of a Markdown table."""
    texts = ["-" if v is None else f"{v:.{digits}f}" for v, (_, digits) in zip(values, COLUMNS, strict=True)]
    return f"| {name} | {k} | " + " | ".join(texts) + " |"


def parse_arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=default, help="folder with the recordings (or GGSLAM_DATA)")
    parser.add_argument("--only", nargs="*", default=RECORDINGS[:2], help="recordings")
    parser.add_argument("--iterations", nargs="*", type=int, default=[1, 2, 4, 8], help="k, iterations a frame")
    parser.add_argument("--refine", type=int, default=-1, help="steps at the end; -1: as by default")
    parser.add_argument("--realtime", type=float, default=0)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--set", nargs="*", default=[], help="settings, name=value")
    parser.add_argument("--out", help="keep the run folders here")
    parser.add_argument("--json", type=Path, help="also write everything here")
    return parser.parse_args()


def main() -> None:
    """Prints the table."""
    arguments = parse_arguments()
    print("| recording | k | " + " | ".join(name for name, _ in COLUMNS) + " |")
    print("|" + "---|" * (len(COLUMNS) + 2))
    outcomes = []
    for name in arguments.only:
        for k in arguments.iterations:
            outcome = run(arguments.data / name, k, arguments, arguments.refine, arguments.realtime)
            outcomes.append({"recording": name, "k": k, **vars(outcome)})
            label = str(k) + (f" + {arguments.refine}" if arguments.refine >= 0 else "")
            label += f" realtime {arguments.realtime:g}" if arguments.realtime else ""
            print(line(name, label, cells(outcome)), flush=True)
            for frame in outcome.lost:
                print(f"  lost at frame {frame.frame}: {frame.reason}")
    if arguments.json:
        arguments.json.write_text(json.dumps(outcomes, indent=1, default=lambda record: record.values()))


if __name__ == "__main__":
    main()
