# SPDX-License-Identifier: Apache-2.0
"""Makes the masks of a recording as bad as those of a segmenter that looks at single images.

    python scripts/tools/scramble_masks.py RECORDING OUT [--seed 0 --split 0.2 --drop 0.05 --dots 0.01]

In every frame anew: segments are split in two, some are dropped, the ids are shuffled, and dots are strewn over the
image. OUT gets one PNG of uint16 ids a frame, for `ggslam run RECORDING --masks OUT`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import GgslamError, SequenceError
from ggslam.sequences import open_sequence
from ggslam.sequences.masks import MaskReader
from ggslam.system.atomic import make_folder, write_bytes


def scramble(mask: np.ndarray, rng: np.random.Generator, split: float, drop: float, dots: float) -> np.ndarray:
    """Spoils one mask.

    Args:
        mask: uint16 [H, W] instance ids, 0 = unlabelled.
        rng: source of all draws.
        split: chance of a segment to be cut in two by a random line through its centroid.
        drop: chance of each segment that is there after cutting to become unlabelled.
        dots: share of the pixels that get one of the remaining ids at random.

    Returns:
        uint16 [H, W], ids from 1 to the number of segments left, in random order.
    """
    segments = np.unique(mask, return_inverse=True)[1].reshape(mask.shape) + (0 if (mask == 0).any() else 1)
    count = int(segments.max())
    for segment in 1 + np.flatnonzero(rng.random(count) < split):
        rows, columns = np.nonzero(segments == segment)
        angle = rng.uniform(0, np.pi)
        cut = (columns - columns.mean()) * np.cos(angle) + (rows - rows.mean()) * np.sin(angle) > 0
        if cut.any():  # a single pixel cannot be cut
            count += 1
            segments[rows[cut], columns[cut]] = count
    kept = np.flatnonzero(rng.random(count) >= drop)
    new_ids = np.zeros(count + 1, np.uint16)
    new_ids[1 + kept] = 1 + rng.permutation(len(kept))
    result = new_ids[segments]
    if len(kept):
        dotted = rng.random(mask.shape) < dots
        result[dotted] = rng.integers(1, len(kept) + 1, int(dotted.sum()))
    return result


def scramble_recording(recording: Path, out: Path, seed: int, split: float, drop: float, dots: float) -> int:
    """Writes the spoilt masks of a recording, at their stored size; returns how many.

    A frame's draws depend on `seed` and its number only.

    Raises:
        SequenceError: the recording cannot be read or has no masks.
        RunFolderError: a mask cannot be written.
    """
    sequence = open_sequence(recording)
    if not sequence.has_masks:
        raise SequenceError(f"{recording}: has no masks")
    frames = [sequence.files(index) for index in range(len(sequence))]
    reader = MaskReader(files.mask for files in frames)
    make_folder(out)
    for index, files in enumerate(frames):
        if files.mask is not None:
            spoilt = scramble(reader.read(files.mask), np.random.default_rng([seed, index]), split, drop, dots)
            write_bytes(out / f"{files.color.stem}.png", cv2.imencode(".png", spoilt)[1].tobytes())
    return sum(files.mask is not None for files in frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--split", type=float, default=0.2, help="share of segments cut in two")
    parser.add_argument("--drop", type=float, default=0.05, help="share of segments dropped")
    parser.add_argument("--dots", type=float, default=0.01, help="share of pixels with a random id")
    values = parser.parse_args()
    try:
        written = scramble_recording(values.recording, values.out, values.seed, values.split, values.drop, values.dots)
    except GgslamError as error:
        sys.exit(f"error: {error}")
    print(f"{written} masks written to {values.out}")


if __name__ == "__main__":
    main()
