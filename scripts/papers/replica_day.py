# SPDX-License-Identifier: Apache-2.0
"""A day with Replica's eight scenes, on generated rooms in their layout, size and number, which stand in for them.

    python scripts/papers/replica_day.py [--quick]
    python scripts/papers/replica_day.py --frames 2000 --scenes room0     # one at full length: an hour or two

Recordings of 1200x680 are written with `ggslam synth --layout replica`, run and scored with `ggslam batch --replica`:
GG-SLAM's table 1 for each scene, seconds and memory. Rooms are of seeds 0 to 7 and depth is exact, as Replica's is.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from commands import usage  # isort: skip
from gg_slam import scores  # isort: skip
from ggslam.jobs.batch.manifest import REPLICA
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.system.plurals import quantity


def make_scenes(folder: Path, scenes: list[str], frames: int) -> None:
    """Writes those that are not there."""
    for seed, scene in enumerate(REPLICA):
        if scene in scenes and not (folder / scene).exists():
            words = ["--layout", "replica", "--size", "1200x680", "--no-noise", "--seed", str(seed)]
            usage(["synth", str(folder / scene), "--frames", str(frames), *words])


def add_scene(paper: Paper, scene: str, run: Path) -> None:
    """A row of one run."""
    metrics, timing = MetricsRecord.read(run), TimingRecord.read(run)
    ate = metrics.number("trajectory", "ate_rmse_m")
    error = "" if ate is None else f"{100 * ate:.3f} cm ATE RMSE, "
    seconds, most = timing.whole_s, timing.peak_rss_mb or 0.0
    paper.add(
        "table 1", f"generated room for {scene}, {timing.frames} frames", "", error + scores(metrics),
        f"{seconds:.0f} s with the final refinement, {most:.0f} MB at most, {metrics.map.gaussians} Gaussians",
    )  # fmt: skip


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(REPLICA), choices=REPLICA, help="which of them")
    parser.add_argument("--frames", type=int, help="of each recording; default 20, with --quick 4")
    parser.add_argument("--recordings", type=Path, help="folder that keeps the recordings for the next time")
    arguments = parser.parse_args()
    scenes = arguments.scenes[: 1 if arguments.quick else None]
    frames = arguments.frames or (4 if arguments.quick else 20)
    paper = Paper(
        "replica_day" if arguments.frames is None else f"replica_day_{frames}",
        f"A day with Replica, {quantity(len(scenes), 'scene')} (GG-SLAM, table 1)",
        f"Generated rooms of 1200x680, {frames} frames each, `ggslam batch --replica`; held-out frames.", "replica_day",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.recordings or Path(temporary, "Replica")
        make_scenes(folder, scenes, frames)
        out = Path(temporary, "batch")
        usage(["batch", "--replica", str(folder.resolve()), "--out", str(out), "--workers", "1"])
        for scene in scenes:
            add_scene(paper, scene, out / "runs" / scene / "default" / "seed0")
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
