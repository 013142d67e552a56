# SPDX-License-Identifier: Apache-2.0
"""A player, a run and somebody who listens, in processes of their own on 127.0.0.1."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
RECORDER = ROOT / "tests" / "messages" / "topic_recorder.py"
SERVED = "published (Ctrl-C ends)"
"""What a run says when it is done and stays."""


class Said:
    """A process whose lines are kept.

    Attributes:
        lines: so far.
    """

    def __init__(self, command: list[str]) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "300", "PYTHONFAULTHANDLER": "1"}
        environment.pop("CYCLONEDDS_URI", None)
        self.process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def wait_for(self, text: str, seconds: float) -> str:
        """The first line with a text in it. Raises TimeoutError if none comes in time."""
        end = time.monotonic() + seconds
        while True:
            over = not self._reader.is_alive() or time.monotonic() > end
            for line in list(self.lines):
                if text in line:
                    return line
            if over:
                raise TimeoutError(f"{text!r} was not said:\n" + "\n".join(self.lines[-20:]))
            time.sleep(0.01)

    def has_said(self, text: str) -> bool:
        return any(text in line for line in list(self.lines))

    def user_s(self) -> float:
        """Processor seconds so far in user mode, of all threads."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) / os.sysconf("SC_CLK_TCK")

    def interrupt(self, seconds: float) -> int:
        """As Ctrl-C does; returns the exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.wait(seconds)

    def finish(self, seconds: float) -> int:
        """Ends its input; returns the exit status."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        return self.wait(seconds)

    def wait(self, seconds: float) -> int:
        try:
            status = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)  # it tells what its threads are at
            self._reader.join(5)
            raise TimeoutError(f"did not end in {seconds:g} s:\n" + "\n".join(self.lines[-80:])) from None
        self._reader.join(5)
        return status

    def kill(self) -> None:
        """As kill -9 does."""
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait(10)


@dataclass
class LivePlace:
    """A network of its own for processes: of Zenoh by free ports, of DDS by a domain. Leaving the block kills what
    still runs.

    Attributes:
        middleware: zenoh or dds.
    """

    middleware: str
    started: list[Said] = field(default_factory=list)
    ports: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        with socket.socket() as one, socket.socket() as other:
            for made in (one, other):
                made.bind(("127.0.0.1", 0))
                self.ports.append(made.getsockname()[1])

    @property
    def domain(self) -> int:
        return 100 + self.ports[0] % 100 if self.middleware == "dds" else 0

    def __enter__(self) -> LivePlace:
        return self

    def __exit__(self, *_: object) -> None:
        for one in self.started:
            one.kill()

    def _address(self, number: int, listens: bool = False) -> str:
        if self.middleware == "dds":
            return "127.0.0.1"
        return f"{'listen:' if listens else ''}tcp/127.0.0.1:{self.ports[number]}"

    def _network(self, number: int, listens: bool = False) -> list[str]:
        return ["--middleware", self.middleware, "--domain", str(self.domain), "--address",
                self._address(number, listens)]  # fmt: skip

    def _start(self, *words: str) -> Said:
        self.started.append(Said([sys.executable, *words]))
        return self.started[-1]

    def play(self, recording: Path, *words: str) -> Said:
        """`ggslam play`."""
        return self._start("-m", "ggslam", "play", str(recording), *self._network(0), *words)

    def run(self, out: Path, *words: str, idle_s: float = 4.0) -> Said:
        """`ggslam run` of what is played."""
        query = f"wait=60&idle={idle_s:g}&address={self._address(0, True)}"
        return self.run_recording(f"ros2://camera/color,camera/depth?{query}", out, *words)

    def run_recording(self, recording: str | Path, out: Path, *words: str) -> Said:
        """`ggslam run`."""
        return self._start("-m", "ggslam", "run", str(recording), "--out", str(out), *self._network(1), *words)

    def listen(self, path: Path) -> Said:
        """Somebody who keeps all that is published in a file, and is ready. Runs connect to it: a run that begins later
        has it from its first frame on, where it would look for the run every few seconds only."""
        domain = str(self.domain)
        recorder = self._start(str(RECORDER), self.middleware, self._address(1, True), domain, str(path))
        recorder.wait_for("ready", 60)
        return recorder


def wait_until(happened: Callable[[], object], seconds: float, what: str) -> None:
    """Raises TimeoutError if something does not happen in time."""
    end = time.monotonic() + seconds
    while not happened():
        if time.monotonic() > end:
            raise TimeoutError(what)
        time.sleep(0.02)
