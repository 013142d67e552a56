# SPDX-License-Identifier: Apache-2.0
"""Instance masks: finding the file of each frame, and reading ids that mean the same in every frame."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.mask_ids import InstanceCodes, read_id_table
from ggslam.sequences.mask_images import EQUAL_CHANNELS, MaskImage, mask_kind, read_mask_image
from ggslam.sequences.pixel_grid import Size, same_aspect
from ggslam.sequences.recording import ImageFile, image_files, last_number
from ggslam.system.images import PictureLimits

USUAL_FOLDERS = ("semantic_instance", "Annotations", "instance-filt", "instance", "masks", "object_mask")
"""Where masks lie in a folder that is laid out like a recording, or that a segmenter wrote."""

_log = logging.getLogger(__name__)


def find_masks(folder: Path, color_files: Sequence[ImageFile]) -> list[Path | None]:
    """The mask of each colour image in `folder`: of the same name, else of the same last number in the name.

    If `folder` itself holds no mask of these, the folders that usually hold masks are looked into (`USUAL_FOLDERS`, and
    in them a single folder, as DEVA makes one for a named video).

    Raises:
        SequenceError: no such folder, not one mask that belongs to a colour image, or two for the same one.
    """
    if not folder.is_dir():
        raise SequenceError(f"masks folder {folder} does not exist")
    for place in _places(folder):
        found = _match(_candidates(place), color_files)
        if any(found):
            return found
    shown = ", ".join(path.name for path in _candidates(folder)[:3]) or "no PNG at all"
    raise SequenceError(f"masks folder {folder}: no mask is named like {color_files[0].name}; found {shown}")


def _places(folder: Path) -> list[Path]:
    places = [folder]
    for usual in (folder / name for name in USUAL_FOLDERS):
        if usual.is_dir():
            inner = [path for path in sorted(usual.iterdir()) if path.is_dir()]
            places += [usual, *(inner if len(inner) == 1 else [])]
    return places


def _candidates(folder: Path) -> list[Path]:
    images = image_files(folder, (".png",))
    # In a folder of the 7-Scenes kind the masks lie among images of the same names.
    return [path for path in images if path.stem.endswith(".segm")] or images


def _match(candidates: list[Path], color_files: Sequence[ImageFile]) -> list[Path | None]:
    by_name = {path.stem.removesuffix(".segm"): path for path in candidates}
    found = [by_name.get(path.stem) or by_name.get(path.stem.removesuffix(".color")) for path in color_files]
    if any(found):
        return found
    by_number: dict[int | None, list[Path]] = {}
    for path in candidates:
        by_number.setdefault(last_number(path.stem), []).append(path)
    by_number.pop(None, None)
    numbered = [by_number.get(last_number(path.stem), []) for path in color_files]
    for color, paths in zip(color_files, numbered, strict=True):
        if len(paths) > 1:
            both = f"{paths[0].name} and {paths[1].name}"
            raise SequenceError(f"masks folder {paths[0].parent}: {both} both have the number of {color.name}")
    return [paths[0] if paths else None for paths in numbered]


class MaskReader:
    """Reads the masks of one recording. An id means the same in every frame, whichever frame is read first.

    May be used from several threads.
    """

    def __init__(
        self, files: Iterable[Path | None], void_id: int | None = None, most: int = PictureLimits.max_pixels
    ) -> None:
        """Takes the mask files of all frames of the recording; none is opened yet. `void_id`: means "unlabelled".
        `most`: pixels that a mask may have, see `most_pixels`."""
        self._most = most
        self._void = void_id
        self._files = [path for path in files if path is not None]
        self._lock = threading.Lock()
        self._prepared = False
        self._table: InstanceCodes | None = None
        self._failure: SequenceError | None = None
        self._warned: set[object] = set()

    def prepare(self) -> None:
        """Finds out how ids are coded: the first call looks at every file's first bytes, and at all of every file when
        some are RGB-coded and no pred.json lists their ids.

        Raises:
            SequenceError: more than 65535 different ids.
        """
        with self._lock:
            if not self._prepared:
                self._prepared = True
                try:
                    if any(mask_kind(path) == "RGB" for path in self._files):
                        self._table = read_id_table(self._files, self._most)
                except SequenceError as error:
                    self._failure = error
        if self._failure is not None:
            raise SequenceError(str(self._failure))

    def kinds(self, files: Iterable[Path]) -> Counter[str]:
        """How many of `files` hold grey ids, palette indices, RGB-coded ids, or are unreadable, for reports."""
        self.prepare()
        coded = self._table is not None and self._table.coded
        names = {"RGB": "RGB-coded" if coded else "grey in RGB", None: "unreadable"}
        kinds = (mask_kind(path) for path in files)
        return Counter(names.get(kind, str(kind)) for kind in kinds)

    def read(self, path: Path, *expected: Size) -> np.ndarray:
        """Instance ids uint16 [H, W] at the stored size; a warning, once a folder, when that is none of the expected.

        Args:
            path: one of the recording's masks.
            expected: sizes (width, height) that need no remark; none: any size will do. The caller resamples to the
                nearest pixel.

        Raises:
            SequenceError: missing, damaged, no image of ids, of too many pixels, of another aspect than the first
                expected size, or all its ids are missing in pred.json; also as `prepare`.
        """
        self.prepare()
        image = read_mask_image(path, self._most)
        height, width = image.codes.shape
        if expected and (width, height) not in expected:
            self._check_aspect(path, (width, height), expected[0])
        void = self._void_pixels(image)
        if self._table is None:
            return np.where(void, 0, image.codes).astype(np.uint16)
        ids, unlisted = self._table.ids(image)
        ids[void] = 0
        unlisted &= ~void
        if unlisted.any():
            if not ids.any():
                raise SequenceError(f"{path}: not one of its ids is listed in {self._table.source}")
            message = "%s and perhaps others: ids that %s does not list count as unlabelled"
            self._warn("unlisted", message, path, self._table.source)
        return ids

    def _void_pixels(self, image: MaskImage) -> np.ndarray:
        """Where a mask says that nobody knows what is there, bool [H, W]."""
        if self._void is None:
            return np.zeros(image.codes.shape, bool)
        stored = self._void * EQUAL_CHANNELS if image.equal_channels else self._void
        return np.asarray(image.codes == stored)

    def _check_aspect(self, path: Path, found: Size, expected: Size) -> None:
        if not same_aspect(found, expected):
            raise SequenceError(
                f"{path}: mask is {found[0]}x{found[1]}, expected {expected[0]}x{expected[1]} or the same view smaller"
            )
        message = "masks in %s are %dx%d, the images %dx%d: resampled to the nearest pixel"
        self._warn((path.parent, found), message, path.parent, *found, *expected)

    def _warn(self, topic: object, message: str, *values: object) -> None:
        with self._lock:
            known = topic in self._warned
            self._warned.add(topic)
        if not known:
            _log.warning(message, *values)
