# SPDX-License-Identifier: Apache-2.0
"""RGB-D recordings: one file per format, `open_sequence` to read any of them as a stream."""

from ggslam.sequences.batches import collate_frames
from ggslam.sequences.factory import FORMATS, open_sequence, recognise_format
from ggslam.sequences.inspection import Motion, SequenceReport, inspect_sequence
from ggslam.sequences.sequence import Sequence, SkippedFrame

__all__ = [
    "FORMATS",
    "Motion",
    "Sequence",
    "SequenceReport",
    "SkippedFrame",
    "collate_frames",
    "inspect_sequence",
    "open_sequence",
    "recognise_format",
]
