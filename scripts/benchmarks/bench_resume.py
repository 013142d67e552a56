#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Kills runs at random moments and goes on with them; says how many end as they would have ended, and what saving the
state costs.

    python scripts/benchmarks/bench_resume.py
    python scripts/benchmarks/bench_resume.py --kills 5 --overwrites 2 --recording data/redkitchen --stop 100

    resumed     a run of a generated room, killed (SIGKILL) at a moment drawn evenly over its length, resumed, compared
                with the run that nothing cut off: map, trajectory, keyframes, clouds, objects, votes, places
    overwrite   a run with --overwrite, killed at a moment drawn evenly over the time from the first file that it saves
                to the end, every second time between two files that change places, drawn evenly over the files; then
                what each command takes the folder for: the old run, the new one, or neither
    cost        time spent on checkpoints over the time of the same run, with the default --checkpoint-every

Each run is a process of its own (a fork, so that nothing is loaded twice).
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

from ggslam.errors import GgslamError
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.run.pipeline import RunRequest, execute, resume
from ggslam.runs import publishing
from ggslam.runs.checkpoints import has_checkpoints
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.verification import verify_run
from ggslam.synthetic import write_synthetic_sequence

SAME = ("map.ply", "trajectory.txt", "keyframes.json", "points.ply", "points_grid.ply", "objects.json",
        "classifier.npz", "votes.npz", "places.npz")  # fmt: skip
SMALL = ["mapping.iterations_per_frame=2", "mapping.first_frame_iterations=4", "refine_iterations=60"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--overwrites", type=int, default=20)
    parser.add_argument("--recording", type=Path, help="default: a generated room of 40 frames, 160x120")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--stop", type=int, default=None)
    parser.add_argument("--every", type=int, default=3, help="frames from one checkpoint to the next")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory(prefix="ggslam-resume-") as folder:
        place = Path(folder)
        recording = options.recording or generated_room(place / "room")
        reading = SequenceRequest(recording, scale=options.scale, stop=options.stop)
        if options.kills:
            kill_and_resume(place, reading, options.kills, options.every, rng)
        if options.overwrites:
            kill_while_overwriting(place, reading, options.overwrites, rng)
        report_cost(place, reading)


def generated_room(path: Path) -> Path:
    write_synthetic_sequence(path, frames=40, width=160, height=120, seed=0, noise=True)
    return path


def fork(work: Callable[[], object]) -> int:
    """Does work in another process; its number."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            work()
        code = 0
    except GgslamError as error:
        os.write(2, f"{error}\n".encode())
    finally:
        os._exit(code)


def wait(process: int) -> int:
    """Exit code of a process, negative: the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def sums(run: Path) -> dict[str, str]:
    """SHA-256 of the files that do not tell how long anything took."""
    return {name: hashlib.sha256((run / name).read_bytes()).hexdigest() for name in SAME if (run / name).is_file()}


def request(reading: SequenceRequest, out: Path, every: int | None, *more: str, overwrite: bool = False) -> RunRequest:
    return RunRequest(
        reading, out, overrides=[*SMALL, *more], evaluate=False, checkpoint_every=every, overwrite=overwrite
    )


# --- kill -9 at random moments ----------------------------------------------------------------------------------------


def kill_and_resume(place: Path, reading: SequenceRequest, kills: int, every: int, rng: random.Random) -> None:
    whole = place / "whole"
    begin = time.perf_counter()
    assert wait(fork(partial(execute, request(reading, whole, every)))) == 0
    length, expected = time.perf_counter() - begin, sums(whole)
    print(f"the run that nothing cuts off: {length:.1f} s, a checkpoint every {every} frames")
    found: Counter[str] = Counter()
    identical = done = 0
    while done < kills:
        out = place / "run"
        shutil.rmtree(out, ignore_errors=True)
        process = fork(partial(execute, request(reading, out, every)))
        time.sleep(rng.uniform(0, length))
        os.kill(process, signal.SIGKILL)
        if wait(process) == 0:
            continue  # it was done already
        done += 1
        if has_checkpoints(out):
            states = len(list((out / "checkpoints").glob("state-*")))
            found["with a checkpoint" if states else "before the first checkpoint"] += 1
            code = wait(fork(partial(resume, out)))
        else:  # nothing was begun yet, or everything was done
            saved = (out / "run.json").is_file()
            found["all was saved" if saved else "before anything was written"] += 1
            code = 0 if saved else wait(fork(partial(execute, request(reading, out, every, overwrite=True))))
        same = code == 0 and sums(out) == expected and verify_run(out).good
        identical += same
        if not same:
            differing = [name for name in SAME if sums(out).get(name) != expected.get(name)]
            print(f"kill {done}: exit code {code}; differing: {', '.join(differing)}")
        if done % 10 == 0:
            print(f"{done} kills, {identical} as if nothing had happened", flush=True)
    print(f"resumed: {identical} of {kills} end as if nothing had happened ({describe(found)})")


def describe(found: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in found.most_common())


# --- kill -9 while a run takes another one's place --------------------------------------------------------------------


def kill_while_overwriting(place: Path, reading: SequenceRequest, kills: int, rng: random.Random) -> None:
    old, new = place / "old", place / "new"
    for folder, seed in ((old, 1), (new, 2)):
        assert wait(fork(partial(execute, request(reading, folder, 0, f"seed={seed}")))) == 0
    expected = {name: sums(folder) for name, folder in (("old", old), ("new", new))}
    begin = time.perf_counter()
    saving_s = overwrite(place, reading, old, None)
    files = len(list(new.iterdir()))
    print(f"saving takes {saving_s:.2f} s of the {time.perf_counter() - begin:.1f} s of a run")
    found: Counter[str] = Counter()
    for number in range(kills):
        between = number % 2 == 1
        overwrite(place, reading, old, rng.uniform(0, saving_s), rng.randrange(files) if between else None)
        answer = place / "answer"
        wait(fork(partial(answer_for, place / "run", expected, answer)))
        found[f"{answer.read_text()}{' (between two files)' if between else ''}"] += 1
    mixed = sum(count for name, count in found.items() if "mixed" in name)
    print(f"overwrite: {mixed} of {kills} folders are mixed and accepted by a command ({describe(found)})")


def overwrite(
    place: Path, reading: SequenceRequest, old: Path, after_s: float | None, at_file: int | None = None
) -> float:
    """Writes a run over a copy of `old`, killed so long after the first file, or before the file of this number changes
    places; returns how long saving took."""
    out = place / "run"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(old, out)
    reads, writes = os.pipe()

    def run() -> None:
        real = publishing.publish_run

        def publish_run(*arguments: object) -> None:
            os.write(writes, b"x")
            real(*arguments)  # type: ignore[arg-type]

        import ggslam.runs.folder

        ggslam.runs.folder.publish_run = publish_run  # type: ignore[assignment]
        if at_file is not None:
            kill_before_file(at_file)
        execute(request(reading, out, 0, "seed=2", overwrite=True))

    process = fork(run)
    os.read(reads, 1)
    begin = time.perf_counter()
    if after_s is not None and at_file is None:
        time.sleep(after_s)
        os.kill(process, signal.SIGKILL)
    wait(process)
    for end in (reads, writes):
        os.close(end)
    return time.perf_counter() - begin


def kill_before_file(number: int) -> None:
    """Kills this process when so many files have left the folder that they were staged in."""
    real, moved = Path.replace, 0

    def replace(path: Path, target: Path) -> Path:
        nonlocal moved
        if path.parent.name.startswith(".staged-") and Path(target).parent != path.parent:
            if moved == number:
                os.kill(os.getpid(), signal.SIGKILL)
            moved += 1
        return real(path, target)

    Path.replace = replace  # type: ignore[method-assign,assignment]


def answer_for(run: Path, expected: dict[str, dict[str, str]], answer: Path) -> None:
    answer.write_text(taken_for(run, expected))


def taken_for(run: Path, expected: dict[str, dict[str, str]]) -> str:
    """Which run commands see in a folder."""
    seen = set()
    try:
        folder = RunFolder.open(run)
        export_run(folder, run.parent / "t.txt", "trajectory")
        with contextlib.suppress(OSError):
            (run.parent / "t.txt").unlink()
        folder.segmented_map()
        seen = {name for name, found in expected.items() if sums(run) == found}
        complete = folder.mark().complete and verify_run(run).good
    except GgslamError as error:
        return f"refused: {error}"
    if len(seen) != 1:
        return "mixed"
    return f"the {seen.pop()} run" + ("" if complete else ", marked incomplete")


# --- what it costs ----------------------------------------------------------------------------------------------------


def report_cost(place: Path, reading: SequenceRequest) -> None:
    out = place / "cost"
    assert wait(fork(partial(execute, RunRequest(reading, out, evaluate=False, overwrite=True)))) == 0
    timing = RunFolder.open(out).timing()
    share = timing.checkpoints_s / max(timing.wall_s + timing.refinement_s, 1e-9)
    took = f"{timing.checkpoints_s:.2f} s of {timing.wall_s:.1f} s"
    print(f"cost: {timing.checkpoints} checkpoints take {took}: {share:.2%}")


if __name__ == "__main__":
    main()
