# SPDX-License-Identifier: Apache-2.0
"""RGB-D recordings: one file per format, `open_sequence` to read any of them as a stream."""

from ggslam.sequences.factory import FORMATS, open_sequence, recognise_format
from ggslam.sequences.sequence import Sequence, SkippedFrame

__all__ = ["FORMATS", "Sequence", "SkippedFrame", "open_sequence", "recognise_format"]
