# SPDX-License-Identifier: Apache-2.0
"""The classifier while it is trained on an NVIDIA GPU: `ggslam.mapping.cpu.class_table` with its rows on the device.

Which id has which class is known on the host as well: ids appear and go with keyframes, not with steps.
"""

from __future__ import annotations

import ctypes

import numpy as np
import torch

from ggslam.abi.cuda import MOST_NEW_CLASSES, MOST_NEW_WEIGHTS, NewClassJob
from ggslam.cuda.streams import let_go
from ggslam.cuda.transfers import upload
from ggslam.mapping.class_numbers import ClassNumbers, ClassTuning, new_rows
from ggslam.mapping.cuda.class_learning import ClassKernels
from ggslam.mapping.identity import IDS
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier, IdentityVectorTuning
from ggslam.system.tuning import Tuning


class CudaClassTuning(Tuning):
    """Limits of the classifier on a GPU."""

    logits_at_once = 2**24
    """Logits that are in memory at a time."""


class CudaClassTable:
    """A growing linear classifier with its optimizer.

    Args:
        rng: draws the rows of new classes, as for `CpuClassTable`.
        kernels: of the device.
        channels: length of an identity vector.
    """

    def __init__(
        self, rng: np.random.Generator, kernels: ClassKernels, channels: int = IDENTITY_CHANNELS
    ) -> None:
        self._rng, self._kernels, self._channels, self._device = rng, kernels, channels, kernels.device
        self._numbers = ClassNumbers()
        self._rows = self._zeros(ClassTuning.initial_rows)  # weights, then the bias
        self._moments = (self._zeros(ClassTuning.initial_rows), self._zeros(ClassTuning.initial_rows))
        self._steps = torch.zeros(1, dtype=torch.int32, device=self._device)
        self._ids = torch.zeros(ClassTuning.initial_rows, dtype=torch.int32, device=self._device)
        self.class_of = torch.full((IDS,), -1, dtype=torch.int32, device=self._device)
        """Class number of every object id, int32 [65536], -1 where there is none."""

    @property
    def count(self) -> int:
        """Number of classes."""
        return self._numbers.count

    @property
    def ids(self) -> torch.Tensor:
        """Object id of each class, int32 [count]; a view."""
        return self._ids[: self.count]

    @property
    def rows(self) -> torch.Tensor:
        """Weights, then the bias, of each class, float32 [count, F + 1]; a view."""
        return self._rows[: self.count]

    @property
    def training_arrays(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rows and their two moments, float32 [at least count, F + 1], and the number of steps so far, int32 [1]."""
        return self._rows, *self._moments, self._steps

    @property
    def places(self) -> tuple[int, int]:
        """Of the training arrays: others as soon as they move, or there are more or fewer classes."""
        return self._rows.data_ptr(), self._numbers.count

    @property
    def weight(self) -> torch.Tensor:
        """float32 [count, F]; a view."""
        return self.rows[:, :-1]

    @property
    def classifier(self) -> IdentityClassifier:
        """A copy on the host. Waits for the device."""
        rows = self.rows.to("cpu", copy=True).numpy()
        return IdentityClassifier(self._numbers.ids.copy(), rows[:, :-1], rows[:, -1])

    def classes(self, object_ids: np.ndarray) -> np.ndarray:
        """Class number of each object id, int32 of the same shape; -1 where there is none."""
        return self._numbers.of(object_ids)

    # --- ids that appear and go ---------------------------------------------------------------------------------------

    def add(self, object_ids: np.ndarray) -> None:
        """Makes a class of each id (uint16, distinct) that is not 0 and has none yet."""
        new = self._numbers.add(object_ids)
        if new.stop > len(self._rows):
            extra = max(new.stop, 2 * len(self._rows)) - len(self._rows)
            let_go(self._rows, *self._moments, self._ids)
            self._ids = torch.cat([self._ids, torch.zeros(extra, dtype=torch.int32, device=self._device)])
            self._rows = torch.cat([self._rows, self._zeros(extra)])
            self._moments = (
                torch.cat([self._moments[0], self._zeros(extra)]), torch.cat([self._moments[1], self._zeros(extra)])
            )  # fmt: skip
        self._write(new, new_rows(self._rng, new.stop - new.start, self._channels))

    def _write(self, new: slice, weights: np.ndarray) -> None:
        """Rows of new classes, float32 [n, F], and their ids, for which there is room."""
        job, ids = NewClassJob(channels=self._channels, device=self._device.index or 0), self._numbers.ids
        job.rows, job.ids, job.class_of = self._rows.data_ptr(), self._ids.data_ptr(), self.class_of.data_ptr()
        job.stream = self._kernels.library.stream(self._device)
        at_once = min(MOST_NEW_CLASSES, MOST_NEW_WEIGHTS // self._channels)
        for begin in range(new.start, new.stop, at_once):
            end = min(begin + at_once, new.stop)
            job.first, job.count = begin, end - begin
            job.new_ids[: job.count] = ids[begin:end].tolist()
            job.weights[: job.count * self._channels] = weights[begin - new.start : end - new.start].ravel().tolist()
            self._kernels.library.call("new_classes", ctypes.byref(job))

    def resume(self, classifier: IdentityClassifier) -> None:
        """Takes over the classes of a classifier, with fresh moments."""
        self.add(classifier.class_ids)
        rows = self.rows.to("cpu", copy=True).numpy()
        number = self._numbers.of(classifier.class_ids)
        rows[number, :-1], rows[number, -1] = classifier.weight, classifier.bias
        self.rows.copy_(torch.from_numpy(rows))

    def remove(self, object_id: int) -> None:
        """Forgets a class; the last one takes its place."""
        number = self._numbers.remove(object_id)
        if number is None:
            return
        for array in (self._rows, *self._moments):
            array[number] = array[self.count]
            array[self.count] = 0
        self._tell_numbers()

    def _tell_numbers(self) -> None:
        self.ids.copy_(upload(self._numbers.ids.astype(np.int32), self._device))
        self.class_of.copy_(upload(self._numbers.table, self._device))

    # --- vectors ------------------------------------------------------------------------------------------------------

    def codes(self, object_ids: torch.Tensor) -> torch.Tensor:
        """Identity vectors that the classifier takes for these objects (int32 [M] on the device), float32 [M, F]; zeros
        for those without a class."""
        codes = (
            ClassTuning.code_length
            * self.weight
            / torch.linalg.vector_norm(self.weight, dim=1, keepdim=True).clamp_min(1e-12)
        )
        padded = torch.cat([torch.zeros(1, self._channels, device=self._device), codes])
        return padded[self.class_of[object_ids.long()].long() + 1]

    def logits(self, features: torch.Tensor) -> torch.Tensor:
        """float32 [M, C] of identity vectors [M, F]."""
        return torch.addmm(self.rows[:, -1], features, self.weight.T)

    def labels(self, features: torch.Tensor, min_confidence: float = 0.0) -> torch.Tensor:
        """Most probable object of each identity vector [N, F], int32 [N]; 0 where nothing is more probable than every
        object, and below `min_confidence`."""
        out = torch.zeros(len(features), dtype=torch.int32, device=self._device)
        part = max(1, CudaClassTuning.logits_at_once // max(1, self.count))
        for begin in range(0, len(features) if self.count else 0, part):
            logits = self.logits(features[begin : begin + part])
            highest, best = logits.max(1)
            probability = 1 / (
                (logits - highest[:, None]).exp().sum(1) + (IdentityVectorTuning.nothing_logit - highest).exp()
            )
            something = (highest > IdentityVectorTuning.nothing_logit) & (probability >= min_confidence)
            out[begin : begin + part] = torch.where(something, self.ids[best], 0)
        return out

    def members(
        self, features: torch.Tensor, object_ids: np.ndarray, rivals: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Vectors [N, F] that are more probably one of some objects (with classes, [K]) than nothing and than a rival
        of their own (int32 [N]; without a class: none): bool [N], and the likeliest of `object_ids`, int32 [N]."""
        best = torch.full((len(features),), IdentityVectorTuning.nothing_logit, device=self._device)
        which = torch.zeros(len(features), dtype=torch.int32, device=self._device)
        for object_id, number in zip(object_ids.tolist(), self._numbers.of(object_ids).tolist(), strict=True):
            logits = torch.mv(features, self._rows[number, :-1]) + self._rows[number, -1]
            which.masked_fill_(logits > best, object_id)
            best = torch.maximum(best, logits)
        rival = self.class_of[rivals.long()].long()
        rows = self.rows[rival.clamp_min(0)]
        of_rival = (features * rows[:, :-1]).sum(1) + rows[:, -1]
        return (best > IdentityVectorTuning.nothing_logit) & ((rival < 0) | (of_rival < best)), which

    # --- training -----------------------------------------------------------------------------------------------------

    def cross_entropy(
        self, features: torch.Tensor, targets: torch.Tensor, known: torch.Tensor, losses: torch.Tensor, weight: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Softmax cross-entropy over all classes, see `ClassKernels.cross_entropy`.

        Args:
            features: float32 [P, F].

        Returns:
            The gradients of the weighted loss by the features [P, F] and by the rows [C, F + 1].
        """
        ones = torch.ones(len(features), 1, device=self._device)
        extended = torch.cat([features, ones], 1)
        logits = torch.mm(extended, self.rows.T)
        self._kernels.cross_entropy(logits, targets, known, losses, weight)
        return torch.mm(logits, self.weight), torch.mm(logits.T, extended)

    def step(self, gradients: torch.Tensor, known: torch.Tensor, rate: float) -> None:
        """Adam on all rows with gradients [C, F + 1]; none if `known` (int32 [1]) is 0."""
        self._kernels.adam(self.rows, self._moments, gradients, known, self._steps, rate)

    def _zeros(self, classes: int) -> torch.Tensor:
        return torch.zeros(classes, self._channels + 1, device=self._device)
