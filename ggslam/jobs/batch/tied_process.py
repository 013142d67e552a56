# SPDX-License-Identifier: Apache-2.0
"""`python -m ggslam.jobs.batch.tied_process PARENT ...`: ggslam, killed by Linux when its parent dies, however that
happens. Another worker may go on with a run then, and no two may write it.

The process asks for that itself: a function between fork and exec is not safe in a parent with threads.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""


def main() -> None:
    """Ties this process to its parent and becomes `ggslam`."""
    parent, arguments = int(sys.argv[1]), sys.argv[2:]
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:  # it died in between
            sys.exit(1)
    sys.argv = ["ggslam", *arguments]
    runpy.run_module("ggslam", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
