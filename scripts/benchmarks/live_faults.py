# SPDX-License-Identifier: Apache-2.0
"""What a run takes while somebody who listens stands still, and whether it goes on when processes are killed, for
bench_live.py."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from live_runs import RATE, REALTIME, SERVED, LivePlace, Said, frames_sent, read_recorded

from ggslam.runs.folder import RunFolder

ALONE = "alone"
"""A run that is not published."""
UNHEARD = "unheard"
"""A run that is published over Zenoh while nobody listens: what publishing costs before anything is sent."""


def time_run(name: str, words: list[str], out: Path) -> tuple[float, float]:
    """User processor seconds and seconds of a run until its results are saved.

    Args:
        name: `ALONE`, `UNHEARD`, or the middleware over which it is published to somebody who is stopped when the first
            message has come.
        words: recording and options.
        out: folder of the run.
    """
    with LivePlace("zenoh" if name in (ALONE, UNHEARD) else name) as place:
        recorder = None if name in (ALONE, UNHEARD) else place.listen(out.with_suffix(".mcap"))
        more = [] if name == ALONE else ["--publish", "ros2"]
        began, run = time.monotonic(), place.run_recording(words[0], out, *words[1:], *more)
        if recorder is not None:
            recorder.wait_for("topic", 120)
            recorder.process.send_signal(signal.SIGSTOP)
        used = 0.0
        while run.process.poll() is None and not run.has_said(SERVED):
            used = max(used, _user_s(run))
            time.sleep(0.01)
        return used, time.monotonic() - began


def _user_s(run: Said) -> float:
    try:
        return run.user_s()
    except (OSError, IndexError):  # it has just ended
        return 0.0


def show_stalls(recording: Path, words: list[str], middlewares: list[str], turns: int, folder: Path) -> None:
    """By turns: alone, then published to somebody who stands still; prints the ratios."""
    folder.mkdir()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in (ALONE, UNHEARD, *middlewares)}
    for turn in range(turns):
        for name in times:
            times[name].append(time_run(name, [str(recording), *words], folder / f"{name}{turn}"))
    print(f"\n{recording.name} {' '.join(words)}: a subscriber that stands still, {turns} by turns")
    print(f"{'':16}{'user s':>10}{'wall s':>10}{'user ratio, median (all)':>36}{'wall ratio, median (all)':>36}")
    for name, found in times.items():
        cells = [f"{median(one[k] for one in found):10.1f}" for k in (0, 1)]
        for k in (0, 1):
            ratios = [one[k] / base[k] for one, base in zip(found, times[ALONE], strict=True)]
            text = f"{median(ratios):.3f} ({', '.join(f'{ratio:.3f}' for ratio in ratios)})"
            cells.append(f"{text if name != ALONE else '':>36}")
        print(f"{name:16}" + "".join(cells), flush=True)
    print(
        "`unheard`: published over Zenoh while nobody listens. Of a short run, what publishing imports and what it\n"
        "does when the run has ended are a larger share. User time, too, grows when others use the processors."
    )


@dataclass
class Killed:
    """A run whose player, then whose subscriber was killed and started again.

    Attributes:
        frames: that the second player sent.
        taken: of these by the run, at the least: frames taken later than it began to send.
        topics: that the second subscriber was told something on.
        trees: of frames that it was told.
        status: of the run.
    """

    frames: int
    taken: int
    topics: int
    trees: int
    status: int


def kill_by_turns(middleware: str, recording: Path, seconds: float, folder: Path) -> Killed:
    """Kills the player and starts it anew, then the subscriber; each goes on for some seconds."""
    folder.mkdir()
    out, told = folder / "run", folder / "second.mcap"
    with LivePlace(middleware) as place:
        first = place.listen(folder / "first.mcap")
        run = place.run(out, *REALTIME, "--refine", "10", "--publish", "ros2", idle_s=60.0)
        player = place.play(recording, "--fps", str(RATE), "--loop")
        first.wait_for("topic /tf", 60)
        time.sleep(seconds)
        player.kill()
        player = place.play(recording, "--fps", str(RATE), "--loop")
        player.wait_for("publishing", 60)
        again = time.time()
        time.sleep(seconds)
        first.kill()
        second = place.listen(told)
        second.wait_for("topic /tf", 60)
        time.sleep(seconds)
        player.interrupt(20)
        run.process.send_signal(signal.SIGINT)  # while it waits for more frames: it ends as if there were no more
        run.wait_for(SERVED, 300)
        status = run.interrupt(60)
        second.finish(60)
    topics = [topic for topic, *_ in read_recorded(told)]
    taken = int((RunFolder.open(out).trajectory().timestamps > again).sum())
    return Killed(frames_sent(player), taken, len(set(topics)), topics.count("/tf"), status)


def show_kills(middlewares: list[str], recording: Path, seconds: float, folder: Path) -> None:
    """Prints what came after each start."""
    folder.mkdir()
    print("\nkill -9 of the player and a new one, then of the subscriber and a new one")
    print(f"{'':16}{'new player sent':>18}{'run located':>18}{'new listener: topics':>24}{'trees':>8}{'run ended':>12}")
    for name in middlewares:
        k = kill_by_turns(name, recording, seconds, folder / name)
        print(f"{name:16}{k.frames:18}{k.taken:18}{k.topics:24}{k.trees:8}{k.status:12}", flush=True)
