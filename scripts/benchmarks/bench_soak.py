# SPDX-License-Identifier: Apache-2.0
"""What a long run costs from its beginning to its end: memory, milliseconds a frame, threads, open files.

    python scripts/benchmarks/bench_soak.py  # 20,000 frames of 80x60, round after round
    python scripts/benchmarks/bench_soak.py --frames 3000 --scene loop --width 160

A camera walks through one generated room (`room`) or a house (`loop`: a ring of rooms, which needs larger images: at
80x60 it is lost at doors) again and again. One round is drawn before the run; each time it is walked every image gets
noise of its own. A row for every so many frames is printed as soon as they are done.

Machines change their speed within minutes. So a process beside this one walks the first frames of the round with a map
of its own, several times for each row, while this one waits: `against short` is this run's frames/s over that one's.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.slam.step_log import COLUMNS
from ggslam.synthetic import SCENES, RayCaster, camera_path
from ggslam.synthetic.layouts import PLAIN
from ggslam.synthetic.sensor import noisy_color, noisy_depth
from ggslam.synthetic.trajectory import PathTuning
from ggslam.system.process_memory import resident_bytes, trim

TRAINING_PARTS = ("forward_ms", "loss_ms", "backward_ms", "identity_ms")


class Rounds:
    """One round through a scene, walked for ever.

    Args:
        scene: of `SCENES`.
        frames: of a round.
        width, height: of the images.
        seed: of scene and noise.
        keep: file that the drawn round is kept in; read if it is there.
    """

    def __init__(
        self, scene: str, frames: int, width: int, height: int, seed: int = 0, keep: Path | None = None
    ) -> None:
        kind = SCENES[scene]
        focal = PLAIN.focal * width
        self.camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self.rate, self._seed = kind.frame_rate, seed
        built = kind.build(seed, frames)
        # A route walks part of itself twice: not here.
        again = PathTuning.seen_again if kind.trajectory == "route" else 0.0
        poses = camera_path(built, round(frames * (1 + again)), kind.trajectory, seed)[:frames]
        self.poses = poses
        if keep is not None and keep.exists():
            with np.load(keep) as kept:
                self._drawn = list(zip(kept["color"], kept["depth"], strict=True))
            return
        caster = RayCaster(built, seed)
        self._drawn = [(image.color, image.depth) for image in (caster.render(self.camera, pose) for pose in poses)]
        if keep is not None:
            color, depth = (np.stack(images) for images in zip(*self._drawn, strict=True))
            np.savez(keep, color=color, depth=depth)

    def frames(self, count: int) -> Iterator[Frame]:
        """The first `count` frames of all rounds."""
        for index in range(count):
            color, depth = self._drawn[index % len(self._drawn)]
            rng = np.random.default_rng([self._seed, index])
            yield Frame(
                index, index, index / self.rate, noisy_color(color, rng), noisy_depth(depth, self.camera, rng),
                self.camera, T_world_camera=self.poses[index % len(self.poses)],
            )  # fmt: skip


SHORT, SHORT_EVERY = 60, 250
"""Frames of a short run, and of the long one between two of them."""


def walk_shortly(rounds: Rounds, overrides: list[str], processor_time: bool, orders: Connection) -> None:
    """Whenever told to, walks the first frames with a new map, and says how many a second."""
    clock = time.process_time if processor_time else time.perf_counter
    while orders.recv():
        slam, seconds = Slam(rounds.camera, load_config(None, overrides), has_masks=False), 0.0
        for frame in rounds.frames(SHORT):
            begin = clock()
            slam.step(frame)
            seconds += clock() - begin
        orders.send(SHORT / seconds)


class ShortRuns:
    """Short runs in another process, by turns with a long one; arguments as of `Soak`."""

    def __init__(self, rounds: Rounds, overrides: list[str], processor_time: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self._orders, theirs = context.Pipe()
        arguments = (rounds, overrides, processor_time, theirs)
        self._process = context.Process(target=walk_shortly, args=arguments, daemon=True)
        self._process.start()
        self._rates = [self._measure()]
        self._rates.clear()  # the first one warms up

    def measure(self) -> None:
        """Makes one now, and waits for it."""
        self._rates.append(self._measure())

    def frames_per_s(self) -> float:
        """Of those since the last call."""
        mean = float(np.mean(self._rates))
        self._rates.clear()
        return mean

    def _measure(self) -> float:
        self._orders.send(True)
        return float(self._orders.recv())


@dataclass(frozen=True)
class Row:
    """How a run stands after some frames; milliseconds are means of the frames since the row before."""

    frames: int
    frames_per_s: float
    against_short: float
    tracking_ms: float
    insertion_ms: float
    training_ms: float
    loops_ms: float
    places_ms: float
    resident_mb: float
    map_mb: float
    gaussians: int
    keyframes: int
    active: int
    closed: int
    lost: int
    threads: int
    files: int
    off_cm: float

    def line(self) -> str:
        """A line of a Markdown table."""
        digits = {"frames_per_s": 1, "resident_mb": 0, "map_mb": 0, "off_cm": 1}
        cells = [
            f"{v:.{digits.get(k, 2)}f}" if isinstance(v, float) else str(v) for k, v in asdict(self).items()
        ]  # fmt: skip
        return "| " + " | ".join(cells) + " |"

    @classmethod
    def header(cls) -> str:
        names = [name.replace("_", " ") for name in cls.__dataclass_fields__]
        return "| " + " | ".join(names) + " |\n|" + "---|" * len(names)


def map_bytes(slam: Slam) -> int:
    """What a map is made of: Gaussians with optimiser, images of keyframes, their points, their places."""
    gaussians = slam.map.capacity * slam.map.bytes_per_gaussian
    images = sum(k.color.nbytes + k.depth.nbytes for k in slam.mapper.keyframes)
    surface = sum(part.points.nbytes + part.normals.nbytes for part in slam.surface._parts)
    places = 0 if slam.loops is None else slam.loops.places.held_bytes
    return gaussians + images + surface + places


class Soak:
    """A run that is looked at every so many frames.

    Args:
        rounds: its recording.
        overrides: settings, as `--set` takes them.
        every: frames of a row.
        processor_time: count that, not wall time.
        short: runs to compare it with; None: `against_short` is NaN.
    """

    def __init__(
        self, rounds: Rounds, overrides: list[str], every: int, processor_time: bool = False,
        short: ShortRuns | None = None,
    ) -> None:  # fmt: skip
        self.slam = Slam(rounds.camera, load_config(None, overrides), has_masks=False)
        self.rounds, self.every, self.rows = rounds, every, list[Row]()
        self._clock = time.process_time if processor_time else time.perf_counter
        self._short = short
        self._watch_places()

    def _watch_places(self) -> None:
        self._places_s = 0.0
        if self.slam.loops is None:
            return
        places = self.slam.loops.places
        for name in ("describe", "query", "add"):

            def watched(*arguments: object, real: object = getattr(places, name), **named: object) -> object:
                start = time.perf_counter()
                try:
                    return real(*arguments, **named)  # type: ignore[operator]
                finally:
                    self._places_s += time.perf_counter() - start

            setattr(places, name, watched)

    def run(self, count: int, say: bool = True) -> list[Row]:
        """Walks `count` frames; returns a row for every `every` of them."""
        start, before = time.perf_counter(), 0.0
        for frame in self.rounds.frames(count):
            begin = self._clock()
            self.slam.step(frame)
            before += self._clock() - begin
            if self._short is not None and (frame.index + 1) % min(SHORT_EVERY, self.every) == 0:
                self._short.measure()
            if (frame.index + 1) % self.every == 0:
                self.rows.append(self._row(frame, before))
                before, self._places_s = 0.0, 0.0
                if say:
                    print(self.rows[-1].line(), flush=True)
        if say:
            print(f"{count} frames in {time.perf_counter() - start:.0f} s")
        return self.rows

    def _row(self, frame: Frame, seconds: float) -> Row:
        slam, every = self.slam, self.every
        table = dict(zip(COLUMNS, slam.steps.table()[-every:].mean(0), strict=True))
        truth = np.linalg.inv(self.rounds.poses[0]) @ frame.T_world_camera  # type: ignore[operator]
        trim()
        loops, rate = slam.loops, every / seconds
        return Row(
            frame.index + 1, rate, rate / self._short.frames_per_s() if self._short is not None else math.nan,
            table["tracking_ms"], table["insertion_ms"], sum(table[name] for name in TRAINING_PARTS),
            table["loops_ms"], 1e3 * self._places_s / every, resident_bytes() / 1e6, map_bytes(slam) / 1e6,
            slam.gaussian_count, len(slam.mapper.keyframes), len(slam.surface.active),
            0 if loops is None else sum(event.kind == "closed" for event in loops.events),
            sum(f.status == "lost" for f in slam.frames[-every:]), threading_count(), open_files(),
            100 * float(np.linalg.norm(slam.pose_of(slam.frames[-1])[:3, 3] - truth[:3, 3])),
        )  # fmt: skip


def threading_count() -> int:
    """Threads of this process, those of the compiled core included."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.is_dir() else threading.active_count()


def open_files() -> int:
    """Open file descriptors of this process."""
    descriptors = Path("/proc/self/fd")
    return len(list(descriptors.iterdir())) if descriptors.is_dir() else 0


def verdicts(rows: list[Row]) -> list[str]:
    """What the rows say of a long run's bars; the first quarter fills what is kept active."""
    if len(rows) < 4:
        return []
    quarter = len(rows) // 4
    first, last = rows[1], rows[-1]
    early, late = (np.mean([r.against_short for r in part]) for part in (rows[quarter : 2 * quarter], rows[-quarter:]))
    beside = [row.resident_mb - row.map_mb for row in (first, last)]
    return [
        f"frames/s against short runs: {early:.3f} in the second quarter, {late:.3f} in the last "
        f"({late / early - 1:+.1%})",
        f"loops: {first.loops_ms:.2f} ms a frame at first, {last.loops_ms:.2f} ms at last",
        f"memory: {first.resident_mb:.0f} to {last.resident_mb:.0f} MB, of which the map {first.map_mb:.0f} to "
        f"{last.map_mb:.0f} MB; beside it {beside[0]:.0f} to {beside[1]:.0f} MB",
        f"threads: {first.threads} to {last.threads}; open files: {first.files} to {last.files}",
        f"a Gaussian: {1e6 * last.resident_mb / max(1, last.gaussians):.0f} bytes with all there is",
    ]


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20000)
    parser.add_argument("--every", type=int, default=1000, help="frames of a row")
    parser.add_argument("--scene", choices=["room", "loop"], default="room")
    parser.add_argument("--round", type=int, help="frames of a round (420 in the house, 240 in the room)")
    parser.add_argument("--width", type=int, default=80)
    parser.add_argument("--iterations", type=int, default=1, help="of the mapper for each frame")
    parser.add_argument("--objects", action="store_true", help="learn objects, too")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="another setting")
    parser.add_argument(
        "--processor-time", action="store_true", help="count processor time, not wall time (where others work, too)"
    )
    parser.add_argument("--keep", type=Path, help="file (.npz) that the drawn round is kept in")
    parser.add_argument("--json", type=Path, help="write the rows there")
    return parser.parse_args()


def main() -> None:
    given = parse_arguments()
    length = given.round or {"room": 240, "loop": 420}[given.scene]
    rounds = Rounds(given.scene, length, given.width, given.width * 3 // 4, keep=given.keep)
    objects = [] if given.objects else ["identity.enabled=false"]
    overrides = [f"mapping.iterations_per_frame={given.iterations}", *objects, *given.set]
    short = ShortRuns(rounds, overrides, given.processor_time)
    soak = Soak(rounds, overrides, given.every, given.processor_time, short)
    size = f"{given.width}x{given.width * 3 // 4}"
    print(f"{given.frames} frames of {size}, {length} a round; load {os.getloadavg()[0]:.1f}")
    print(Row.header(), flush=True)
    rows = soak.run(given.frames)
    for line in verdicts(rows):
        print(line)
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    sys.stdout.flush()


if __name__ == "__main__":
    main()
