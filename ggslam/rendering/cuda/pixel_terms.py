# SPDX-License-Identifier: Apache-2.0
"""Sampled compositing on an NVIDIA GPU: `ggslam.rendering.pixel_terms` with tensors in place of arrays.

Work is only started, on torch's current stream, and nothing waits for the device: sizes are those that the caller gave,
however many terms are in use. Every sum has a fixed order, so that the same terms give the same result bit for bit.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, field
from typing import Final

import torch

from ggslam.abi.arrays import address
from ggslam.abi.cuda import AdamStep, PixelTerms, Rendering, TermsByGaussian
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.rendering.adam import ADAM_GROUPS
from ggslam.rendering.cuda.adam import adam_arrays
from ggslam.rendering.pixel_terms import MAX_CHANNELS, FeatureAdamSettings
from ggslam.scene.gaussian_map import VOTE_SLOTS, GaussianMap

_MAX_PLACES: Final = 2**31 - 1
"""Largest number of terms: kernels number them in 31 bits."""


@dataclass(frozen=True, eq=False)
class CudaPixelTerms:
    """The terms of P pixels, on the device. What is in the tensors must not be changed.

    Attributes:
        gaussians: int32 [P, capacity], rows in the map; the first `counts[p]` of row p are in use, front to back, the
            others are 0.
        weights: float32 [P, capacity], rendering weights; 0 where not in use.
        counts: int32 [P].
        library: the compiled kernels.
    """

    gaussians: torch.Tensor
    weights: torch.Tensor
    counts: torch.Tensor
    library: CudaLibrary
    _sorted: dict[int, list[torch.Tensor]] = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def empty(pixels: int, capacity: int, library: CudaLibrary, device: torch.device) -> CudaPixelTerms:
        """Room for terms; all undefined.

        Raises:
            RenderError: capacity below 1, or 2^31 places and more.
        """
        if capacity < 1:
            raise RenderError(f"capacity must be at least 1, found {capacity}")
        if pixels * capacity > _MAX_PLACES:
            raise RenderError(f"terms: {pixels} pixels times {capacity} are more than {_MAX_PLACES}")
        return CudaPixelTerms(
            torch.empty(pixels, capacity, dtype=torch.int32, device=device),
            torch.empty(pixels, capacity, dtype=torch.float32, device=device),
            torch.empty(pixels, dtype=torch.int32, device=device),
            library,
        )

    @staticmethod
    def of_gaussians(rows: torch.Tensor, capacity: int, library: CudaLibrary) -> CudaPixelTerms:
        """Pseudo-pixels that show one Gaussian each, with weight 1: `rows` [M], integers on the device."""
        terms = CudaPixelTerms.empty(len(rows), capacity, library, rows.device)
        rows = rows.to(torch.int32).contiguous()
        terms._call("of_gaussians", address(rows))
        return terms

    @staticmethod
    def of_rendering(
        rendering: Rendering, pixels: torch.Tensor, capacity: int, min_weight: float, library: CudaLibrary
    ) -> CudaPixelTerms:
        """See `CudaRasterizer.pixel_terms`; the memory that `rendering` works in must still be there."""
        if pixels.dtype != torch.int32 or pixels.ndim != 1 or not pixels.is_contiguous():
            raise RenderError(
                f"pixels: expected a contiguous torch.int32 [P], found {pixels.dtype} {list(pixels.shape)}"
            )
        terms = CudaPixelTerms.empty(len(pixels), capacity, library, pixels.device)
        terms.collect(rendering, pixels, min_weight)
        return terms

    def collect(self, rendering: Rendering, pixels: torch.Tensor, min_weight: float) -> None:
        """In terms that are `empty`, or those of other renderings, writes those of a rendering; see `of_rendering`."""
        self._call("collect", rendering, address(pixels), min_weight)

    def append(self, other: CudaPixelTerms) -> CudaPixelTerms:
        """These pixels followed by those of `other`, which must have the same capacity."""
        if self.capacity != other.capacity:
            raise RenderError(f"joined: terms with room for {self.capacity} and for {other.capacity}")
        return CudaPixelTerms(
            torch.cat([self.gaussians, other.gaussians]), torch.cat([self.weights, other.weights]),
            torch.cat([self.counts, other.counts]), self.library,
        )  # fmt: skip

    def __len__(self) -> int:
        return self.counts.shape[0]

    @property
    def capacity(self) -> int:
        """Terms that a pixel has room for."""
        return self.gaussians.shape[1]

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.counts.device

    # --- at the pixels -----------------------------------------------------------------------------------------------

    def opacity(self) -> torch.Tensor:
        """Sum of the weights, float32 [P]."""
        return self.weights.sum(1)

    def features(self, gaussians: GaussianMap) -> torch.Tensor:
        """Rendered features, float32 [P, F]."""
        channels = self._checked_channels(gaussians)
        out = torch.empty(len(self), channels, dtype=torch.float32, device=self.device)
        self._call("blend", address(gaussians.features), len(gaussians), channels, address(out))
        return out

    def labels(self, gaussian_labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The label with the largest rendering weight at each pixel, int32 [P], and its share, float32 [P].

        Args:
            gaussian_labels: label of each Gaussian of the map, int32 [N]. A Gaussian beyond it counts as labelled 0.
        """
        self._check("gaussian_labels", gaussian_labels, torch.int32, (len(gaussian_labels),))
        ids = torch.empty(len(self), dtype=torch.int32, device=self.device)
        shares = torch.empty(len(self), dtype=torch.float32, device=self.device)
        self.label(gaussian_labels, ids, shares)
        return ids, shares

    def label(self, gaussian_labels: torch.Tensor, ids: torch.Tensor, shares: torch.Tensor) -> None:
        """As `labels`, to memory of the caller's."""
        self._call("label", address(gaussian_labels), len(gaussian_labels), address(ids), address(shares))

    # --- at the Gaussians --------------------------------------------------------------------------------------------

    def step(self, gaussians: GaussianMap, gradient: torch.Tensor, optimizer: FeatureAdamSettings) -> None:
        """One Adam step on the features of the Gaussians that appear in the terms, in place.

        Args:
            gaussians: the map, with moments; unchanged in number and order since the terms were made.
            gradient: d loss / d rendered features, float32 [P, F].
            optimizer: rates.

        Raises:
            RenderError: wrong shape, type or device, no moments.
        """
        channels = self._checked_channels(gaussians)
        self._check("gradient", gradient, torch.float32, (len(self), channels))
        if not gaussians.with_moments:
            raise RenderError("step: the map was made without moments")
        adam = feature_step(gaussians, optimizer)
        self._call("step", self._by_gaussian(len(gaussians)), address(gradient), channels, adam)

    def vote(self, gaussians: GaussianMap, labels: torch.Tensor, pixel_weights: torch.Tensor | None = None) -> None:
        """Adds the pixels' weights to the votes of their Gaussians.

        Args:
            gaussians: the map; `vote_ids` and `vote_weights` are changed.
            labels: object id seen at each pixel, int32 [P]; 0 votes for nothing. Also int32 [L] for the first L pixels
                alone: terms that others were joined to are then sorted once for vote and step.
            pixel_weights: how much each of these pixels counts, float32 [P] or [L]; None: 1.

        Raises:
            RenderError: wrong shape, type or device, a map without slots for votes.
        """
        labelled = min(labels.numel(), len(self))
        self._check("labels", labels, torch.int32, (labelled,))
        self._check("vote_ids", gaussians.vote_ids, torch.int32, (len(gaussians), VOTE_SLOTS))
        if pixel_weights is not None:
            self._check("pixel_weights", pixel_weights, torch.float32, (labelled,))
        self._call(
            "vote", self._by_gaussian(len(gaussians)), address(labels), address(pixel_weights), labelled,
            address(gaussians.vote_ids), address(gaussians.vote_weights),
        )  # fmt: skip

    def weight_sums(self, count: int, pixel_weights: torch.Tensor | None = None) -> torch.Tensor:
        """Each Gaussian's weights, summed over the pixels, float32 [count].

        Args:
            count: Gaussians in the map.
            pixel_weights: how much each pixel counts, float32 [P]; None: 1.
        """
        if pixel_weights is not None:
            self._check("pixel_weights", pixel_weights, torch.float32, (len(self),))
        sums = torch.zeros(count, dtype=torch.float32, device=self.device)
        self._call("sum", self._by_gaussian(count), address(pixel_weights), address(sums))
        return sums

    # --- the C interface ---------------------------------------------------------------------------------------------

    def native(self) -> PixelTerms:
        """As the library takes them, on torch's current stream."""
        return PixelTerms(
            len(self), address(self.gaussians), address(self.weights), address(self.counts),
            self.library.stream(self.device), self.capacity, self.device.index or 0,
        )  # fmt: skip

    def _call(self, name: str, *arguments: object) -> None:
        """Calls ggslam_cuda_terms_<name> for these terms; structures are passed by their address."""
        terms = self.native()
        given = [ctypes.byref(value) if isinstance(value, ctypes.Structure) else value for value in arguments]
        self.library.call(f"terms_{name}", ctypes.byref(terms), *given)

    def _by_gaussian(self, count: int) -> TermsByGaussian:
        """The terms of a map of `count` Gaussians sorted by Gaussian; sorted once, for all that use them."""
        size = len(self) * self.capacity
        known = count in self._sorted
        if not known:
            self._sorted[count] = [torch.empty(size, dtype=torch.int32, device=self.device) for _ in range(2)]
        rows, places = self._sorted[count]
        by_gaussian = TermsByGaussian(address(rows), address(places), size, count)
        if not known:
            room = self.library.functions.ggslam_cuda_terms_sorting_bytes(size)
            workspace = torch.empty(room, dtype=torch.uint8, device=self.device)
            self._call("sort", by_gaussian, address(workspace))
        return by_gaussian

    def _check(self, name: str, tensor: torch.Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
        if tuple(tensor.shape) != shape or tensor.dtype != dtype or tensor.device != self.device:
            expected = f"{dtype} {list(shape)} on {self.device}"
            found = f"{tensor.dtype} {list(tensor.shape)} on {tensor.device}"
            raise RenderError(f"{name}: expected {expected}, found {found}")
        if not tensor.is_contiguous():
            raise RenderError(f"{name}: expected a contiguous tensor, found strides {tensor.stride()}")

    def _checked_channels(self, gaussians: GaussianMap) -> int:
        channels = gaussians.features.shape[1]
        if not 1 <= channels <= MAX_CHANNELS:
            raise RenderError(f"features: expected 1 to {MAX_CHANNELS} channels, found {channels}")
        self._check("features", gaussians.features, torch.float32, (len(gaussians), channels))
        return channels


def feature_step(gaussians: GaussianMap, optimizer: FeatureAdamSettings) -> AdamStep:
    """The step of the features alone: no rate decays, and it is their own updates that count."""

    def logarithm(factor: float) -> float:
        return math.log(factor) if factor > 0 else -math.inf

    storage = gaussians.storage
    step = AdamStep(
        features=adam_arrays(storage, "features"), updates=address(storage["feature_updates"]), decayed_groups=0,
        log_decay=0.0, decay_floor=1.0, beta1=optimizer.beta1, beta2=optimizer.beta2,
        log_beta1=logarithm(optimizer.beta1), log_beta2=logarithm(optimizer.beta2), epsilon=optimizer.epsilon,
    )  # fmt: skip
    step.rates[ADAM_GROUPS.index("features")] = optimizer.rate
    return step
