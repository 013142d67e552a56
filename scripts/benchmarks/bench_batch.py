# SPDX-License-Identifier: Apache-2.0
"""The same batch run by run, by the local engine and on a Ray cluster of this machine: what differs, and the time.

    python scripts/benchmarks/bench_batch.py
    python scripts/benchmarks/bench_batch.py --rooms 3 --frames 8
    python scripts/benchmarks/bench_batch.py --folder /tmp/batch --parts alone  # then local, then ray

Rooms are generated, each is run with every seed. On Ray, the process of one worker is killed in the middle of its run.
Every run is then compared with the one made alone, byte for byte: map, trajectory, keyframes' images, objects.
"""

from __future__ import annotations

import argparse
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from ggslam.jobs.batch.batch import run_batch
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import Manifest, read_manifest
from ggslam.jobs.tasks.processors import ProcessorTuning
from ggslam.synthetic import write_synthetic_sequence

COMPARED = ("map.ply", "trajectory.txt", "objects.json", "classifier.npz", "votes.npz", "points.ply", "frames.csv")
PARTS = ("alone", "local", "ray")


def write_rooms(folder: Path, rooms: int, frames: int, width: int, seeds: int) -> Path:
    """The recordings and the manifest."""
    names = [f"room{k:02d}" for k in range(rooms)]
    for k, name in enumerate(names):
        if not (folder / name).is_dir():
            write_synthetic_sequence(folder / name, frames=frames, width=width, height=width * 3 // 4, seed=k)
    (folder / "batch.yaml").write_text(f"recordings: {names}\nseeds: {list(range(seeds))}\n".replace("'", ""))
    return folder / "batch.yaml"


def run_alone(manifest: Manifest, out: Path) -> float:
    """Each run by itself, one after the other, those that are there left out; seconds."""
    start = time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": str(ProcessorTuning.per_worker), "OMP_WAIT_POLICY": "PASSIVE"}
    for job in manifest.jobs:
        if (out / job.name / "metrics.json").is_file():
            continue
        subprocess.run(
            [sys.executable, "-m", "ggslam", "run", *job.words, "--out", str(out / job.name)], env=environment,
            check=True, capture_output=True,
        )  # fmt: skip
    return time.perf_counter() - start


class Killer:
    """Kills the worker of the first run that is at work, once it has had time to begin."""

    def __init__(self, after_s: float) -> None:
        self.killed = ""
        self._after, self._seen = after_s, dict[str, float]()

    def look(self, states: Sequence[JobState]) -> None:
        """What a batch tells."""
        for state in states if not self.killed else ():
            seen = self._seen.setdefault(state.job.name, time.monotonic()) if state.state is State.RUNNING else None
            if seen is not None and time.monotonic() - seen > self._after:
                self._kill(state)
                return

    def _kill(self, state: JobState) -> None:
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                words = (folder / "cmdline").read_text().split("\0")
                if any("tied_process" in word for word in words) and str(state.run.absolute()) in words:
                    os.kill(int(words[words.index("ggslam.jobs.batch.tied_process") + 1]), signal.SIGKILL)
                    self.killed = state.job.name
                    return
            except (OSError, ValueError):  # it has ended
                continue


def differences(states: Sequence[JobState], alone: Path) -> list[str]:
    """Files of the runs that differ from those made alone."""
    return [
        f"{state.job.name}/{name}" for state in states for name in COMPARED
        if (state.run / name).read_bytes() != (alone / state.job.name / name).read_bytes()
    ]  # fmt: skip


@contextmanager
def two_workers() -> Iterator[str]:
    """A Ray cluster of this machine with room for two runs, whatever processors it has, in a process of its own; gives
    its address. Whoever joins it needs a token, which is made here and handed on by the environment."""
    os.environ.update(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))
    program = (
        f"import ray, sys; ray.init(num_cpus={2 * ProcessorTuning.per_worker}, include_dashboard=False, "
        "log_to_driver=False); "
        "print(ray.get_runtime_context().gcs_address, flush=True); sys.stdin.read(); ray.shutdown()"
    )
    words = [sys.executable, "-c", program]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as cluster:
        assert cluster.stdin is not None and cluster.stdout is not None
        try:
            yield cluster.stdout.readline().strip()
        finally:
            cluster.stdin.close()


def run_part(engine: str, path: Path, folder: Path) -> None:
    """One engine's batch, and its line of the table."""
    killer, jobs = Killer(after_s=3), read_manifest(path, folder / engine)
    with two_workers() if engine == "ray" else nullcontext() as address:
        start, more = time.perf_counter(), {} if address is None else {"engine": "ray", "address": address}
        outcome = run_batch(jobs, changed=killer.look if more else ignore, **more)
        seconds = time.perf_counter() - start
    done = sum(state.state in (State.DONE, State.SKIPPED) for state in outcome.states)
    said = differences(outcome.states, folder / "alone")
    killed = f", worker of {killer.killed} killed" if killer.killed else ""
    print(f"| {engine}{killed} | {seconds:.0f} | {done} of {len(outcome.states)} | {len(said)} |", flush=True)
    print("\n".join(said[:10]), end="\n" if said else "")
    rows = (folder / engine / "table.md").read_text().splitlines()
    counts = [sum(row.startswith(f"| {word}") for row in rows) for word in ("room", "mean")]
    print(f"table of {engine}: {counts[0]} recordings, {counts[1]} mean", flush=True)


def run_parts(given: argparse.Namespace, folder: Path) -> None:
    """The parts that were asked for."""
    path = write_rooms(folder, given.rooms, given.frames, given.width, given.seeds)
    print(f"{given.rooms} rooms x {given.seeds} seeds, {given.frames} frames; {os.cpu_count()} processors")
    print("| engine | s | done | differing files |\n|---|---|---|---|", flush=True)
    for part in given.parts:
        if part == "alone":
            print(f"| one by one | {run_alone(read_manifest(path), folder / 'alone'):.0f} | | |", flush=True)
        else:
            run_part(part, path, folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--folder", type=Path, help="for runs; kept, to be used again")
    parser.add_argument("--parts", nargs="+", default=[*PARTS], choices=PARTS)
    given = parser.parse_args()
    if given.folder is not None:
        given.folder.mkdir(parents=True, exist_ok=True)
        run_parts(given, given.folder)
        return
    with tempfile.TemporaryDirectory() as name:
        run_parts(given, Path(name))


def ignore(states: Sequence[JobState]) -> None:
    """Nobody is told."""


if __name__ == "__main__":
    main()
