# SPDX-License-Identifier: Apache-2.0
"""What the host does for a frame of a run on a GPU, counted and timed without one.

    python scripts/benchmarks/bench_host.py                      # 640x480: ordinary frames, keyframes
    python scripts/benchmarks/bench_host.py --against ../before  # the same of another checkout, by turns
    python scripts/benchmarks/bench_host.py --quick              # 160x120, a minute
    python scripts/benchmarks/bench_host.py --parts growth       # keyframe 20 against the last, small images

Kernels run in the tests' emulation on the CPU; medians over the frames of a kind, the first --skip left out. Ordinary
frames in which the tracker looks at residuals are a kind of their own. What a run finds out about its camera in its
first frames (whether outlines of depth are sharp, 12 ms a frame) is decided before.

    counts  under the tests' device watch. Calls of Python functions and of C functions (`sys.setprofile`; all threads
            of Python, not the compiled core's), operations of torch and how many tensors they allocate on the device,
            page-locked allocations, calls of the kernels' library (each function of it, those that only ask for sizes
            included), waits, copies of torch and their bytes (not those within a call of the library, such as the
            tracker's result). The watch's own work is left out; a stand-in of torch.cuda counts as one call.
    time    without the watch, tensors on the CPU; kernels, and copies that a GPU makes by itself, on another processor:
            a step by the clock, and processor time of its thread, both less what these took. It has all of Python, the
            compiled core's work of this thread, OpenCV, waiting for threads, and torch's other operations. It lacks
            what only a GPU has: starting kernels and copies, events, page-locked memory, looking up streams. Emulated
            kernels take seconds, after which much is not in the caches: so the frames are stepped once more, to and
            fro, with the kernels left out and with the poses found before ("no kernels"), one after the other as a GPU
            lets them follow. Ratios of two checkouts by turns are what counts; nothing else should run.
    growth  all frames are keyframes of --growth-size: counts and time of keyframe 20 and of the last.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
PARTS = ("counts", "time", "growth")
WINDOW = 5
"""Keyframes on either side of those that growth compares, over which it takes medians."""


def run_worker(checkout: Path, part: str, recording: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One run in a process of its own, with the code of a checkout: figures of each kind of frame."""
    command = [
        sys.executable, str(Path(__file__).with_name("host_run.py")), part, str(recording),
        "--frames", str(options.growth if part == "growth" else options.frames), "--skip", str(options.skip),
        "--window", str(WINDOW), "--set", *options.set,
    ]  # fmt: skip
    paths = [str(checkout), str(checkout / "tests"), str(Path(__file__).parent)]
    done = subprocess.run(
        command, cwd=checkout, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"bench_host: {part} of {checkout} failed:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def generated_room(options: argparse.Namespace, size: tuple[int, int], frames: int) -> Path:
    """A recording of a generated room with noisy depth, made once and kept."""
    from ggslam.synthetic import write_synthetic_sequence

    room = options.keep.resolve() / f"host_{size[0]}x{size[1]}_{frames}"
    if not room.is_dir():
        write_synthetic_sequence(room, frames=frames, width=size[0], height=size[1], seed=0, noise=True)
    return room


def show(part: str, now: dict[str, Any], before: dict[str, Any] | None) -> None:
    """A table: a line for each figure, a column for each kind of frame; with --against before, now and ratio."""
    print(f"\n## {part}")
    kinds = list(now)
    print("| figure | " + " | ".join(f"{kind} ({now[kind]['frames']:.0f})" for kind in kinds) + " |")
    print("|---" * (len(kinds) + 1) + "|")
    names = [name for name in now[kinds[0]] if name != "frames"]
    for name in names:
        earlier = {} if before is None else {kind: figures.get(name) for kind, figures in before.items()}
        cells = [cell(now[kind].get(name), earlier.get(kind)) for kind in kinds]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def cell(now: float | None, before: float | None) -> str:
    """A figure, after the one before and with the ratio of both."""
    if now is None:
        return "-"
    text = f"{now:.2f}".rstrip("0").rstrip(".")
    if before is None:
        return text
    earlier = f"{before:.2f}".rstrip("0").rstrip(".")
    return f"{earlier} -> {text}" + (f" ({now / before:.2f})" if before else "")


def median_of_turns(turns: list[dict[str, Any]]) -> dict[str, Any]:
    """Of each figure of each kind."""
    def middle(values: list[float]) -> float:
        return sorted(values)[len(values) // 2]

    return {
        kind: {name: middle([turn[kind][name] for turn in turns if kind in turn]) for name in figures}
        for kind, figures in turns[0].items()
    }


def parse_arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS)
    parser.add_argument("--quick", action="store_true", help="small images, few frames; counts and time")
    parser.add_argument("--recording", type=Path, help="instead of a generated room")
    parser.add_argument("--size", nargs=2, type=int, default=(640, 480), help="of the generated room's images")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--skip", type=int, default=3, help="first frames that are not counted")
    parser.add_argument("--growth", type=int, default=200, help="keyframes of that part")
    parser.add_argument("--growth-size", nargs=2, type=int, default=(96, 72), help="of its images")
    parser.add_argument("--turns", type=int, help="runs of the part time; default: 3 with --against, else 1")
    parser.add_argument("--against", type=Path, help="another checkout, built, to compare with")
    parser.add_argument("--keep", type=Path, default=Path("build/recordings"), help="where generated rooms are kept")
    parser.add_argument("--set", nargs="*", default=[], action="extend", help="settings, name=value")
    parser.add_argument("--json", type=Path, help="also write all figures here")
    options = parser.parse_args(words)
    if options.quick:
        options.size, options.frames, options.growth = (160, 120), min(options.frames, 12), min(options.growth, 40)
    options.parts = options.parts or ["counts", "time"]
    options.turns = options.turns or (3 if options.against else 1)
    return options


def main() -> None:
    """Prints a table for each part."""
    options, outcomes = parse_arguments(), dict[str, Any]()
    for part in options.parts:
        growth = part == "growth"
        size, frames = (options.growth_size, options.growth) if growth else (options.size, options.frames)
        recording = options.recording.resolve() if options.recording else generated_room(options, tuple(size), frames)
        found: dict[str, list[dict[str, Any]]] = {"now": [], "before": []}
        for _ in range(options.turns if part == "time" else 1):
            if options.against is not None:
                found["before"].append(run_worker(options.against.resolve(), part, recording, options))
            found["now"].append(run_worker(HERE, part, recording, options))
        outcomes[part] = {which: median_of_turns(turns) for which, turns in found.items() if turns}
        show(part, outcomes[part]["now"], outcomes[part].get("before"))
        if options.json:
            options.json.write_text(json.dumps(outcomes, indent=1))


if __name__ == "__main__":
    main()
