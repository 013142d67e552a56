# SPDX-License-Identifier: Apache-2.0
"""Object ids of the pixels of a view: by the classifier from a rendered identity image, or by weight from given labels.

The identity image is what the classifier was trained on: blended over zero and not divided by alpha.
"""

from __future__ import annotations

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians, RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning
from ggslam.system.tuning import Tuning


class LabelTuning(Tuning):
    """Object ids of pixels."""

    min_alpha = 0.5
    """Smallest opacity of a pixel that shows an object."""
    logits_at_once = 1 << 18
    """Logits in memory at a time: 1 MB, which fits the cache."""
    pixels_at_once = 1 << 15
    """Pixels whose contributions are in memory at a time (12 MB)."""


def label_image(
    features: torch.Tensor | np.ndarray,
    alpha: torch.Tensor | np.ndarray,
    classifier: IdentityClassifier,
    min_alpha: float = LabelTuning.min_alpha,
    only_ids: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Most probable object id of every pixel of a rendered identity image.

    Args:
        features: float32 [F, H, W], rendered identity vectors.
        alpha: float32 [H, W], rendered alpha.
        classifier: of F channels.
        min_alpha: pixels below it get id 0.
        only_ids: leave out the probabilities, which takes half the time: they are all 0.

    Returns:
        Ids uint16 [H, W] and their probabilities float32 [H, W]; 0 and 0 where alpha is too low or no object is seen.

    Raises:
        RenderError: shapes that do not fit.
    """
    features, alpha = torch.as_tensor(features), torch.as_tensor(alpha)
    if features.ndim != 3 or features.shape[1:] != alpha.shape or features.shape[0] != classifier.weight.shape[1]:
        raise RenderError(
            f"label_image: expected features [{classifier.weight.shape[1]}, H, W] and alpha [H, W], found "
            f"{list(features.shape)} and {list(alpha.shape)}"
        )
    shape = tuple(alpha.shape)
    ids, confidence = np.zeros(shape, np.uint16), np.zeros(shape, np.float32)
    if not len(classifier):
        return ids, confidence
    weight, bias = torch.from_numpy(classifier.weight).T, torch.from_numpy(classifier.bias)
    vectors = features.reshape(len(features), -1).T
    step = max(1, LabelTuning.logits_at_once // len(classifier))
    with torch.inference_mode():
        for start in range(0, len(vectors), step):
            part = slice(start, start + step)
            logits = torch.addmm(bias, vectors[part], weight)
            best = logits.numpy().argmax(1)  # torch's own takes several times longer
            highest = logits.gather(1, torch.from_numpy(best)[:, None])
            something = (highest[:, 0] > IdentityVectorTuning.nothing_logit).numpy()
            if not only_ids:
                nothing = (IdentityVectorTuning.nothing_logit - highest[:, 0]).exp_()
                confidence.reshape(-1)[part] = logits.sub_(highest).exp_().sum(1).add_(nothing).reciprocal_().numpy()
            ids.reshape(-1)[part] = np.where(something, classifier.class_ids[best], 0)
    empty = (alpha < min_alpha).numpy() | (ids == 0)
    ids[empty], confidence[empty] = 0, 0
    return ids, confidence


def render_labels(
    rasterizer: CpuRasterizer,
    gaussians: Gaussians,
    classifier: IdentityClassifier,
    camera: Camera,
    T_camera_world: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Object ids uint16 [H, W] and their probabilities float32 [H, W] as a camera sees them; see `label_image`.

    Raises:
        RenderError: the Gaussians have no feature channels, or not those of the classifier.
    """
    view = rasterizer.forward(gaussians, camera, T_camera_world)
    if view.features is None:
        raise RenderError("render_labels: the Gaussians have no feature channels")
    return label_image(view.features, view.alpha, classifier)


def vote_label_image(
    rasterizer: CpuRasterizer,
    view: RenderBuffers,
    labels: np.ndarray,
    min_alpha: float = LabelTuning.min_alpha,
    stride: int = 1,
) -> np.ndarray:
    """For every pixel the label with the largest rendering weight, uint16 [H, W]; 0 where alpha is below `min_alpha` or
    unlabelled Gaussians weigh most. Nothing is rendered beside the view that is there.

    Args:
        rasterizer: which rendered `view` last.
        view: what its last `forward` gave.
        labels: uint16 [N], one for each rendered Gaussian, 0 = unlabelled.
        min_alpha: pixels below it get label 0.
        stride: look only at every n-th pixel of every n-th row; the image is that much smaller.

    Raises:
        RenderError: nothing was rendered, or out of memory.
    """
    height, width = view.alpha.shape
    looked_at = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
    covered = (view.alpha[::stride, ::stride] >= min_alpha).numpy()
    pixels = looked_at[covered]
    found = np.zeros(len(pixels), np.uint16)
    for start in range(0, len(pixels), LabelTuning.pixels_at_once):
        part = slice(start, start + LabelTuning.pixels_at_once)
        found[part] = rasterizer.pixel_terms(pixels[part]).labels(labels)[0]
    ids = np.zeros(covered.shape, np.uint16)
    ids[covered] = found
    return ids
