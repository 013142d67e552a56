# SPDX-License-Identifier: Apache-2.0
"""The half of a SAM export that makes masks of an image's embedding and of points in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.onnx_sessions import NUMBER_TYPES, OnnxSession, words_of

_MASK_SIDE: Final = 256
"""Width and height of SAM's masks, and of the mask that can be given as a hint, px."""
_SAM_MASKS: Final = 4
"""Masks of a point that SAM computes: one for prompts of several points, and three for a point alone: whole, part and
part of a part."""
_NO_POINT: Final = -1
"""Label of a point that is none; 1 is a point inside of what is asked for."""


class SamDecoder:
    """Makes masks of points.

    Inputs are told by their names, as in the exports of SAM, MobileSAM, SAM 2, EfficientSAM and Hugging Face's Optimum:
    points and labels, [n, points, 2] and [n, points], or [1, n, points, 2] and [1, n, points]; embeddings, which the
    encoder gives; and, if there are such, a mask as a hint, whether it counts, and the image's size.

    Attributes:
        stretches: whether its encoder wants images stretched to the input, as those of SAM 2 and EfficientSAM do.
        at_once: points that it takes, each by itself; 0: any number.
    """

    def __init__(self, session: OnnxSession, encoder: OnnxSession) -> None:
        """Looks at what the decoder takes and gives.

        Raises:
            ConfigError: it takes or gives something else, or embeddings that the encoder does not give.
        """
        self._session = session
        roles: dict[str, Any] = {}
        self._embeddings: dict[str, str] = {}
        for value in session.inputs:
            role = _role(value.name)
            if value.type not in NUMBER_TYPES or role in roles:
                raise self._not_understood()
            if role == "embedding":
                self._embeddings[value.name] = _source(value, session, encoder)
            else:
                roles[role] = value
        self._roles = roles
        if "points" not in roles or len(roles["points"].shape) not in (3, 4) or not self._embeddings:
            raise self._not_understood()
        self._nested = len(roles["points"].shape) == 4
        high_resolution = any("high_res" in name or name[-2:-1] == "." for name in self._embeddings)
        self.stretches = high_resolution or (self._nested and "size" in roles)
        # Exports of points as [n, points, 2] expect a point that is none beside one that is; the others add it.
        points = roles["points"].shape[-2]
        self._points = points if isinstance(points, int) else 1 if self._nested or high_resolution else 2
        self._outputs = self._find_outputs()
        self.at_once = self._prompts_at_once()

    @property
    def embeddings(self) -> list[str]:
        """Names of the encoder's outputs that the decoder takes."""
        return sorted(set(self._embeddings.values()))

    def decode(
        self, embeddings: Mapping[str, np.ndarray], points: np.ndarray, size: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Masks of points, each by itself.

        Args:
            embeddings: the encoder's outputs by name.
            points: float32 [n, 2], x and y in pixels of the encoder's input; at most `at_once`.
            size: (width, height) of the encoder's input.

        Returns:
            logits [n, m, h, w] over the whole input, and how good each mask is by the decoder's own judgement, [n, m].

        Raises:
            ConfigError: the decoder fails, or gives other shapes.
        """
        types = {value.name: NUMBER_TYPES[value.type] for value in self._session.inputs}
        values = {n: embeddings[source].astype(types[n], copy=False) for n, source in self._embeddings.items()}
        for role, value in self._roles.items():
            values[value.name] = self._value(role, value, points, size).astype(types[value.name])
        masks, scores = self._session.run(self._outputs, values)
        count = len(points)
        if masks.ndim < 3 or math.prod(masks.shape[:-2]) != scores.size or scores.size % count or not masks.size:
            raise ConfigError(
                f"{self._session.path}: expected masks [{count}, m, h, w] and scores [{count}, m] of {count} points, "
                f"found {list(masks.shape)} and {list(scores.shape)}"
            )
        logits, quality = masks.reshape(count, -1, *masks.shape[-2:]), scores.reshape(count, -1).astype(np.float32)
        first = 1 if quality.shape[1] == _SAM_MASKS else 0
        return logits[:, first:], quality[:, first:]

    def _value(self, role: str, value: Any, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """What an input that is not an embedding is given."""
        count = len(points)
        if role == "points":
            coordinates = np.zeros((count, self._points, 2), np.float32)
            # EfficientSAM takes points in an image of the size that it makes masks of; others in the encoder's input.
            scale = np.array([_MASK_SIDE / n for n in size]) if self._nested and "size" in self._roles else 1
            coordinates[:, 0] = points * scale
            return coordinates[None] if self._nested else coordinates
        if role == "labels":
            labels = np.full((count, self._points), _NO_POINT)
            labels[:, 0] = 1
            return labels[None] if self._nested else labels
        if role == "size":  # that of a square image, which fills the whole input
            return np.array([_MASK_SIDE, _MASK_SIDE])
        if role == "mask":
            batch, channels, height, width = (n if isinstance(n, int) else None for n in value.shape)
            return np.zeros((batch or count, channels or 1, height or _MASK_SIDE, width or _MASK_SIDE))
        return np.zeros([n if isinstance(n, int) else 1 for n in value.shape])  # the hint does not count

    def _find_outputs(self) -> list[str]:
        """Names of masks and scores. Beside masks of the image's size most exports give smaller ones of the input."""
        names = [output.name for output in self._session.outputs]
        masks = sorted((n for n in names if "mask" in n.lower()), key=lambda n: "low_res" not in n.lower())
        scores = [n for n in names if n not in masks and "iou" in n.lower()]
        scores += [n for n in names if n not in masks and "score" in n.lower() and "stab" not in n.lower()]
        if not masks or not scores:
            raise self._not_understood()
        return [masks[0], scores[0]]

    def _prompts_at_once(self) -> int:
        """How many points the decoder takes, each by itself; 0: any number."""
        number = self._roles["points"].shape[1 if self._nested else 0]
        return number if isinstance(number, int) else 0

    def _not_understood(self) -> ConfigError:
        return ConfigError(
            f"{self._session.path}: not a SAM decoder that is understood. Expected embeddings and point_coords [n, "
            "points, 2] as inputs, point_labels, mask_input, has_mask_input and orig_im_size where it has them, and "
            f"masks with scores as outputs; found {self._session}"
        )


def _role(name: str) -> str:
    """What an input of a decoder is for."""
    lower = name.lower()
    if "mask" in lower:
        return "has mask" if "has" in lower else "mask"
    for word, role in (("label", "labels"), ("point", "points"), ("size", "size")):
        if word in lower:
            return role
    return "embedding"


def _source(value: Any, decoder: OnnxSession, encoder: OnnxSession) -> str:
    """The encoder's output that a decoder's input takes: that of the same name, else the only one of its shape.

    Raises:
        ConfigError: there is none.
    """
    same = [output for output in encoder.outputs if output.name == value.name]
    found = [output for output in same or encoder.outputs if _fits(output.shape, value.shape)]
    if len(found) != 1:
        raise ConfigError(
            f"{decoder.path}: takes {words_of([value])}, which {encoder.path} does not give; it gives "
            f"{words_of(encoder.outputs)}"
        )
    return str(found[0].name)


def _fits(given: Sequence[Any], taken: Sequence[Any]) -> bool:
    """Whether shapes agree where both are numbers."""
    pairs = zip(given, taken, strict=False)
    return len(given) == len(taken) and all(a == b for a, b in pairs if isinstance(a, int) and isinstance(b, int))
