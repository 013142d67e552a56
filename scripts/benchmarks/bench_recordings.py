# SPDX-License-Identifier: Apache-2.0
"""One set of settings on every recording there is, and presets side by side, as printed in docs/presets.md.

    python scripts/benchmarks/bench_recordings.py                                       # the defaults on all recordings
    python scripts/benchmarks/bench_recordings.py --only room redkitchen --stop 80 --config fast-cpu default quality-cpu

The recordings are the generated room, every folder of `--data` that is recognised and tells poses, and
`livingroom+smoothed` and `livingroom+drifting`, whose depth errs as a phone's does. Images wider than
320 pixels are reduced to that. Each line is one run in a process of its own; speed is frames/s over those of the first
line of the same recording. Steps after the last frame do not count in either.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from commands import usage
from depth_makers import MAKERS, write_with_depth

from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence, recognise_format
from ggslam.synthetic import write_synthetic_sequence
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.settings import DepthNoise

WIDTH = 320
ERRING = "livingroom"
"""Recording that is exact, and of which there are others whose depth errs (`depth_makers`)."""
COLUMNS = (
    "recording", "settings", "images", "frames", "depth noise at 2 m", "frames/s", "speed", "ATE RMSE", "PSNR held out"
)  # fmt: skip


@dataclass(frozen=True)
class Item:
    """A recording and the factor by which its images are resized."""

    name: str
    path: Path
    scale: float


def recordings(data: Path, temporary: Path, only: list[str] | None) -> list[Item]:
    """The generated room and what is in `data`."""
    found = []
    if only is None or "room" in only:
        write_synthetic_sequence(temporary / "room", frames=60, width=320, height=240, seed=0)
        found.append(temporary / "room")
    folders = [path for path in sorted(data.resolve().iterdir()) if path.is_dir()] if data.is_dir() else []
    found += [path for path in folders if (only is None or path.name in only) and recognise_format(path)]
    for path in [path for path in folders if recognise_format(path) and path.name == ERRING]:
        for kind, make in MAKERS.items():
            name = f"{path.name}+{kind}"
            if only is None or name in only:
                write_with_depth(path, temporary / name, make())
                found.append(temporary / name)
    items = []
    for path in found:
        sequence = open_sequence(path)
        if sequence.ground_truth is not None:
            items.append(Item(path.name, path, min(1.0, WIDTH / sequence.camera.width)))
    return items


def run(item: Item, config: str, arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    """Metrics of one run, and what it read."""
    overrides = [part for setting in arguments.set for part in ("--set", setting)]
    usage(["run", str(item.path), "--scale", str(item.scale), "--stop", str(arguments.stop), "--config", config,
           "--out", str(out), "--overwrite", *overrides])  # fmt: skip
    frames = KeyframesRecord.read(out).frames
    return {
        "recording": item.name, "config": config, "metrics": MetricsRecord.read(out),
        "camera": SequenceRecord.read(out).camera, "frames": len(frames), "lost": sum(f.is_lost for f in frames),
    }  # fmt: skip


def values_of(item: MetricsRecord | Camera) -> dict[str, Any]:
    """For JSON."""
    return asdict(item) if isinstance(item, Camera) else item.values()


def line(outcome: dict[str, Any], first: dict[str, Any], noise: float) -> str:
    """A line of a Markdown table; `first` is what speed is compared to, `noise` in metres."""
    metrics, camera = outcome["metrics"], outcome["camera"]
    speed, reference = (o["metrics"].speed.frames_per_s for o in (outcome, first))
    lost = f", {outcome['lost']} lost" if outcome["lost"] else ""
    psnr = metrics.number("images", "held_out", "psnr")
    cells = [
        outcome["recording"], f"`{outcome['config']}`", f"{camera.width}x{camera.height}",
        f"{outcome['frames']}{lost}", f"{1e3 * noise:.1f} mm", f"{speed:.1f}", f"{speed / reference:.2f}",
        f"{100 * metrics.trajectory.ate_rmse_m:.2f} cm",
        "-" if psnr is None else f"{psnr:.2f} dB",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def parse_arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=default, help="folder with recordings (or GGSLAM_DATA)")
    parser.add_argument("--only", nargs="*", help="names of recordings; room: the generated one")
    parser.add_argument("--stop", type=int, default=100, help="frame to stop before")
    parser.add_argument("--config", nargs="*", default=["default"], help="presets or files of settings")
    parser.add_argument("--set", nargs="*", default=[], help="settings, name=value, over each of them")
    parser.add_argument("--json", type=Path, help="also write everything here")
    return parser.parse_args()


def main() -> None:
    """Prints the table."""
    arguments, outcomes = parse_arguments(), []
    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        for item in recordings(arguments.data, Path(temporary), arguments.only):
            sequence = open_sequence(item.path, scale=item.scale)
            noise = estimate_noise(sequence.frame(0).depth, sequence.camera) or DepthNoise()
            first: dict[str, Any] | None = None
            for config in arguments.config:
                outcome = run(item, config, arguments, Path(temporary) / "run")
                outcomes.append(outcome)
                first = first or outcome
                print(line(outcome, first, noise.sigma(2.0)), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(outcomes, indent=1, default=values_of))


if __name__ == "__main__":
    main()
