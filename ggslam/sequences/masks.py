# SPDX-License-Identifier: Apache-2.0
"""Instance masks: finding the file of each frame and reading it at the size of the frame."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.geometry import same_aspect
from ggslam.sequences.images import read_ids
from ggslam.sequences.recording import image_files, last_number

_log = logging.getLogger(__name__)


def find_masks(folder: Path, color_files: list[Path]) -> list[Path | None]:
    """The mask of each colour image in `folder`: of the same name, else of the same last number in the name.

    Raises:
        SequenceError: no such folder, or not one mask that belongs to a colour image.
    """
    if not folder.is_dir():
        raise SequenceError(f"masks folder {folder} does not exist")
    candidates = image_files(folder, (".png",))
    by_name = {path.stem: path for path in candidates}
    found = [by_name.get(path.stem) or by_name.get(path.stem.removesuffix(".color")) for path in color_files]
    if not any(found):
        by_number = {last_number(path.stem): path for path in candidates}
        by_number.pop(None, None)
        found = [by_number.get(last_number(path.stem)) for path in color_files]
    if not any(found):
        shown = ", ".join(path.name for path in candidates[:3]) or "no PNG at all"
        raise SequenceError(f"masks folder {folder}: no mask is named like {color_files[0].name}; found {shown}")
    return found


def read_mask(path: Path, *expected: tuple[int, int]) -> np.ndarray:
    """Instance ids uint16 [H, W] as stored; a warning, once a folder, when the size is none of the `expected` ones.

    Args:
        path: image of grey ids.
        expected: sizes (width, height) that need no remark. The caller resamples to the nearest pixel.

    Raises:
        SequenceError: missing, damaged, not an image of grey ids, or of another aspect than the first expected size.
    """
    ids = read_ids(path)
    height, width = ids.shape
    if (width, height) not in expected:
        if not same_aspect((width, height), expected[0]):
            raise SequenceError(
                f"{path}: mask is {width}x{height}, expected {expected[0][0]}x{expected[0][1]} or the same view smaller"
            )
        _warn_resized(path.parent, (width, height), expected[0])
    return ids


_warned: set[tuple[Path, tuple[int, int]]] = set()


def _warn_resized(folder: Path, found: tuple[int, int], expected: tuple[int, int]) -> None:
    if (folder, found) not in _warned:
        _warned.add((folder, found))
        sizes = (*found, *expected)
        _log.warning("masks in %s are %dx%d, the images %dx%d: resampled to the nearest pixel", folder, *sizes)
