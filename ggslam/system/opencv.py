# SPDX-License-Identifier: Apache-2.0
"""Turns OpenCV's exceptions into ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from ggslam.errors import GgslamError, MemoryFullError, OpenCvError


@contextmanager
def opencv_errors(place: object, kind: type[GgslamError] = OpenCvError) -> Iterator[None]:
    """Turns `cv2.error` inside into an error of ours that names `place` (its text is asked for only then).

    Raises:
        GgslamError: of `kind`; where the pixels of a file may be the reason, that is `SequenceError`.
        MemoryFullError: memory is full.
    """
    try:
        yield
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryFullError(f"{place}: memory is full: {opencv_reason(error)}") from None
        raise kind(f"{place}: OpenCV: {opencv_reason(error)}") from error


def opencv_reason(error: Exception) -> str:
    """What OpenCV says, in one line: function and reason, without the place in its own source."""
    reason = " ".join(word for word in str(getattr(error, "err", None) or error).split() if word != ">")
    function = str(getattr(error, "func", None) or "")
    return f"{function}: {reason}" if function.isidentifier() else reason
