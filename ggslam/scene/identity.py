# SPDX-License-Identifier: Apache-2.0
"""The classifier that says which object an identity vector belongs to: a 1x1 convolution, in other words one matrix.

Ye et al., "Gaussian Grouping: Segment and Edit Anything in 3D Scenes", 2024; GG-SLAM. Unlike there the number of
classes is not fixed: a class is added for every object id that appears. And there is one thing more that a vector can
be: nothing, with a constant logit. Without it whatever no mask has labelled would be given to some object.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.scene.arrays import arrays_to_bytes, read_arrays
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning

IDENTITY_CHANNELS: Final = 16
"""Length of an identity vector: a layout of arrays that saved maps and compiled kernels share."""


class IdentityVectorTuning(Tuning):
    """Identity vectors and their classifier."""

    nothing_logit = 1.0
    """Logit of belonging to no object. Vectors that were never labelled stay near zero, and so do their logits."""


@savable()
@dataclass
class IdentityClassifier:
    """Linear classifier of identity vectors.

    Attributes:
        class_ids: uint16 [C], the object id of each class; distinct, never 0 (0 = unlabelled is no class).
        weight: float32 [C, F].
        bias: float32 [C].
    """

    class_ids: Annotated[np.ndarray, Form("u2", "c")]
    weight: Annotated[np.ndarray, Form("f4", "c", "f", finite=True)]
    bias: Annotated[np.ndarray, Form("f4", "c", finite=True)]

    @staticmethod
    def empty(channels: int = IDENTITY_CHANNELS) -> IdentityClassifier:
        """A classifier without classes."""
        return IdentityClassifier(np.zeros(0, np.uint16), np.zeros((0, channels), np.float32), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.class_ids)

    def logits(self, features: np.ndarray) -> np.ndarray:
        """float32 [..., C] of identity vectors [..., F] (single Gaussians' or rendered)."""
        return features @ self.weight.T + self.bias

    def probabilities(self, features: np.ndarray) -> np.ndarray:
        """Probability of each class, float32 [..., C]: softmax over the classes and no object (the rest)."""
        z = self.logits(features)
        highest = z.max(-1, keepdims=True, initial=IdentityVectorTuning.nothing_logit)
        z -= highest
        np.exp(z, out=z)
        z /= z.sum(-1, keepdims=True) + np.exp(IdentityVectorTuning.nothing_logit - highest)
        return z

    def labels(self, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Most probable object id, uint16 [...], and its probability, float32 [...]; 0 and 0 where nothing is more
        probable than every object."""
        shape = features.shape[:-1]
        if not len(self):
            return np.zeros(shape, np.uint16), np.zeros(shape, np.float32)
        z = self.logits(features)
        best = z.argmax(-1)
        highest = np.take_along_axis(z, best[..., None], -1)
        probability = 1 / (np.exp(z - highest).sum(-1) + np.exp(IdentityVectorTuning.nothing_logit - highest[..., 0]))
        something = highest[..., 0] > IdentityVectorTuning.nothing_logit
        return np.where(something, self.class_ids[best], 0).astype(np.uint16), np.where(something, probability, 0)

    def class_of(self, object_id: int) -> int:
        """Number of the class of an object id.

        Raises:
            KeyError: no such class.
        """
        found = np.flatnonzero(self.class_ids == object_id)
        if not len(found):
            raise KeyError(object_id)
        return int(found[0])

    def without(self, object_ids: list[int]) -> IdentityClassifier:
        """The same without the classes of some objects."""
        keep = ~np.isin(self.class_ids, object_ids)
        return IdentityClassifier(self.class_ids[keep], self.weight[keep], self.bias[keep])

    def to_bytes(self) -> bytes:
        """Content of a file that `from_file` reads (NumPy's .npz)."""
        return arrays_to_bytes(class_ids=self.class_ids, weight=self.weight, bias=self.bias)

    @staticmethod
    def from_file(path: str | Path) -> IdentityClassifier:
        """Reads a classifier.

        Raises:
            FormatError: missing, damaged, or arrays that do not fit together.
        """
        ids, weight, bias = read_arrays(path, "a classifier", "class_ids", "weight", "bias")
        if weight.ndim != 2 or ids.shape != (len(weight),) or bias.shape != ids.shape or not np.isfinite(weight).all():
            raise FormatError(
                f"{path}: shapes do not fit or values are not finite: {ids.shape}, {weight.shape}, {bias.shape}"
            )
        return IdentityClassifier(ids.astype(np.uint16), weight.astype(np.float32), bias.astype(np.float32))
