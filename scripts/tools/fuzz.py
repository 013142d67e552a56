# SPDX-License-Identifier: Apache-2.0
"""Damaged and hostile files for every parser: `python scripts/tools/fuzz.py --inputs 100000`.

Small good files of every format are made, changed at random (bytes, numbers, lines, lengths, whole pieces; checksums of
PNG and zip repaired, so that what lies behind them is reached) and read, in processes with 2 GB of address space and
10 s for each input. Good ends are: it was read, or a GgslamError. Everything else is printed and the input kept.

    python scripts/tools/fuzz.py --inputs 2000 --only ply,png --seed 7
    python scripts/tools/fuzz.py --replay findings/ply-00012 --only ply
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
sys.path[:0] = [str(Path(__file__).parents[2] / "tests" / "sequences"), str(Path(__file__).parents[2] / "tests")]

from fuzz_targets import TARGETS, Target, make_corpus  # noqa: E402

MEMORY_BYTES = 2 << 30
SECONDS = 10
BATCH = 200
NUMBERS = [b"0", b"-1", b"1e999", b"nan", b"99999999999999999999", b"1e-320", b"0x7fffffff", b"-0", b"1.5",
           b"2147483648", b""]  # fmt: skip
WORDS = [b"../../../etc/passwd", b"\x1b[2J", b"\xff\xfe", b"null", b"[]", b"{}", b"true", b'"', b"*a",
         b"!!python/name:os.system", b"2024-01-01", b"1+2j", b"\x00"]  # fmt: skip
INTEGERS = [0, 1, -1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 1 << 24]
FLOATS = [float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e-44, 0.0, -1.0, 1e9]
VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 2, 255, 65536, 2**31 - 1, -(2**31), 2**32, 2**63 - 1, -(2**63), 2**63, 10**30, 0.5,
    -0.0, 1e300, -1e300, 1e-320, float("nan"), float("inf"), "", "x", "=1", "../x", "\x00", "\ud800", "x" * 3000, "0",
    "nan", [], {}, [[]], [0], [None], {"a": 0}, {"": None}, [1e300] * 3, [0] * 500,
]  # fmt: skip


@dataclass
class Tally:
    """What became of a target's inputs."""

    inputs: int = 0
    read: int = 0
    refused: int = 0
    findings: Counter[str] = field(default_factory=Counter)
    longest_s: float = 0.0


def change(data: bytes, rng: random.Random) -> bytes:
    """A damaged copy."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        if not out:
            return bytes(out)
        at = rng.randrange(len(out))
        kind = rng.randrange(11)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.randrange(256)
        elif kind == 2:
            del out[at:]
        elif kind == 3:
            del out[at : at + rng.randrange(1, 64)]
        elif kind == 4:
            out[at:at] = out[at : at + rng.randrange(1, 256)] * rng.choice((1, 2, 50))
        elif kind == 5:
            code = rng.choice(("<I", ">I", "<H", ">H", "<Q"))
            value = struct.pack(code, rng.choice(INTEGERS) & ((1 << (8 * struct.calcsize(code))) - 1))
            out[at : at + len(value)] = value
        elif kind == 6:
            replace_number(out, rng)
        elif kind == 7:
            out[at:at] = rng.choice(WORDS)
        elif kind == 8:
            lines = bytes(out).splitlines(keepends=True)
            chosen = lines.pop(rng.randrange(len(lines)))
            lines[at % (len(lines) + 1) : 0] = [chosen] * rng.choice((0, 1, 2))
            out = bytearray(b"".join(lines))
        elif kind == 9:
            out[at : at + 8] = struct.pack("<d", rng.choice((float("nan"), float("inf"), 1e300, -1e-300, 0.0)))
        else:
            out[at:at] = rng.choice((b"[" * 5000, b"(" * 5000, b"<a>" * 500, b"9" * 5000))
    return bytes(out)


def replace_number(out: bytearray, rng: random.Random) -> None:
    """Puts a strange number in the place of one in a text."""
    starts = [i for i, c in enumerate(out[:65536]) if 48 <= c <= 57 and (i == 0 or not 48 <= out[i - 1] <= 57)]
    if starts:
        at = end = rng.choice(starts)
        while end < len(out) and out[end] in b"0123456789.eE+-":
            end += 1
        out[at:end] = rng.choice(NUMBERS)


def change_inside(data: bytes, rng: random.Random) -> bytes:
    """Changes what lies behind the checksums of a PNG or zip file; others as they are."""
    if data.startswith(b"\x89PNG"):
        return change_png(data, rng)
    if data.startswith(b"PK"):
        return change_zip(data, rng)
    if data.startswith(b"ggstate1"):
        return change_state(data, rng)
    if data[:1] in (b"{", b"["):
        return change_json(data, rng)
    return change(data, rng)


def change_png(data: bytes, rng: random.Random) -> bytes:
    at, chunks = 8, []
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + length]])
        at += 12 + length
    chosen = rng.choice(chunks)
    chosen[1] = change(chosen[1], rng)
    parts = (struct.pack(">I", len(b)) + kind + b + struct.pack(">I", zlib.crc32(kind + b)) for kind, b in chunks)
    return data[:8] + b"".join(parts)


def change_json(data: bytes, rng: random.Random) -> bytes:
    """Puts strange values in the place of some, or takes away, doubles or exchanges them; it stays JSON."""
    try:
        return json.dumps(change_tree(json.loads(data), rng)).encode()
    except (ValueError, RecursionError, OverflowError, TypeError):  # no JSON, or sums of what cannot be summed
        return change(data, rng)


def change_tree(tree: Any, rng: random.Random) -> Any:
    """A tree of JSON with some values changed."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = list(places_in(tree))
        if not places:
            return tree
        holder, key = rng.choice(places)
        other, place = rng.choice(places)
        action = rng.randrange(8)
        if action == 0:
            del holder[key]
        elif action == 1 and isinstance(holder, list):
            holder[:] = holder * rng.choice((2, 3))
        elif action == 2:
            holder[key] = json.loads(json.dumps(other[place]))
        elif action == 3 and isinstance(holder[key], (int, float)):
            holder[key] = holder[key] * rng.choice((-1, 2, 1000, 0.5)) + rng.choice((0, 1, -1))
        else:
            holder[key] = rng.choice(VALUES)
    return tree


def places_in(tree: Any) -> Iterator[tuple[Any, Any]]:
    """(list or map, index or key) of every value."""
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(inside):
        yield tree, key
        yield from places_in(value)


def change_state(data: bytes, rng: random.Random) -> bytes:
    """An array file (`system.array_file`) with changed values or arrays; who reads it repairs its sum."""
    length = struct.unpack("<Q", data[8:16])[0]
    head, arrays = data[16 : 16 + length], bytearray(data[16 + length :])
    if rng.random() < 0.6 or len(arrays) < 16:
        head = change_json(head, rng)
        return data[:8] + struct.pack("<Q", len(head)) + head + bytes(arrays)
    for _ in range(rng.choice((1, 4, 64))):
        at = rng.randrange(0, len(arrays) - 11) & ~3
        code = rng.choice(("<f", "<i", "<d", "<q"))
        whole = (0, -1, 1, 1 << 20, (1 << 31) - 1, -(1 << 31))
        value = rng.choice(FLOATS if code in ("<f", "<d") else whole)
        arrays[at : at + struct.calcsize(code)] = struct.pack(code, value)
    return data[: 16 + length] + bytes(arrays)


def change_zip(data: bytes, rng: random.Random) -> bytes:
    import io

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", rng.choice((0, 8))) as new:
        names = old.namelist()
        chosen = rng.choice(names)
        for name in names:
            content = old.read(name)
            new.writestr(name, change(content, rng) if name == chosen else content)
    return out.getvalue()


def damaged_copy(seed: Path, place: Path, rng: random.Random) -> Path:
    """A changed copy of a file or, of a folder, with one file changed; under `place`."""
    copy = place / seed.name
    if seed.is_dir():
        shutil.copytree(seed, copy)
        victim = rng.choice(sorted(path for path in copy.rglob("*") if path.is_file()))
    else:
        victim = Path(shutil.copyfile(seed, copy))
    action = rng.randrange(30)
    if action == 0 and seed.is_dir():
        victim.unlink()
    elif action == 1 and seed.is_dir():
        victim.unlink()
        os.mkfifo(victim)
    else:
        data = victim.read_bytes()
        victim.write_bytes((change if rng.random() < 0.5 else change_inside)(data, rng))
    return copy


def run_batch(target: Target, seeds: list[Path], numbers: range, seed: int, place: Path, send: Any) -> None:
    """Reads a batch of inputs in this process; says before each which it is, and after it how it ended."""
    from ggslam.errors import GgslamError

    def too_long(signum: int, frame: Any) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    signal.signal(signal.SIGALRM, too_long)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in numbers:
        rng = random.Random(f"{seed}/{target.name}/{number}")
        folder = place / f"{target.name}-{number:06d}"
        folder.mkdir()
        path = damaged_copy(rng.choice(seeds), folder, rng)
        send.send(("begin", number, ""))
        begin, said = time.monotonic(), "read"
        signal.alarm(SECONDS)
        try:
            target.read(path)
        except GgslamError:
            said = "refused"
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            ours = [f for f in traceback.extract_tb(error.__traceback__) if "/ggslam/" in f.filename]
            where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else f"{last.filename}:{last.lineno}"
            said = f"{type(error).__name__} at {where}: {str(error)[:80]!r}"
        finally:
            signal.alarm(0)
        send.send(("end", number, (said, time.monotonic() - begin)))
        if said in ("read", "refused"):
            shutil.rmtree(folder, ignore_errors=True)
    send.send(("done", -1, ""))


def fuzz(target: Target, seeds: list[Path], inputs: int, seed: int, place: Path, findings: Path) -> Tally:
    """Reads that many inputs of a target, in processes that may die."""
    tally, at = Tally(), 0
    fork = multiprocessing.get_context("fork")
    while at < inputs:
        receive, send = fork.Pipe(False)
        batch = range(at, min(at + BATCH, inputs))
        worker = fork.Process(target=run_batch, args=(target, seeds, batch, seed, place, send))
        worker.start()
        send.close()
        running = None
        while True:
            try:
                kind, number, rest = receive.recv() if receive.poll(SECONDS + 20) else ("stuck", running, "")
            except EOFError:
                kind, number, rest = "died", running, ""
            if kind == "begin":
                running = number
                continue
            if kind == "done":
                at = batch.stop
                break
            tally.inputs += 1
            at = (running if number is None else number) + 1 if running is not None else batch.stop
            if kind == "end":
                said, seconds = rest
                tally.longest_s = max(tally.longest_s, seconds)
                tally.read += said == "read"
                tally.refused += said == "refused"
                if said in ("read", "refused"):
                    continue
            else:
                worker.kill() if kind == "stuck" else worker.join()
                said = "hang" if kind == "stuck" else f"crash, exit code {worker.exitcode}"
            keep(said, tally, place / f"{target.name}-{number or 0:06d}", findings)
            if kind != "end":
                break
        worker.join()
    return tally


def keep(said: str, tally: Tally, folder: Path, findings: Path) -> None:
    """Counts a finding; the first input of each kind is kept."""
    if not tally.findings[said]:
        if folder.exists():
            findings.mkdir(parents=True, exist_ok=True)
            shutil.move(folder, findings / folder.name)
        print(f"    {folder.name}: {said}", flush=True)
    tally.findings[said] += 1
    shutil.rmtree(folder, ignore_errors=True)


def replay(path: Path, targets: list[Target]) -> None:
    """Reads one kept input without limits; errors end with a traceback."""
    for target in targets:
        print(target.name, target.read(next(path.iterdir()) if path.is_dir() else path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10000, help="over all targets, shared out by their weights")
    parser.add_argument("--only", default="", help="names of targets, commas between")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--findings", type=Path, default=Path("findings"), help="inputs that found something")
    parser.add_argument("--replay", type=Path, help="reads this input again")
    given = parser.parse_args()
    chosen = [t for t in TARGETS if not given.only or t.name in given.only.split(",")]
    if given.replay:
        replay(given.replay, chosen)
        return
    with tempfile.TemporaryDirectory() as folder:
        corpus = make_corpus(Path(folder) / "corpus", chosen)
        total, begin = Tally(), time.monotonic()
        weights = sum(target.weight for target in chosen)
        print(f"{'target':22s} {'inputs':>7s} {'read':>7s} {'refused':>8s} {'other':>6s} {'longest':>8s}")
        for target in chosen:
            place = Path(folder) / "inputs"
            place.mkdir(exist_ok=True)
            count = -(-given.inputs * target.weight // weights)
            tally = fuzz(target, corpus[target.name], count, given.seed, place, given.findings)
            other = sum(tally.findings.values())
            print(f"{target.name:22s} {tally.inputs:7d} {tally.read:7d} {tally.refused:8d} {other:6d} "
                  f"{tally.longest_s:6.2f} s", flush=True)  # fmt: skip
            total.inputs += tally.inputs
            total.read += tally.read
            total.refused += tally.refused
            total.findings += tally.findings
        print(f"{total.inputs} inputs in {time.monotonic() - begin:.0f} s: {total.read} read, {total.refused} refused, "
              f"{sum(total.findings.values())} other")  # fmt: skip
    sys.exit(1 if total.findings else 0)


if __name__ == "__main__":
    main()
