# SPDX-License-Identifier: Apache-2.0
"""The parts of a run that its settings choose."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from pathlib import Path

import torch

from ggslam.cuda.library import CudaLibrary, library_for_device
from ggslam.errors import ConfigError, MissingDependency
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.mapper import Mapper
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.slam.config import Config
from ggslam.slam.map_paging import MapPager
from ggslam.slam.memory_budget import MB, MemoryBudget
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.tracker import Tracker


def run_library(config: Config) -> tuple[CudaLibrary | None, str | None]:
    """The CUDA kernels that a run computes with; None: it computes on the CPU. And why it does, if the settings left
    that open.

    Raises:
        ConfigError: the settings name a device that cannot be had, or one that does not go with other settings.
    """
    if config.device == "cpu":
        return None, None
    try:
        if config.memory_limit_mb:
            raise ConfigError("a run with a limit of memory (memory_limit_mb) needs cpu")
        return library_for_device(), None
    except (ConfigError, MissingDependency) as error:
        if config.device == "auto":
            return None, f"device: auto: on the CPU: {error}"
        raise ConfigError(f"device: cuda: {error}") from None


def device_name(device: torch.device) -> str:
    """What people call it: "cpu", or the GPU's name."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def make_mapper(config: Config, learns: bool, context: NativeContext, library: CudaLibrary | None) -> Mapper:
    """A mapper with an empty map.

    Args:
        config: of the run.
        learns: whether there can be object masks to learn from.
        context: threads of the CPU.
        library: CUDA kernels to compute with; None: on the CPU.
    """
    learns = learns and config.identity.enabled
    channels = IDENTITY_CHANNELS if learns else 0
    if library is None:
        learner = CpuIdentityLearner(config.identity, config.seed) if learns else None
        return CpuMapper(GaussianMap(config.sh_degree, channels), config.mapping, context, config.seed, learner)
    device = library.whole_device(None)
    device_learner = CudaIdentityLearner(config.identity, config.seed, device, library) if learns else None
    return CudaMapper(
        GaussianMap(config.sh_degree, channels, device), config.mapping, library, config.seed, device_learner
    )


def make_tracker(camera: Camera, config: Config, context: NativeContext, library: CudaLibrary | None) -> Tracker:
    """The front-end that the settings name.

    Args:
        camera: of all frames.
        config: of the run.
        context: threads of the CPU.
        library: CUDA kernels to align with; None: on the CPU, where features are tracked in any case.
    """
    if config.tracker == "features":
        return FeatureTracker(camera, config.tracking, config.features, context)
    engine = None if library is None else CudaTrackingEngine(camera, library.whole_device(None), library)
    return GicpTracker(camera, config.tracking, context, engine=engine)


def make_pager(camera: Camera, config: Config, folder: Path | None) -> MapPager | None:
    """Who keeps a run within its limit of memory, if it has one."""
    if not config.memory_limit_mb:
        return None
    budget = MemoryBudget(int(config.memory_limit_mb * MB), int(config.paging.budget_mb * MB))
    pager = MapPager(camera, config.paging, budget, folder or Path(tempfile.mkdtemp(prefix="ggslam-")))
    if folder is None:
        weakref.finalize(pager, shutil.rmtree, pager.folder, ignore_errors=True)
    return pager
