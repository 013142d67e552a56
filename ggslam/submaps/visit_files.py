# SPDX-License-Identifier: Apache-2.0
"""A file for each visit of a grid store, written before the cells of the visit.

    visits/5f3c1b0a9d2e4f60.json      named by the visit's name (SHA-256)
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from ggslam.errors import FormatError
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.system.untrusted_files import FileTuning, read_untrusted

VISITS = "visits"


def visit_file(store: Path, name: str) -> Path:
    """Where a visit's file is, if there is one.

    Raises:
        FormatError: a link would be followed.
    """
    folder = store / VISITS
    path = folder / f"{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:16]}.json"
    for link in (folder, path):
        if link.is_symlink():
            raise FormatError(f"{link}: is a link; a store holds none")
    return path


def write_visit(store: GridStore, data: bytes) -> None:
    """Writes the file of the visit that `begin_visit` named.

    Raises:
        RunFolderError: it cannot be written.
    """
    assert store.visit is not None
    path = visit_file(store.path, store.visit)
    make_folder(path.parent)
    write_bytes(path, data, fsync=True, follow=False)


def read_visit(store: GridStore, name: str) -> bytes | None:
    """The file of a visit; None: it has none.

    Raises:
        FormatError: it cannot be read.
    """
    path = visit_file(store.path, name)
    if not path.is_file():
        return None
    return read_untrusted(path, FileTuning.max_text_bytes)
