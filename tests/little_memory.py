# SPDX-License-Identifier: Apache-2.0
"""Code in a process of its own with little memory: what it raises, and how much it took."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

_CODE = """
import json, resource, sys
from pathlib import Path
from ggslam.system.process_memory import peak_memory_bytes
{before}
path = Path(sys.argv[1])
taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + {room}, taken + {room}))
before, ended = peak_memory_bytes(), ["nothing", "", 0]
try:
    {code}
except Exception as error:
    ended = [type(error).__name__, str(error), getattr(error, "exit_code", None)]
print(json.dumps([*ended, peak_memory_bytes() - before]))
"""


@dataclass(frozen=True)
class Ended:
    """What became of it.

    Attributes:
        kind: class of the error; "nothing": there was none.
        message: of the error.
        exit_code: of the error; 0: there was none.
        taken: bytes that the peak of memory grew by.
    """

    kind: str
    message: str
    exit_code: int | None
    taken: int


def with_little_memory(before: str, code: str, path: Path, room: int) -> Ended:
    """Runs `before`, and then `code`, which knows `path`, with so many bytes of address space beyond what is in use."""
    script = _CODE.format(before=before, code=code, room=room)
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return Ended(*json.loads(done.stdout.splitlines()[-1]))
