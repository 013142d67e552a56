# SPDX-License-Identifier: Apache-2.0
"""Hidden folders for unfinished output. The next program that makes the same output deletes what killed ones left."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ggslam.system.child_processes import is_running
from ggslam.system.links import remove_folder


@contextmanager
def hidden_beside(target: Path) -> Iterator[Path]:
    """Gives the name of a hidden folder beside `target`, for the block; it may be made and moved there.

    Args:
        target: of a file or folder that is being made; its folder exists.

    Raises:
        RunFolderError: a link has the name of such a folder.
    """
    pattern = re.compile(rf"\.{re.escape(target.name)}-coming-(\d+)-[0-9a-f]{{8}}")
    for entry in target.parent.iterdir():
        if (match := pattern.fullmatch(entry.name)) and not is_running(int(match[1])):
            remove_folder(entry)
    hidden = target.with_name(f".{target.name}-coming-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        yield hidden
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
