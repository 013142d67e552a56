# SPDX-License-Identifier: Apache-2.0
"""A grid store copied, also while somebody writes to it: the copy is what was complete at one moment."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ggslam.errors import FormatError, RunFolderError
from ggslam.submaps.cell_files import CellFiles, wait_for_disk
from ggslam.submaps.coming_store import coming_store
from ggslam.submaps.grid import CELLS, INDEX, GridStore
from ggslam.submaps.index import CellIndex
from ggslam.submaps.store_objects import OBJECTS_FILE
from ggslam.submaps.visit_files import VISITS
from ggslam.system.atomic import make_folder

_TRIES = 20
"""Times that a writer may have replaced files between a look at the index and at them."""
_WAITING_THREADS = 8


def copy_store(source: Path, target: Path) -> None:
    """Makes a store with the content of another one; it appears when all of it is on the disk. Files that are missing
    or damaged are so in the copy, too.

    Raises:
        FormatError: the source is no store, or damaged.
        RunFolderError: there is something at the target, or it cannot be written.
    """
    if target.exists() or target.is_symlink():
        raise RunFolderError(f"{target}: is there already; choose another folder with `out`")
    with coming_store(target) as beside, GridStore.open(source) as store:
        for attempt in range(_TRIES):
            make_folder(beside)
            if _copy_to(store, beside, last=attempt == _TRIES - 1):
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
                    shutil.copyfile(files.path(key, part.version, name), path)
                    written.append(path)
                except FileNotFoundError:
                    now = store.cell(key).parts.get(name) if key in store else None
                    if not last and (now is None or now.version != part.version):
                        return False
    finally:
        index.close()
    if (store.path / VISITS).is_dir():
        if (store.path / VISITS).is_symlink():
            raise FormatError(f"{store.path / VISITS}: is a link; a store holds none")
        shutil.copytree(store.path / VISITS, folder / VISITS, symlinks=True)
        written += (folder / VISITS).iterdir()
    known = store.path / OBJECTS_FILE
    if known.is_file():
        shutil.copyfile(known, folder / OBJECTS_FILE, follow_symlinks=False)  # a store with links was not opened
        written.append(folder / OBJECTS_FILE)
    folders = {path.parent for path in written} | {path.parent.parent for path in written[1:]}
    with ThreadPoolExecutor(_WAITING_THREADS) as pool:
        list(pool.map(wait_for_disk, [*written, *folders]))
    return True
