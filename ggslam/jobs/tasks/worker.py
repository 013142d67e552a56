# SPDX-License-Identifier: Apache-2.0
"""`python -m ggslam.jobs.tasks.worker DESCRIPTOR PARENT`: does the work that comes through a pipe, until it is closed
or the parent is gone. A process begun like this, unlike a fork or a spawned one, needs nothing of the parent's."""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection

from ggslam.jobs.tasks.outcomes import outcome_of
from ggslam.system.child_processes import die_with


def main() -> None:
    """Work comes as a pair of function and argument; what it gives goes back."""
    die_with(int(sys.argv[2]))
    pipe: Connection = Connection(int(sys.argv[1]))
    while True:
        try:
            work, task = pipe.recv()
        except EOFError:
            return
        pipe.send(outcome_of(work, task))


if __name__ == "__main__":
    main()
