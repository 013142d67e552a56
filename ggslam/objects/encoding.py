# SPDX-License-Identifier: Apache-2.0
"""Writing identity vectors: giving Gaussians a vector that the classifier reads as a certain object.

Needed when people, not training, decide whose a Gaussian is: duplicates get a class of their own, merged objects one in
common.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize

from ggslam.errors import ConfigError
from ggslam.objects.settings import ClassifierTuning
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.tuning import Tuning


class EncodingTuning(Tuning):
    """How an identity vector for an object is found."""

    certain = 0.9
    """Probability from which a vector is an example of its object."""
    directions = 512
    """Directions that are tried for a new class."""
    margin = 4.0
    """Logits by which a new class stays behind the best class of the Gaussians that are there."""


def with_class(classifier: IdentityClassifier, object_id: int, features: np.ndarray) -> IdentityClassifier:
    """The classifier with one class more, which no vector that is there already is mistaken for.

    Of many random directions the one least like those of the other classes is taken; its bias is lowered until
    (nearly) all of the `features` keep their class.

    Args:
        classifier: may be empty.
        object_id: of the new class, 1 to 65535, not yet there.
        features: identity vectors of the map, float32 [N, F].

    Raises:
        ConfigError: the id is taken or impossible.
    """
    if not 1 <= object_id <= 65535 or object_id in classifier.class_ids:
        raise ConfigError(f"object id {object_id}: expected a free one from 1 to 65535")
    channels = classifier.weight.shape[1]
    directions = np.random.default_rng(object_id).normal(size=(EncodingTuning.directions, channels)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = np.linalg.norm(classifier.weight, axis=1)
    weight, bias = directions[0], np.float32(0)
    if len(classifier):
        others = classifier.weight / np.maximum(lengths[:, None], 1e-9)
        weight = directions[(directions @ others.T).max(1).argmin()] * max(float(np.median(lengths)), 1e-3)
        step = max(1, ClassifierTuning.values_at_once // len(classifier))
        parts = [features[start : start + step] for start in range(0, len(features), step)]
        leads = [classifier.logits(part).max(1) - part @ weight for part in parts]
        bias = np.float32(
            (np.quantile(np.concatenate(leads), 1e-3) if parts else classifier.bias.max()) - EncodingTuning.margin
        )
    return IdentityClassifier(
        np.append(classifier.class_ids, np.uint16(object_id)),
        np.concatenate([classifier.weight, weight[None]]), np.append(classifier.bias, bias),
    )  # fmt: skip


def code_of(gaussians: GaussianMap, classifier: IdentityClassifier, object_id: int) -> np.ndarray:
    """An identity vector, float32 [F], that stands for an object: the mean of its certain examples, else computed.

    Raises:
        KeyError: the classifier does not know the object.
    """
    number = classifier.class_of(object_id)
    own = gaussians.features.numpy()[gaussians.object_id.numpy() == object_id]
    certain = classifier.probabilities(own)[:, number] >= EncodingTuning.certain
    if certain.any():
        mean = own[certain].mean(0)
        if classifier.probabilities(mean)[number] >= EncodingTuning.certain:
            return mean
    return _computed_code(classifier, number)


def _computed_code(classifier: IdentityClassifier, number: int) -> np.ndarray:
    """Maximises the log-probability of a class, which is concave in the vector, less a small share of its length."""

    def loss(vector: np.ndarray) -> tuple[float, np.ndarray]:
        probabilities = exact.probabilities(vector)
        gradient = probabilities @ weight - weight[number] + 2e-4 * vector
        return float(-np.log(probabilities[number] + 1e-300) + 1e-4 * vector @ vector), gradient

    weight = classifier.weight.astype(np.float64)
    exact = IdentityClassifier(classifier.class_ids, weight, classifier.bias.astype(np.float64))
    return minimize(loss, np.zeros(weight.shape[1]), jac=True, method="L-BFGS-B").x.astype(np.float32)


def assign(gaussians: GaussianMap, classifier: IdentityClassifier, rows: np.ndarray, object_id: int) -> None:
    """Makes Gaussians (bool [N]) an object's: their labels, and the identity vectors that say otherwise.

    Without a class for the object, or without identity vectors of the classifier's length, only labels change.
    """
    if object_id in classifier.class_ids and gaussians.features.shape[1] == classifier.weight.shape[1]:
        index = np.flatnonzero(rows)
        labels, probability = classifier.labels(gaussians.features.numpy()[index])
        wrong = index[(labels != object_id) | (probability < 0.5)]
        code = code_of(gaussians, classifier, object_id)
        gaussians.features[torch.from_numpy(wrong)] = torch.from_numpy(code)
    gaussians.object_id[torch.from_numpy(rows)] = object_id
