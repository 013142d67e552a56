# SPDX-License-Identifier: Apache-2.0
"""Cross-entropy of the classes of pixels, in one call to the compiled core."""

from __future__ import annotations

import ctypes

import numpy as np

from ggslam.abi.core import CrossEntropyOfPixels
from ggslam.errors import RenderError
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning


def cross_entropy(
    features: np.ndarray, classifier: IdentityClassifier, classes: np.ndarray, chosen: np.ndarray,
    context: NativeContext,
) -> tuple[float, np.ndarray, np.ndarray]:  # fmt: skip
    """Mean softmax cross-entropy of classified features; being nothing competes with the classes. The same, bit for
    bit, for any number of threads.

    Args:
        features: float32 [P, F].
        classifier: C classes.
        classes: true class of each, int [P]; -1: none, the pixel does not count.
        chosen: classes that the softmax runs over, int [K], sorted, all of `classes` among them.
        context: threads to work on.

    Returns:
        The mean, its gradient by the features [P, F], and by the rows of `chosen` [K, F + 1] (weights, then bias).

    Raises:
        RenderError: wrong shape.
    """
    channels = classifier.weight.shape[1]
    if features.shape != (len(classes), channels):
        raise RenderError(f"features: expected shape {[len(classes), channels]}, found {list(features.shape)}")
    features = np.ascontiguousarray(features, np.float32)
    true = np.where(classes >= 0, np.searchsorted(chosen, classes), -1).astype(np.int32)
    weight = np.ascontiguousarray(classifier.weight[chosen], np.float32)
    bias = np.ascontiguousarray(classifier.bias[chosen], np.float32)
    gradient, rows = np.empty_like(features), np.empty((len(chosen), channels + 1), np.float32)
    job = CrossEntropyOfPixels(
        features.ctypes.data, true.ctypes.data, weight.ctypes.data, bias.ctypes.data, gradient.ctypes.data,
        rows.ctypes.data, len(features), channels, len(chosen), IdentityVectorTuning.nothing_logit,
    )  # fmt: skip
    load_library().ggslam_cross_entropy_of_pixels(context.handle, ctypes.byref(job))
    return job.loss, gradient, rows
