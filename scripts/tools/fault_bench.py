# SPDX-License-Identifier: Apache-2.0
"""Where faults happen: commands in processes of their own, with limits, and what is left afterwards. A part of
fault_table.py."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ggslam.scene.frame import Frame
    from ggslam.slam.result import StepReport

MEMORY_BYTES = 4 << 30
"""Of address space that a command may take beyond what this process has."""
SECONDS = 120
FEW = ("--set", "mapping.iterations_per_frame=1", "--set", "mapping.first_frame_iterations=4", "--no-eval")

Hook = Callable[[int], object]


@dataclass
class Ended:
    """How a command ended.

    Attributes:
        code: exit code; minus the number of a signal.
        text: all that it printed.
    """

    code: int
    text: str

    @property
    def said(self) -> str:
        """The line that matters to a person: the error, else what a command doubts, else the last one that is no
        proposal of what to do next."""
        lines = [line.strip("│╭╰─╮╯ \t") for line in self.text.replace("\r", "\n").splitlines()]
        lines = [line for line in lines if line not in ("", "Error")]
        for words in (("error",), ("interrupted", "stopped"), ("wrong:",), ("warning", "doubtful:"), ("note",)):
            found = [line for line in lines if line.lower().startswith(tuple(word.lower() for word in words))]
            if found:
                return found[-1 if words[0] == "error" else 0]
        ends = (k for k, line in enumerate(lines) if line.startswith(("verdict:", "next:")))
        told = lines[: next(ends, len(lines))]
        return told[-1] if told else ""


@dataclass
class Row:
    """A line of the table."""

    fault: str
    said: str
    code: int
    kept: str
    problems: list[str] = field(default_factory=list)


UNTOUCHED = "existing files are untouched"
"""What is said to be kept if a fault changed nothing that was there."""


class Place:
    """A folder in which one fault happens.

    Args:
        folder: empty.
        recording: copied when it is asked for.
        run: finished; the same.
    """

    def __init__(self, folder: Path, recording: Path, run: Path) -> None:
        self.folder, self._recording, self._run = folder, recording, run
        self.out = folder / "out"
        self.ended: list[Ended] = []
        self.kept: list[str] = []
        self._before: dict[str, str] = {}

    def recording(self) -> Path:
        """A copy of the recording, to be damaged."""
        return Path(shutil.copytree(self._recording, self.folder / "recording"))

    def run(self) -> Path:
        """A copy of the run, to be damaged."""
        return Path(shutil.copytree(self._run, self.folder / "run"))

    def ggslam(self, *words: object, after: Hook | None = None, memory: int = MEMORY_BYTES) -> Ended:
        """Runs a command; `after(frame)` is called when a frame of a run is done. What the inputs were before the
        first command is remembered."""
        if not self.ended:
            self._before = sums(self.folder)
        self.ended.append(command([str(word) for word in words], self.folder, after, memory))
        return self.ended[-1]

    def map_recording(self, recording: Path, *more: object, after: Hook | None = None) -> Ended:
        """`ggslam run` in few iterations."""
        return self.ggslam("run", recording, "--out", self.out, *FEW, *more, after=after)

    def keep(self, text: str) -> None:
        """Notes what was kept, if it is not what `row` finds by itself."""
        self.kept.append(text)

    def row(self, fault: str) -> Row:
        """What became of it."""
        worst = next((ended for ended in self.ended if ended.code), self.ended[-1])
        problems = [text for ended in self.ended for text in troubles(ended)]
        kept = [*self.kept, *self._found()]
        if not kept:
            problems.append("nothing kept")
        said = next((ended.said for ended in (worst, self.ended[-1]) if ended.said), "")  # who is killed says nothing
        return Row(fault, said.replace(str(self.folder), "."), worst.code, "; ".join(kept), problems)

    def _found(self) -> list[str]:
        found = [what for what in (run_at(self.out), run_elsewhere(self.ended[-1].text, self.folder)) if what]
        after = sums(self.folder)
        if all(after.get(name) == digest for name, digest in self._before.items()):
            found.append(UNTOUCHED)
        return found


def sums(folder: Path) -> dict[str, str]:
    """SHA-256 of all regular files below a folder, by name; records of commands and what is on a small disk, which is
    gone afterwards, aside."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if "disk" in path.relative_to(folder).parts:
            continue
        if path.is_file() and not path.is_symlink() and not path.name.endswith((".said", ".lock")):
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def run_at(folder: Path) -> str:
    """What of a run is in a folder, in words; empty if nothing."""
    try:
        mark = json.loads((folder / "run.json").read_text())
        frames = sum(line[:1] != "#" for line in (folder / "trajectory.txt").read_text().splitlines())
        kind = "a complete" if mark.get("complete") else "an incomplete"
        return f"{kind} run of {frames} frame{'s' * (frames != 1)}"
    except (OSError, ValueError):
        states = list((folder / "checkpoints").glob("state-*.bin")) if folder.is_dir() else []
        return f"{len(states)} checkpoint{'s' * (len(states) != 1)} to resume from" if states else ""


def run_elsewhere(text: str, folder: Path) -> str:
    """A run that was saved to another folder than its own, as the message says."""
    words = " ".join(text.split())
    if "saved to " not in words or " instead" not in words:
        return ""
    other = Path(words.split("saved to ", 1)[1].split(" instead")[0].replace(" ", ""))
    return f"{run_at(other)} in the fallback folder" if run_at(other) else ""


def troubles(ended: Ended) -> list[str]:
    """What must not happen to a command."""
    found = []
    if "Traceback (most recent" in ended.text:
        found.append("traceback")
    if ended.code in (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS, -signal.SIGFPE, -signal.SIGILL):
        found.append(f"died of {signal.Signals(-ended.code).name}")
    if ended.code == -signal.SIGALRM:
        found.append(f"took more than {SECONDS} s")
    if any(ord(letter) < 32 and letter not in "\n\r\t" for letter in ended.text):
        found.append("control characters")
    return found


def command(words: list[str], folder: Path, after: Hook | None, memory: int) -> Ended:
    """A command in a process of its own. It is forked off this one, which has loaded everything but started nothing:
    to load PyTorch again for each would take most of the time."""
    said = folder / f"{time.monotonic_ns()}.said"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 70
        try:
            code = _in_child(words, said, after, memory)
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    text = said.read_text(errors="replace")
    said.unlink()
    return Ended(os.waitstatus_to_exitcode(status), text)


def _in_child(words: list[str], said: Path, after: Hook | None, memory: int) -> int:
    out = os.open(said, os.O_WRONLY | os.O_CREAT)
    for number in (1, 2):
        os.dup2(out, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # which nohup or a shell's background ignore
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    signal.alarm(SECONDS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from ggslam.cli.main import main

    if after is not None:
        _watch_frames(after)
    sys.argv = ["ggslam", *words]
    try:
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    return code


def _watch_frames(after: Hook) -> None:
    from ggslam.slam.slam import Slam

    real = Slam.step_together

    def step_together(slam: Slam, frames: Sequence[Frame]) -> list[StepReport]:
        reports = real(slam, frames)
        after(reports[-1].frame.frame_index)
        return reports

    Slam.step_together = step_together  # type: ignore[method-assign]
