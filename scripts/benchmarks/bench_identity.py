# SPDX-License-Identifier: Apache-2.0
"""What learning objects costs and brings, as printed in docs/objects.md.

    python scripts/benchmarks/bench_identity.py  # no identity, the published schedule, colours, ours, votes only
    python scripts/benchmarks/bench_identity.py --ablation          # and single choices of ours

Runs on a recording with exact instance masks. Every line is one run in a process of its own; nothing else should run
on the machine. `wall` is the time from the first frame to the end of the last identity step, scoring excluded; its
ratio is to the run without identity that was measured right before, because the speed of a shared machine drifts.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from scored_runs import ScoredRun, scored_run

NONE = ["identity.enabled=false"]
PUBLISHED = [
    "identity.schedule=dense", "identity.every=1", "identity.detach=false", "identity.initialisation=random",
    "identity.rate=0.0025", "identity.weight=0.1",
]  # fmt: skip
COLORS = [
    "identity.schedule=colors", "identity.every=1", "identity.detach=false", "identity.rate=0.0025",
    "identity.weight=0.1",
]  # fmt: skip
"""Objects as colours in L1, as in SGS-SLAM, trained in every step together with everything else."""
RUNS: dict[str, list[str]] = {
    "published schedule": PUBLISHED,
    "objects as colours": COLORS,
    "ours": [],
    "votes only": ["identity.schedule=votes"],
}
ABLATION: dict[str, list[str]] = {
    "published, detached, rate 0.05": [*PUBLISHED, "identity.detach=true", "identity.rate=0.05"],
    "ours, in every iteration": ["identity.every=1"],
    "ours, no last passes": ["identity.final_passes=0"],
    "ours, no pixels at boundaries": ["identity.boundary=0"],
    "ours, pixels as they come": ["identity.balance=0"],
    "ours, random initialisation": ["identity.initialisation=random"],
    "ours, no neighbours": ["identity.neighbours.weight=0"],
    "ours, rate 0.0025": ["identity.rate=0.0025"],
}
COLUMNS = (
    ("PSNR held out", 2), ("mIoU held out %", 2), ("boundary mIoU %", 2), ("mIoU by votes %", 2),
    ("Gaussians right %", 1), ("ms an iteration", 1), ("wall s", 1), ("wall ratio", 2),
)  # fmt: skip


def run(settings: list[str], arguments: argparse.Namespace) -> ScoredRun:
    """One run with scores in a fresh process."""
    return scored_run(
        arguments.recording, settings, ["--iterations", str(arguments.iterations)], arguments.scale
    )


def cells(outcome: ScoredRun, reference: float) -> list[float | None]:
    """The numbers of one line."""
    metrics = outcome.metrics

    def percent(*keys: str) -> float | None:
        value = metrics.number("segmentation", *keys)
        return None if value is None else 100 * value

    return [
        metrics.number("images", "held_out", "psnr"), percent("held_out", "miou"), percent("held_out", "boundary_miou"),
        percent("held_out", "votes_miou"), percent("gaussians", "accuracy"),
        outcome.timing.mapping_ms_per_iteration, outcome.timing.whole_s, outcome.timing.whole_s / reference,
    ]  # fmt: skip


def parse_arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    parser.add_argument("--recording", type=Path, default=data / "livingroom", help="with exact masks")
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--ablation", action="store_true", help="also single choices")
    parser.add_argument("--only", nargs="*", help="lines to print")
    return parser.parse_args()


def main() -> None:
    """Prints the table."""
    arguments = parse_arguments()
    print("| schedule | " + " | ".join(name for name, _ in COLUMNS) + " |")
    print("|" + "---|" * (len(COLUMNS) + 1))

    def show(name: str, values: list[float | None]) -> None:
        texts = ["-" if v is None else f"{v:.{digits}f}" for v, (_, digits) in zip(values, COLUMNS, strict=True)]
        print(f"| {name} | " + " | ".join(texts) + " |", flush=True)

    for name, settings in {**RUNS, **(ABLATION if arguments.ablation else {})}.items():
        if arguments.only and name not in arguments.only:
            continue
        reference = run(NONE, arguments)
        show("no identity", cells(reference, reference.timing.whole_s))
        show(name, cells(run(settings, arguments), reference.timing.whole_s))


if __name__ == "__main__":
    main()
