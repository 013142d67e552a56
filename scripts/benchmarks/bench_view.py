#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What `ggslam run --view` costs: frames per second of a run without it, with it while nobody looks, and with it while
a page is open, by turns.

    python scripts/benchmarks/bench_view.py ../shared/data/redkitchen --rounds 3 --folder /tmp/view
    python scripts/benchmarks/bench_view.py ../shared/data/redkitchen --stop 30 --rounds 1 --folder /tmp/view

The page is a client that fetches everything and draws nothing, as a browser on another machine is to this one: a
browser that draws in software on the same processors takes these away from the run, whoever sends the splats. Prints
for each run frames/s (reading the recording included, scoring not), against the run without `--view` of the same
round, and how often and how much the client was sent while the run went on.
"""

from __future__ import annotations

import argparse
import signal
import socket
import statistics
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

from commands import ROOT

from ggslam.runs.records.timing import TimingRecord

KINDS = ("without --view", "nobody looks", "a page is open")


class Looker(threading.Thread):
    """A page at an address, with its token; counts what it is sent.

    Attributes:
        megabytes: received until `ended`.
        maps: how often the map was fetched.
    """

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._base, self._query = address.split("?")
        self.ended = threading.Event()
        self.megabytes, self.maps = 0.0, 0
        self.start()

    def run(self) -> None:
        try:
            with urlopen(f"{self._base}events?{self._query}", timeout=600) as events:
                for line in events:
                    if line.startswith(b"data:") and b"splats" in line and not self.ended.is_set():
                        for part in ("scene", "splats?chunk=map", "frame?number=0"):
                            self._fetch(part)
                        self.maps += 1
        except OSError:  # the server has ended
            pass

    def _fetch(self, part: str) -> None:
        separator = "&" if "?" in part else "?"
        with urlopen(f"{self._base}{part}{separator}{self._query}", timeout=60) as answer:
            self.megabytes += len(answer.read()) / 1e6


@dataclass(frozen=True)
class Result:
    """Of a run: frames/s, and what its client was sent."""

    frames_per_s: float
    maps: int = 0
    megabytes: float = 0.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def measured(kind: str, words: list[str], out: Path) -> Result:
    """One run in a process of its own; ends the program if it fails."""
    port, looker = free_port(), None
    viewed = [] if kind == KINDS[0] else ["--view", "--port", str(port)]
    command = [sys.executable, "-m", "ggslam", "run", *words, "--out", str(out), *viewed]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if "the map as it grows" in line and kind == KINDS[2]:
            looker = Looker(line.split()[-1] if "token=" in line else "")
        if "frames/s" in line and looker is not None:
            looker.ended.set()
        if "shows the run" in line:
            process.send_signal(signal.SIGINT)
    if process.wait():
        sys.exit(f"{' '.join(command)}\n{''.join(said)}")
    timing = TimingRecord.read(out)
    sent = (looker.maps, looker.megabytes) if looker is not None else (0, 0.0)
    return Result(timing.frames_per_s or 0.0, *sent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--folder", type=Path, required=True, help="for the runs")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scale", type=float, default=0.5, help="of the images")
    parser.add_argument("--stop", type=int, help="frames of the recording to use")
    arguments = parser.parse_args()
    words = [str(arguments.recording.resolve()), "--scale", str(arguments.scale), "--no-eval", "--overwrite"]
    words += [] if arguments.stop is None else ["--stop", str(arguments.stop)]
    ratios: dict[str, list[float]] = {kind: [] for kind in KINDS[1:]}
    print(f"{'round':>5}  {'run':<16}{'frames/s':>10}{'ratio':>8}{'maps sent':>11}{'MB':>8}", flush=True)
    for number in range(1, arguments.rounds + 1):
        reference = 0.0
        for kind in KINDS:
            found = measured(kind, words, arguments.folder.resolve() / kind.replace(" ", "_").strip("-"))
            reference = reference or found.frames_per_s
            ratio = found.frames_per_s / reference
            if kind in ratios:
                ratios[kind].append(ratio)
            print(f"{number:>5}  {kind:<16}{found.frames_per_s:>10.2f}{ratio:>8.3f}{found.maps:>11}"
                  f"{found.megabytes:>8.1f}", flush=True)  # fmt: skip
    for kind, values in ratios.items():
        print(f"{kind}: {statistics.median(values):.3f} of the frames/s without --view "
              f"(median of {len(values)}; {min(values):.3f} to {max(values):.3f})")  # fmt: skip


if __name__ == "__main__":
    main()
