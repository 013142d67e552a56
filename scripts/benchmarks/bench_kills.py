# SPDX-License-Identifier: Apache-2.0
"""Commands that are killed (-9) at moments of their own and given again: do they end with what they would have made?

    python scripts/benchmarks/bench_kills.py                         # 5 kills of each command
    python scripts/benchmarks/bench_kills.py --kills 20 --only refine,batch --seed 3

Each time a command begins in a fresh copy of its inputs, is killed, and is given again. A row is bad if the second time
does not end with 0, what is there then differs from what an undisturbed command makes (files that tell times aside),
something hidden is left over, or an input has changed; then the exit code is 1.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

FEW = ("--set", "mapping.iterations_per_frame=1", "--set", "mapping.first_frame_iterations=4")
TIMED = {
    "run.json", "timing.json", "steps.csv", "report.html", "verdict.json", "metrics.json", "loops.json",
    "sequence.json", "job.json", "log.txt", "table.csv", "table.md", "table.tex", "table.html", "frames.csv",
    "volumes.json",
}  # fmt: skip
"""Files that hold times, or paths of the workspace."""


@dataclass(frozen=True)
class Case:
    """A command.

    Attributes:
        words: of it; paths are relative to the workspace.
        makes: what it makes or changes there.
        inputs: what must not change.
        again: how it is given after a kill; empty: the same.
    """

    words: tuple[str, ...]
    makes: str
    inputs: tuple[str, ...]
    again: tuple[str, ...] = ()


MANIFEST = f"recordings: [room]\nsettings: {{a: --stop 6, b: --stop 8}}\nseeds: [0, 1]\noptions: {' '.join(FEW)}\n"
CASES = {
    "run": Case(("run", "room", "--out", "made", "--no-eval", "--checkpoint-every", "2", *FEW), "made", ("room",),
                ("run", "--resume", "made")),
    "refine run": Case(("refine", "run", "--out", "made", "--steps", "30"), "made", ("run", "room")),
    "refine store": Case(("refine", "store", "--out", "made", "--steps", "6", "--workers", "2"), "made",
                         ("store", "room")),
    "refine store in place": Case(("refine", "store", "--steps", "6", "--workers", "1"), "store", ("room", "run")),
    "batch": Case(("batch", "batch.yaml", "--out", "made", "--workers", "2"), "made", ("room",)),
    "decode run": Case(("decode", "run.ggz", "made"), "made", ("run.ggz",)),
    "decode store": Case(("decode", "cells.ggc", "made"), "made", ("cells.ggc",)),
    "encode run": Case(("encode", "run", "made.ggz"), "made.ggz", ("run",)),
    "encode store": Case(("encode", "store", "made.ggc"), "made.ggc", ("store",)),
    "edit with inpaint": Case(("edit", "run", "--remove", "1", "--inpaint", "--out", "made"), "made", ("run", "room")),
    "edit in place": Case(("edit", "run", "--remove", "1", "--inpaint", "--in-place"), "run", ("room",)),
    "submaps": Case(("submaps", "run", "--out", "made"), "made", ("run", "room")),
    "volumes": Case(("volumes", "run", "--out", "made"), "made", ("run", "room")),
}  # fmt: skip


def ggslam(words: tuple[str, ...], place: Path) -> subprocess.Popen[bytes]:
    """A command in a session of its own."""
    log = (place / "log.txt").open("ab")
    return subprocess.Popen([sys.executable, "-m", "ggslam", *words], cwd=place, stdout=log, stderr=log,
                            stdin=subprocess.DEVNULL, start_new_session=True)  # fmt: skip


def make_inputs(place: Path) -> None:
    """A small recording, runs, a store and coded files."""
    place.mkdir()
    (place / "batch.yaml").write_text(MANIFEST)
    for words in (
        ("synth", "room", "--frames", "14", "--width", "96", "--height", "72"),
        ("run", "room", "--out", "run", "--no-eval", *FEW),
        ("submaps", "run", "--out", "store"), ("encode", "run", "run.ggz"), ("encode", "store", "cells.ggc"),
    ):  # fmt: skip
        if ggslam(words, place).wait():
            raise SystemExit(f"{' '.join(words)}: {(place / 'log.txt').read_text()}")
    (place / "log.txt").unlink()


def digest(path: Path) -> dict[str, str]:
    """What is there, by name; of a store the parts of its cells, whatever their versions."""
    from ggslam.submaps.grid import GridStore

    if (path / "index.sqlite").is_file():
        with GridStore.open(path) as store:
            parts = [(key, name) for key in store.cells() for name in store.cell(key).parts]
            return {f"{key} {name}": _sum(store.get(key, name)) for key, name in parts}
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    return {str(f.relative_to(path)): _sum(f.read_bytes()) for f in files if f.is_file() and f.name not in TIMED}


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def hidden(place: Path) -> list[str]:
    """Left-overs."""
    known = (".lock", ".writer")
    return [str(p.relative_to(place)) for p in place.rglob(".*") if not p.name.startswith(known)]


def kill_once(case: Case, inputs: Path, place: Path, after: float, whole: dict[str, str]) -> list[str]:
    """What is wrong after a kill and a second time."""
    shutil.copytree(inputs, place, symlinks=True)
    before = {name: digest(place / name) for name in case.inputs}
    process = ggslam(case.words, place)
    time.sleep(after)
    done = process.poll() is not None
    if not done:
        process.kill()  # its workers have to notice by themselves
    process.wait()
    problems = []
    if not done:
        resumes = bool(case.again) and (place / case.makes / "checkpoints" / "start.json").is_file()
        words = case.again if resumes else case.words
        if words == case.words and "--out" in words and (place / case.makes / "run.json").is_file():
            words = (*words, "--overwrite")
        code = ggslam(words, place).wait()
        if code:
            text = (place / "log.txt").read_text(errors="replace").strip().splitlines()
            problems.append(f"exit {code}: {text[-1][:150] if text else ''}")
    found = digest(place / case.makes) if (place / case.makes).exists() else {}
    differing = sorted(name for name in {*whole, *found} if whole.get(name) != found.get(name))
    problems += [f"differs: {', '.join(differing[:4])}"] if differing else []
    problems += [f"input changed: {name}" for name in case.inputs if digest(place / name) != before[name]]
    problems += [f"left over: {', '.join(names[:3])}"] if (names := hidden(place)) else []
    if "Traceback" in (place / "log.txt").read_text(errors="replace"):
        problems.append("a traceback")
    return problems


def undisturbed(case: Case, inputs: Path, place: Path) -> tuple[float, dict[str, str]]:
    """Seconds that a command takes, and what it makes."""
    shutil.copytree(inputs, place, symlinks=True)
    begin = time.monotonic()
    if ggslam(case.words, place).wait():
        raise SystemExit(f"{' '.join(case.words)}: {(place / 'log.txt').read_text()}")
    return time.monotonic() - begin, digest(place / case.makes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=5, help="of each command")
    parser.add_argument("--only", default="", help="words in names of commands, commas between")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng, bad = random.Random(given.seed), 0
    names = [name for name in CASES if not given.only or any(word in name for word in given.only.split(","))]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        make_inputs(root / "inputs")
        print(f"{'command':24s} {'seconds':>8s} {'kills':>6s} {'bad':>5s}")
        for name in names:
            case = CASES[name]
            seconds, whole = undisturbed(case, root / "inputs", root / "whole")
            shutil.rmtree(root / "whole")
            problems = []
            for _ in range(given.kills):
                after = seconds * rng.uniform(0.2, 1.02)
                found = kill_once(case, root / "inputs", root / "work", after, whole)
                shutil.rmtree(root / "work")
                problems += [f"    after {after:.2f} s: {'; '.join(found)}"] if found else []
            print("\n".join([f"{name:24s} {seconds:8.1f} {given.kills:6d} {len(problems):5d}", *problems]), flush=True)
            bad += len(problems)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
