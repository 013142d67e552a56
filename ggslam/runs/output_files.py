# SPDX-License-Identifier: Apache-2.0
"""Which places belong to a run or a recording, where a command must not put a file of its own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ggslam.runs.folder import MARKER


def lies_among(path: Path, sources: Iterable[Path]) -> bool:
    """Whether a file is, or would be, one of a run's folder.

    Args:
        path: of the file, there or not.
        sources: folders of recordings and runs, of which everything below counts, too.
    """
    real = path.resolve()
    return (real.parent / MARKER).is_file() or any(source.resolve() in real.parents for source in sources)
