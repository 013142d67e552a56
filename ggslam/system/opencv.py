# SPDX-License-Identifier: Apache-2.0
"""Turns OpenCV's exceptions into ours."""

from __future__ import annotations

from contextlib import ContextDecorator
from typing import NoReturn

import cv2

from ggslam.errors import GgslamError, MemoryFullError, OpenCvError


class opencv_errors(ContextDecorator):
    """Turns `cv2.error` inside into an error of ours that names `place` (its text is asked for only then).

    Args:
        place: where it happens.
        kind: of the error; where the pixels of a file may be the reason, that is `SequenceError`.

    Raises:
        GgslamError: of `kind`.
        MemoryFullError: memory is full.
    """

    def __init__(self, place: object, kind: type[GgslamError] = OpenCvError) -> None:
        self._place, self._kind = place, kind

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *trace: object) -> None:
        if isinstance(error, cv2.error):
            raise_as_ours(error, self._place, self._kind)


def raise_as_ours(error: cv2.error, place: object, kind: type[GgslamError] = OpenCvError) -> NoReturn:
    """Raises what `opencv_errors` turns an error into; for an `except` clause, which costs a block nothing that runs at
    every frame."""
    if error.code == cv2.Error.StsNoMem:
        raise MemoryFullError(f"{place}: memory is full: {opencv_reason(error)}") from None
    raise kind(f"{place}: OpenCV: {opencv_reason(error)}") from error


def opencv_reason(error: Exception) -> str:
    """What OpenCV says, in one line: function and reason, without the place in its own source."""
    reason = " ".join(word for word in str(getattr(error, "err", None) or error).split() if word != ">")
    function = str(getattr(error, "func", None) or "")
    return f"{function}: {reason}" if function.isidentifier() else reason
