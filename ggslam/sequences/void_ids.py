# SPDX-License-Identifier: Apache-2.0
"""The id 255 of masks, which VOC, DAVIS and their like give to pixels that nobody decided about."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.mask_images import EQUAL_CHANNELS, most_pixels, read_mask_image
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning

VOID: Final = 255
"""Id that many data sets give to pixels without a label."""


class VoidTuning(Tuning):
    """When an id is taken for "no label"."""

    masks = 8
    """Masks spread over the recording."""
    min_share = 0.5
    """Smallest share of the masks that hold the id."""
    max_other = 127
    """Largest other id: objects are counted from 1, so an id far from all others is none."""


def has_void_id(sequence: Sequence) -> bool:
    """Whether 255 stands in most masks of a recording, far from all other ids, and no name says that it is a thing."""
    if not sequence.has_masks or VOID in sequence.instance_names or sequence.void_id == VOID:
        return False
    held, others, most = [], 0, most_pixels(sequence.color_size, sequence.depth_size)
    for number in np.unique(np.linspace(0, len(sequence) - 1, VoidTuning.masks).round().astype(int)):
        path = sequence.files(int(number)).mask
        try:
            image = None if path is None else read_mask_image(path, most)
        except SequenceError:
            continue
        if image is None:
            continue
        codes = np.unique(image.codes // EQUAL_CHANNELS if image.equal_channels else image.codes)
        held.append(VOID in codes)
        others = max([others, *(int(code) for code in codes if code != VOID)])
    return bool(held) and float(np.mean(held)) >= VoidTuning.min_share and 0 < others <= VoidTuning.max_other
