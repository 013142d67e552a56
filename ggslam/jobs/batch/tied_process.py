# SPDX-License-Identifier: Apache-2.0
"""`python -m ggslam.jobs.batch.tied_process PARENT ...`: ggslam, killed by Linux when its parent dies, however that
happens. Another worker may go on with a run then, and no two may write it."""

from __future__ import annotations

import runpy
import sys

from ggslam.system.child_processes import die_with


def main() -> None:
    """Ties this process to its parent and becomes `ggslam`."""
    parent, arguments = int(sys.argv[1]), sys.argv[2:]
    die_with(parent)
    sys.argv = ["ggslam", *arguments]
    runpy.run_module("ggslam", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
