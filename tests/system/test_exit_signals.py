# SPDX-License-Identifier: Apache-2.0
"""A signal to stop ends a program with 128 + its number, from its first moment to its last."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

PROGRAM = """
import atexit, os, signal, sys, threading, time
from ggslam.system.exit_signals import run_program

def send():
    print("sent", flush=True)
    os.kill(os.getpid(), {number})
    time.sleep(5)
    print("went on", flush=True)

def main():
    {main}

run_program(main)
"""
MOMENTS = {
    "while modules are loaded": "send()",
    "at exit": "atexit.register(send)",
    "while threads end": "threading.Thread(target=lambda: (time.sleep(0.3), send())).start()",
    "after an error": "atexit.register(send); sys.exit(2)",
}


def run(main: str, number: int = 15) -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(main=main, number=int(number))
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_signal_ends_it(moment: str, name: str) -> None:
    number = signal.Signals[name]
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip(f"whoever started the tests lets them ignore {name}")
    done = run(MOMENTS[moment], number)
    assert done.returncode == 128 + number and done.stdout == "sent\n"
    assert ("KeyboardInterrupt" in done.stderr) == (name == "SIGINT" and moment == "while modules are loaded")


def test_a_signal_that_is_ignored_stays_so() -> None:
    program = PROGRAM.format(main="atexit.register(send)", number=1).replace("5)", "0.2)")
    words = [sys.executable, "-c", f"import signal; signal.signal(1, signal.SIG_IGN)\n{program}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout == "sent\nwent on\n"


ENDS = {"pass": (0, ""), "sys.exit()": (0, ""), "sys.exit(3)": (3, ""), "sys.exit('words')": (1, "words\n"),
        "raise SystemExit(None)": (0, "")}  # fmt: skip


@pytest.mark.parametrize("main", ENDS)
def test_codes_are_those_of_python(main: str) -> None:
    done = run(main)
    assert (done.returncode, done.stderr) == ENDS[main]


def test_an_error_nobody_foresaw_shows_where_it_was() -> None:
    done = run("raise ValueError('odd')")
    assert done.returncode == 1 and done.stderr.endswith("ValueError: odd\n") and "Traceback" in done.stderr


def test_what_was_printed_is_written_and_what_was_registered_is_done() -> None:
    main = "sys.stdout.write('x' * 100_000); atexit.register(lambda: print('last'))"
    done = run(main)
    assert done.returncode == 0 and done.stdout == "x" * 100_000 + "last\n"


def test_output_that_cannot_be_written_is_no_success() -> None:
    program = PROGRAM.format(main="sys.stdout.write('x')", number=15)
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run([sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, timeout=60, env=env)
    assert done.returncode == 120
