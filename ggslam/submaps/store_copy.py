# SPDX-License-Identifier: Apache-2.0
"""Copies a grid store, also while it is written to: the copy is the state of one moment."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ggslam.errors import FormatError, RunFolderError
from ggslam.submaps.cell_files import CellFiles, wait_for_disk
from ggslam.submaps.cell_records import PartRecord
from ggslam.submaps.coming_store import coming_store
from ggslam.submaps.grid import CELLS, INDEX, GridStore
from ggslam.submaps.index import CellIndex
from ggslam.submaps.store_objects import OBJECTS_FILE
from ggslam.submaps.visit_files import visit_file
from ggslam.system.atomic import make_folder
from ggslam.system.process_memory import most_memory_bytes
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, copy_untrusted


class StoreCopyTuning(Tuning):
    """Copying a store while it is written."""

    max_tries = 20
    """Most attempts, if a writer replaces files between reading the index and copying them."""
    threads = 8
    """Threads that wait for the disk."""


def copy_store(source: Path, target: Path) -> None:
    """Makes a store with the content of another one; it appears when all of it is on the disk. Only what the index
    names is copied. Parts that are missing or damaged are so in the copy, too.

    Raises:
        FormatError: the source is no store, or damaged.
        RunFolderError: there is something at the target, or it cannot be written.
    """
    if target.exists() or target.is_symlink():
        raise RunFolderError(f"{target}: is there already; choose another folder with `out`")
    with coming_store(target) as beside, GridStore.open(source) as store:
        for attempt in range(StoreCopyTuning.max_tries):
            make_folder(beside)
            if _copy_to(store, beside, last=attempt == StoreCopyTuning.max_tries - 1):
                break
            shutil.rmtree(beside)


def _copy_to(store: GridStore, folder: Path, last: bool) -> bool:
    """Copies everything into an empty folder; False if a file was replaced meanwhile (`last`: it is missing)."""
    store.copy_index(folder / INDEX)
    files, copies = CellFiles(store.path / CELLS), CellFiles(folder / CELLS)
    index, _ = CellIndex.open(folder / INDEX, write=False)
    written = [folder / INDEX]
    try:
        keys = index.keys()
        for key in keys:
            record = index.record(key)
            for name, part in (record.parts if record is not None else {}).items():
                path = copies.path(key, part.version, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                try:
                    _copy_part(files.path(key, part.version, name), path, part)
                    written.append(path)
                except FileNotFoundError:
                    now = store.cell(key).parts.get(name) if key in store else None
                    if not last and (now is None or now.version != part.version):
                        return False
        written += _copy_beside(store.path, folder, index.visits())
    finally:
        index.close()
    folders = {path.parent for path in written} | {path.parent.parent for path in written[1:]}
    with ThreadPoolExecutor(StoreCopyTuning.threads) as pool:
        list(pool.map(wait_for_disk, [*written, *folders]))
    return True


def _copy_part(source: Path, target: Path, part: PartRecord) -> None:
    """Copies a part; of one that is not as large as the index says, or than can be, an empty file is made, which is
    damaged likewise. Raises FileNotFoundError if there is none."""
    size = source.stat().st_size
    try:
        if size == part.bytes:
            copy_untrusted(source, target, limit=min(size, most_memory_bytes()))
            return
    except FormatError:
        source.stat()  # removed by a writer meanwhile?
    target.write_bytes(b"")


def _copy_beside(source: Path, target: Path, visits: Sequence[str]) -> list[Path]:
    """Copies what is remembered of the visits that the index knows, and the objects; gives the copies."""
    known = [(visit_file(source, name), visit_file(target, name)) for name in visits]
    known.append((source / OBJECTS_FILE, target / OBJECTS_FILE))  # a store with links was not opened
    written = []
    for file, copy in known:
        if file.is_file():
            copy.parent.mkdir(exist_ok=True)
            copy_untrusted(file, copy, FileTuning.max_text_bytes)
            written.append(copy)
    return written
