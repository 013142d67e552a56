# SPDX-License-Identifier: Apache-2.0
"""Sampled compositing of one scene on the CPU and by the CUDA kernels."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from rendering_scenes import CAMERA, POSE

from ggslam.cuda.library import CudaLibrary
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.pixel_terms import CpuPixelTerms, FeatureAdamSettings
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.gaussian_map import GaussianMap

SIZE = CAMERA.width * CAMERA.height
ALL = np.arange(SIZE, dtype=np.int32)
RATES = FeatureAdamSettings()


def make_map(scene: GaussianTensors, device: torch.device | str = "cpu") -> GaussianMap:
    gaussians = GaussianMap(0, scene.features.shape[1], torch.device(device))
    parameters = [getattr(scene, name) for name in ("means", "quaternions", "log_scales", "opacity_logits")]
    gaussians.insert(*(p.to(device) for p in (*parameters, 0.5 + 0 * scene.means, scene.features)))
    return gaussians


def copied(gaussians: GaussianMap, device: torch.device | str) -> GaussianMap:
    """The same parameters and votes, moments zero."""
    parameters = {f.name: getattr(gaussians, f.name).cpu() for f in dataclasses.fields(GaussianTensors)}
    copy = make_map(GaussianTensors(**parameters), device)
    copy.vote_ids[:], copy.vote_weights[:] = gaussians.vote_ids.to(device), gaussians.vote_weights.to(device)
    return copy


class Both:
    """The same scene rendered on the CPU and by the CUDA kernels."""

    def __init__(self, library: CudaLibrary, scene: GaussianTensors) -> None:
        self.device = library.whole_device(None)
        self.map, self.device_map = make_map(scene), make_map(scene, self.device)
        self.cpu, self.cuda = CpuRasterizer(1), CudaRasterizer(self.device, library=library)
        self.cpu.forward(self.map, CAMERA, POSE, features=False)
        self.view = self.cuda.forward(self.device_map, CAMERA, POSE, features=False)

    def cuda_terms(self, pixels: np.ndarray, capacity: int, min_weight: float) -> CudaPixelTerms:
        return self.cuda.pixel_terms(torch.from_numpy(pixels).to(self.device), capacity, min_weight)

    def equal_terms(self, pixels: np.ndarray, capacity: int = 32) -> tuple[CpuPixelTerms, CudaPixelTerms]:
        """Terms of the CUDA kernels, and the same for the CPU."""
        terms = self.cuda_terms(pixels, capacity, 1e-3)
        return on_cpu(terms, self.cpu), terms

    def given(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device)


def on_cpu(terms: CudaPixelTerms, rasterizer: CpuRasterizer) -> CpuPixelTerms:
    arrays = [array.cpu().numpy().copy() for array in (terms.gaussians, terms.weights, terms.counts)]
    return CpuPixelTerms(*arrays, rasterizer.context)
