# SPDX-License-Identifier: Apache-2.0
"""Ids of RGB-coded masks: up to 2^24 different numbers folded to uint16, the same way on every opening.

Stock DEVA (Cheng et al., "Tracking Anything with Decoupled Video Segmentation", 2023) writes each id as a colour,
id = R + 256 G + 65536 B, and lists the segments of every frame in pred.json.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.mask_images import EQUAL_CHANNELS, MaskImage, read_mask_image
from ggslam.sequences.recording import read_text
from ggslam.system.images import PictureLimits

LARGEST_ID: Final = 65535
"""Largest instance id: masks are 16-bit."""
_CODES: Final = 1 << 24
"""Colours of 8-bit RGB images."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class InstanceCodes:
    """Every code that means an instance.

    If all of them fit in uint16 they are the ids; else the ids are 1, 2, ... in the order of the codes.

    Attributes:
        codes: int32 [n], increasing, without 0.
        source: where they come from, for messages.
        coded: whether RGB images hold codes, as far as known; false: grey ids in three equal channels.
    """

    codes: np.ndarray
    source: str
    coded: bool = True

    def ids(self, image: MaskImage) -> tuple[np.ndarray, np.ndarray]:
        """Ids uint16 [H, W] of a mask (0: unlabelled or not listed), and bool [H, W]: coded but not listed."""
        codes = image.codes
        if image.equal_channels and not np.isin(np.unique(codes), np.append(self.codes, 0)).all():
            codes = codes // EQUAL_CHANNELS  # grey ids, stored as RGB
        if len(self.codes) == 0:
            return np.zeros(codes.shape, np.uint16), codes > 0
        place = np.searchsorted(self.codes, codes)
        place[place == len(self.codes)] = 0
        listed = self.codes[place] == codes
        ids = codes if self.codes[-1] <= LARGEST_ID else place + 1
        return np.where(listed, ids, 0).astype(np.uint16), (codes > 0) & ~listed


def read_id_table(files: list[Path], most: int = PictureLimits.max_pixels) -> InstanceCodes:
    """The codes of a set of masks: those that pred.json lists beside or above them, else all that occur in the files of
    at most so many pixels.

    Raises:
        SequenceError: more than 65535 of them.
    """
    folder = files[0].parent
    for path in (folder / "pred.json", folder.parent / "pred.json"):
        if path.is_file() and (listed := _listed_codes(path)) is not None:
            return _check_size(InstanceCodes(listed, str(path)), folder)
    _log.info("reading all %d masks in %s once for their ids", len(files), folder)
    codes, coded = _occurring_codes(files, most)
    return _check_size(InstanceCodes(codes, "the masks themselves", coded), folder)


def _check_size(table: InstanceCodes, folder: Path) -> InstanceCodes:
    if len(table.codes) > LARGEST_ID:
        raise SequenceError(
            f"masks folder {folder}: expected at most {LARGEST_ID} different ids, found {len(table.codes)} by "
            f"{table.source}; are these pictures rather than masks?"
        )
    return table


def _listed_codes(path: Path) -> np.ndarray | None:
    """Sorted ids of all segments in a pred.json; None, with a warning, when it does not list any."""
    try:
        content = json.loads(read_text(path))
        codes = np.unique(np.array(list(_segment_ids(content)), np.int64))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, SequenceError) as error:
        _log.warning("%s is not used, it does not list segments as DEVA does: %r", path, error)
        return None
    codes = codes[codes != 0]
    if len(codes) == 0 or codes[0] < 0 or codes[-1] >= _CODES:
        _log.warning("%s is not used, it lists no ids that three bytes could hold", path)
        return None
    return codes.astype(np.int32)


def _segment_ids(content: Any) -> Iterator[int]:
    """Ids in {"annotations": [{"segments_info": [{"id": ...}]}]}; annotations may be grouped by video."""
    for entry in content["annotations"]:
        if "annotations" in entry:
            yield from _segment_ids(entry)
        else:
            yield from (int(segment["id"]) for segment in entry["segments_info"])


def _occurring_codes(files: Iterable[Path], most: int) -> tuple[np.ndarray, bool]:
    """Sorted codes of all masks, int32, and whether any is RGB-coded: if not, images of equal channels are grey ids."""
    seen, seen_equal, any_coded = np.zeros(_CODES, bool), np.zeros(256, bool), False
    for path in files:
        try:
            image = read_mask_image(path, most)
        except SequenceError:
            continue  # reported when it is read for its frame
        if image.equal_channels:
            seen_equal[image.codes // EQUAL_CHANNELS] = True
        else:
            seen[image.codes] = True
            any_coded |= image.kind == "RGB"
    seen[np.flatnonzero(seen_equal) * (EQUAL_CHANNELS if any_coded else 1)] = True
    seen[0] = False
    return np.flatnonzero(seen).astype(np.int32), any_coded
