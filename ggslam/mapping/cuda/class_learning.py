# SPDX-License-Identifier: Apache-2.0
"""The losses of identity learning and the classifier's optimizer on an NVIDIA GPU, by kernels that are only started
here: `cross_entropy` of `identity.py`, `kl_gradient` of `neighbours.py` and `CpuClassTable.step`."""

from __future__ import annotations

import ctypes

import torch

from ggslam.abi.cuda import ClassAdamJob, CrossEntropyJob, NeighbourLossJob, PixelClassJob
from ggslam.cuda.library import CudaLibrary


class ClassKernels:
    """Kernels on tensors of one device. All tensors are contiguous; the caller sees to shapes and types.

    Args:
        device: where tensors are.
        library: the compiled kernels.
    """

    def __init__(self, device: torch.device, library: CudaLibrary) -> None:
        self.device, self.library = device, library

    def labels(self, mask: torch.Tensor, pixels: torch.Tensor, alias: torch.Tensor) -> torch.Tensor:
        """Current object ids, int32 [P], of `pixels` (int32 [P]) of a mask (uint16 [H, W]), by `alias` (int32
        [65536])."""
        labels = torch.empty_like(pixels)
        job = PixelClassJob(
            mask=mask.data_ptr(), pixels=pixels.data_ptr(), alias=alias.data_ptr(), labels=labels.data_ptr()
        )
        self._call("pixel_labels", job, count=len(pixels))
        return labels

    def classes(self, labels: torch.Tensor, class_of: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Class numbers, int32 [P], -1 where there is none, of labels (int32 [P]) by `class_of` (int32 [65536]), and
        how many have one, int32 [1]."""
        classes = torch.empty_like(labels)
        known = torch.empty(1, dtype=torch.int32, device=self.device)
        job = PixelClassJob(
            class_of=class_of.data_ptr(), labels=labels.data_ptr(), classes=classes.data_ptr(), known=known.data_ptr()
        )
        self._call("pixel_classes", job, count=len(labels))
        return classes, known

    def cross_entropy(
        self, logits: torch.Tensor, targets: torch.Tensor, known: torch.Tensor, losses: torch.Tensor, weight: float
    ) -> None:
        """Softmax cross-entropy, with being nothing as one class more.

        Args:
            logits: float32 [P, C]; become the gradient of `weight` / `known` times the sum of the losses.
            targets: int32 [P], true classes; -1 counts nothing.
            known: int32 [1].
            losses: float32 [P], are written.
        """
        job = CrossEntropyJob(
            logits=logits.data_ptr(), targets=targets.data_ptr(), known=known.data_ptr(), losses=losses.data_ptr(),
            weight=weight, classes=logits.shape[1],
        )  # fmt: skip
        self._call("cross_entropy", job, count=logits.shape[0])

    def neighbour_loss(self, logits: torch.Tensor, samples: int, weight: float) -> torch.Tensor:
        """Gradient, shaped like `logits`, of `weight` times the mean of KL(P || Q) over samples and their neighbours.

        Args:
            logits: float32 [samples * (1 + k), C]: the samples', then sample by sample their k neighbours'.
        """
        gradients = torch.empty_like(logits)
        job = NeighbourLossJob(
            logits=logits.data_ptr(), gradients=gradients.data_ptr(), weight=weight, samples=samples,
            neighbours=logits.shape[0] // samples - 1, classes=logits.shape[1],
        )  # fmt: skip
        self._call("neighbour_loss", job)
        return gradients

    def adam(
        self, rows: torch.Tensor, moments: tuple[torch.Tensor, torch.Tensor], gradients: torch.Tensor,
        known: torch.Tensor, steps: torch.Tensor, rate: float,
    ) -> None:  # fmt: skip
        """Adam (0.9, 0.999) on float32 rows [C, F + 1]; none if `known` (int32 [1]) is 0. Counts in `steps` (int32
        [1])."""
        job = ClassAdamJob(
            rows=rows.data_ptr(), first_moments=moments[0].data_ptr(), second_moments=moments[1].data_ptr(),
            gradients=gradients.data_ptr(), known=known.data_ptr(), steps=steps.data_ptr(), rate=rate,
            size=rows.numel(),
        )  # fmt: skip
        self._call("class_adam", job)

    def _call(self, name: str, job: ctypes.Structure, **more: int) -> None:
        for field, value in more.items():
            setattr(job, field, value)
        job.stream, job.device = self.library.stream(self.device), self.device.index or 0  # type: ignore[attr-defined]
        self.library.call(name, ctypes.byref(job))
