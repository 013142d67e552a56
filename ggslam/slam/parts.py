# SPDX-License-Identifier: Apache-2.0
"""Constructs the parts of a run according to its settings."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from dataclasses import dataclass
from pathlib import Path

import torch

from ggslam.cuda.library import CudaLibrary, library_for_device
from ggslam.errors import ConfigError, InputError, MissingDependency
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.mapper import Mapper
from ggslam.movers.cuda.evidence import CudaEvidence
from ggslam.movers.evidence import EvidenceSource, HostEvidence
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.slam.config import Config
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.map_paging import MapPager
from ggslam.slam.memory_budget import MB, MemoryBudget
from ggslam.slam.modes import Mode, refuse
from ggslam.slam.object_masks import ObjectMasks
from ggslam.system.tuning import Tuning
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.features import CudaFeatures
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import Tracker


class ImageLimits(Tuning):
    """Images that a run refuses."""

    min_side_pixels = 16
    """Smallest width and height, in pixels. Below it, no window for normals and no tile fits."""


@dataclass
class RunParts:
    """The parts of a run.

    Attributes:
        context: threads of the CPU.
        masks: of objects.
        tracker: locates frames.
        evidence: compares them to find what moves.
        mapper: builds the map.
        surface: what frames are aligned to.
        pager: keeps the run within its limit of memory; None without one.
        loops: finds loops and lost frames; None if the settings do not want it.
        on_device: whether the map is on a GPU.
        notes: what the user should know of the choice.
    """

    context: NativeContext
    masks: ObjectMasks
    tracker: Tracker
    evidence: EvidenceSource
    mapper: Mapper
    surface: MeasuredSurface
    pager: MapPager | None
    loops: LoopCloser | None
    on_device: bool
    notes: list[str]


def make_parts(
    camera: Camera, config: Config, has_masks: bool | None, paging: Path | None, library: CudaLibrary | None,
    compact: bool = True,
) -> RunParts:  # fmt: skip
    """The parts that the settings name; arguments and errors as of `Slam`, `compact` as of `make_mapper`."""
    if min(camera.width, camera.height) < ImageLimits.min_side_pixels:
        size = f"{camera.width}x{camera.height}"
        raise ConfigError(
            f"images of {size} pixels are too small: at least {ImageLimits.min_side_pixels} each way are needed"
        )
    context, masks, notes = NativeContext(config.threads or None), ObjectMasks(config.masks, has_masks), []
    if library is None:
        library, reason = run_library(config)
        notes += [reason] if reason else []
    tracker = make_tracker(camera, config, context, library)
    pager = make_pager(camera, config, paging)
    surface = MeasuredSurface(config.tracking.target, context, None if pager is None else pager.archive)
    surface.finish = library is None  # a device makes the voxels' shapes itself
    surface.prepare = tracker.expect_target
    loops = LoopCloser(camera, config.loops, surface, tracker, context) if config.loops.enabled else None
    mapper = make_mapper(config, masks.active, context, library, compact)
    if pager is not None:
        pager.serve(mapper)
    evidence = make_evidence(tracker, library)
    return RunParts(context, masks, tracker, evidence, mapper, surface, pager, loops, library is not None, notes)


def run_library(config: Config) -> tuple[CudaLibrary | None, str | None]:
    """The CUDA kernels that a run computes with; None: it computes on the CPU. And why it does, if the settings left
    that open.

    Raises:
        ConfigError: the settings name a device that cannot be had, or one that does not go with other settings.
    """
    if config.device == "cpu":
        return None, None
    try:
        refuse(Mode.GPU, config)
        return library_for_device(), None
    except (ConfigError, MissingDependency) as error:
        if config.device == "auto":
            return None, f"device: auto: on the CPU: {error}"
        raise ConfigError(f"device: cuda: {error}") from None


def device_name(device: torch.device) -> str:
    """What people call it: "cpu", or the GPU's name."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def make_mapper(
    config: Config, learns: bool, context: NativeContext, library: CudaLibrary | None, compact: bool = True
) -> Mapper:
    """A mapper with an empty map.

    Args:
        config: of the run.
        learns: whether there can be object masks to learn from.
        context: threads of the CPU.
        library: CUDA kernels to compute with; None: on the CPU.
        compact: whether identity vectors may have compact moments: they are never trained with everything else.
    """
    learns = learns and config.identity.enabled
    channels, degree = IDENTITY_CHANNELS if learns else 0, max(0, config.sh_degree)
    if library is None:
        learner = CpuIdentityLearner(config.identity, config.seed) if learns else None
        compact = compact and learns and not config.identity.renders_images
        gaussians = GaussianMap(degree, channels, compact_features=compact)
        mapper = CpuMapper(gaussians, config.mapping, context, config.seed, learner)
        mapper.fits_view_colors = config.fits_view_colors
        return mapper
    device = library.whole_device(None)
    device_learner = CudaIdentityLearner(config.identity, config.seed, device, library) if learns else None
    on_device = CudaMapper(
        GaussianMap(degree, channels, device), config.mapping, library, config.seed, device_learner, context
    )
    on_device.fits_view_colors = config.fits_view_colors
    return on_device


def make_tracker(camera: Camera, config: Config, context: NativeContext, library: CudaLibrary | None) -> Tracker:
    """The front-end that the settings name.

    Args:
        camera: of all frames.
        config: of the run.
        context: threads of the CPU.
        library: CUDA kernels to align with; None: on the CPU.
    """
    engine = None if library is None else CudaTrackingEngine(camera, library.whole_device(None), library)
    if config.tracker == "edges_planes":
        features = None if engine is None else CudaFeatures(config.edges_planes, engine)
        return FeatureTracker(camera, config.tracking, config.edges_planes, context, engine=features)
    return GicpTracker(camera, config.tracking, context, engine=engine)


def make_evidence(tracker: Tracker, library: CudaLibrary | None) -> EvidenceSource:
    """What compares frames to find what moves: where the tracker has their depth."""
    engine: object = tracker.engine if isinstance(tracker, GicpTracker) else None
    if isinstance(tracker, FeatureTracker):
        engine = tracker.device_engine
    if library is None or not isinstance(engine, CudaTrackingEngine | CudaFeatures):
        return HostEvidence()
    return CudaEvidence(engine, library, engine.device)


def make_pager(camera: Camera, config: Config, folder: Path | None) -> MapPager | None:
    """Keeps the run within its limit of memory; None if it has none."""
    if not config.memory_limit_mb:
        return None
    budget = MemoryBudget(int(config.memory_limit_mb * MB), int(config.paging.budget_mb * MB))
    pager = MapPager(camera, config.paging, budget, folder or Path(tempfile.mkdtemp(prefix="ggslam-")))
    if folder is None:
        weakref.finalize(pager, shutil.rmtree, pager.folder, ignore_errors=True)
    return pager


def check_arguments(camera: object, config: object, extra_loss: object) -> None:
    """Raises InputError unless they are a camera, settings and a function."""
    if not isinstance(camera, Camera):
        hint = "; its attribute camera is one" if isinstance(getattr(camera, "camera", None), Camera) else ""
        raise InputError(f"Slam: camera: expected a Camera, found {type(camera).__name__}{hint}")
    if config is not None and not isinstance(config, Config):
        hint = "; Config(**values) makes one of a dict" if isinstance(config, dict) else ""
        raise InputError(f"Slam: config: expected a Config, found {type(config).__name__}{hint}")
    if extra_loss is not None and not callable(extra_loss):
        raise InputError(f"Slam: extra_loss: expected a function, found {extra_loss!r}")
