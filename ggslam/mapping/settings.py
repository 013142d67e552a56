# SPDX-License-Identifier: Apache-2.0
"""Settings of the mapper. The defaults are one recipe for all recordings; scripts/bench_slam.py shows what it does."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ggslam.errors import ConfigError, check_ranges


@dataclass(frozen=True)
class InsertionSettings:
    """Where new Gaussians are born and what they look like."""

    alpha_threshold: float = 0.6
    """A pixel whose rendered alpha is below this is not yet explained by the map."""
    depth_tolerance_m: float = 0.05
    """A pixel whose measured depth lies this much in front of the rendered depth is not explained either..."""
    depth_tolerance_relative: float = 0.03
    """...or this share of the depth, whichever is larger."""
    opacity: float = 0.5
    """Opacity at birth."""
    scale_pixels: float = 0.5
    """Standard deviation at birth along the surface, in pixels of the frame that inserts it (times the stride)."""
    flatness: float = 1.0
    """Standard deviation along the surface normal as a share of that along the surface. Flat discs (0.2) cost 0.5 dB
    at 4 iterations a frame: a Gaussian that is thick at birth is still seen from the side."""
    max_slope: float = 3.0
    """How far a footprint may be stretched along a surface seen at a grazing angle."""
    adaptive_stride: bool = True
    """One Gaussian per 2x2 pixels where colour and depth are smooth, one per pixel elsewhere."""
    texture_threshold: float = 90.0
    """For `adaptive_stride`: Sobel magnitude of the grey image (0 to 255) under which a pixel is flat."""
    fill_stride: int = 3
    """Pixels without depth, where nothing is rendered either, get a Gaussian on a grid of this stride at the depth of
    the nearest pixel that has one; 0: none. Training with colour then makes them fit what is seen there."""
    max_depth_m: float = 20.0
    """Farther measurements do not become Gaussians."""

    def __post_init__(self) -> None:
        ranges = {
            "alpha_threshold": (0, 1), "depth_tolerance_m": (0, 1e3), "depth_tolerance_relative": (0, 1),
            "opacity": (1e-3, 0.999), "scale_pixels": (1e-2, 100), "flatness": (1e-3, 1), "max_slope": (1, 100),
            "texture_threshold": (0, 1e4), "fill_stride": (0, 1000), "max_depth_m": (0.05, 1e4),
        }  # fmt: skip
        check_ranges(self, ranges)


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes of each group of parameters."""

    means: float = 6e-4
    """Of the means, metres."""
    quaternions: float = 4e-3
    log_scales: float = 5e-2
    opacity_logits: float = 5e-2
    sh_dc: float = 1.8e-2
    sh_rest: float = 5e-4
    features: float = 1e-2
    """Of the other parameters, by the names that they have in the map; `sh_dc` is the coefficient of degree 0."""
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-15
    """Adam's decay rates of the two moments, and what is added to the root of the second."""
    young_factor: float = 3.0
    """A Gaussian's first step is this much longer..."""
    young_updates: int = 8
    """...and the rates fall to their values over this many of its steps."""

    def __post_init__(self) -> None:
        groups = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest", "features")
        check_ranges(self, dict.fromkeys(groups, (0.0, 10.0)))
        betas = {"beta1": (0.0, 0.9999), "beta2": (0.0, 0.99999), "epsilon": (1e-30, 1.0)}
        check_ranges(self, {**betas, "young_factor": (1, 100), "young_updates": (1, 10**4)})


@dataclass(frozen=True)
class PruningSettings:
    """Which Gaussians are dropped, and how often one looks."""

    every_keyframes: int = 5
    """One looks after every n-th keyframe."""
    min_opacity: float = 0.05
    """Fainter Gaussians are dropped."""
    max_scale_m: float = 0.25
    """Larger Gaussians are dropped."""

    def __post_init__(self) -> None:
        check_ranges(self, {"every_keyframes": (1, 10**6), "min_opacity": (1e-6, 0.999), "max_scale_m": (1e-4, 1e4)})


@dataclass(frozen=True)
class PoseRefinementSettings:
    """Refinement of keyframe poses through the renderer's pose gradient (Adam on the twist).

    The steps go with the noise of the depth camera: where depth is exact, tracking leaves nothing to refine, and the
    steps would only shake the map.
    """

    enabled: bool = True
    rate_sigmas: float = 0.1
    """Step in standard deviations of the depth noise at the scene's median depth: metres, and radians times 1 m."""
    max_rate: float = 5e-4
    """Upper bound of the step."""

    def __post_init__(self) -> None:
        check_ranges(self, {"rate_sigmas": (0, 100), "max_rate": (0, 1)})


@dataclass(frozen=True)
class ExposureSettings:
    """Per-keyframe affine colour (gain and offset per channel), pulled towards the identity."""

    enabled: bool = False
    """Whether keyframes get an exposure of their own; scores are those of renders without it."""
    rate: float = 2e-3
    """Learning rate of gains and offsets."""
    regularization: float = 1e-2
    """Weight of half the squared distance from the identity in the loss."""

    def __post_init__(self) -> None:
        check_ranges(self, {"rate": (0, 1), "regularization": (0, 1e6)})


@dataclass(frozen=True)
class LossSettings:
    """Weights and kinds of the terms of the loss.

    Raises:
        ConfigError: a value outside its range.
    """

    dssim_weight: float = 0.2
    """Share of 1 - SSIM in the colour loss, in [0, 1]. 0 skips SSIM, which is most of the work."""
    depth_weight: float = 0.5
    """Per metre."""
    depth_kind: Literal["accumulated", "normalised"] = "accumulated"
    """What is compared with the target: the accumulated depth (so that a transparent pixel is too near), or the
    accumulated depth divided by alpha."""
    minimum_alpha: float = 0.05
    """For "normalised": pixels rendered fainter than this have no depth to speak of and are left out, in (0, 1]."""
    color_kind: Literal["l1", "charbonnier"] = "l1"
    """rho(r) = |r|, or sqrt(r^2 + epsilon^2) - epsilon."""
    charbonnier_epsilon: float = 1e-3
    """In units of colour, > 0."""
    no_depth_weight: float = 1.0
    """How much colour counts where the keyframe has no depth, in [0, 1]. 0: not at all."""
    opacity_weight: float = 0.0
    """Weight of 1 - alpha where the keyframe has depth, i.e. where there is a surface."""

    def __post_init__(self) -> None:
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"loss.{name}: expected a number in [{low:g}, {high:g}], found {value!r}")
        for name, kinds in (("depth_kind", ("accumulated", "normalised")), ("color_kind", ("l1", "charbonnier"))):
            if getattr(self, name) not in kinds:
                raise ConfigError(f"loss.{name}: expected one of {', '.join(kinds)}, found {getattr(self, name)!r}")


_TINY, _HUGE = 1e-6, 1e6
_RANGES = (
    ("dssim_weight", 0.0, 1.0), ("depth_weight", 0.0, _HUGE), ("minimum_alpha", _TINY, 1.0),
    ("charbonnier_epsilon", _TINY, _HUGE), ("no_depth_weight", 0.0, 1.0), ("opacity_weight", 0.0, _HUGE),
)  # fmt: skip


@dataclass(frozen=True)
class MapperSettings:
    """Everything the mapper needs to know."""

    iterations_per_frame: int = 4
    """Optimisation steps after each frame (synchronous runs)."""
    first_frame_iterations: int = 10
    """Steps on the first keyframe before the second frame is read."""
    refine_decay: float = 0.1
    """Final refinement: learning rates fall exponentially to this share of their value."""
    insertion: InsertionSettings = field(default_factory=InsertionSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    loss: LossSettings = field(default_factory=lambda: LossSettings(depth_weight=0.6))
    pruning: PruningSettings = field(default_factory=PruningSettings)
    pose_refinement: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)

    def __post_init__(self) -> None:
        ranges = {"iterations_per_frame": (0, 1000), "first_frame_iterations": (0, 10**5), "refine_decay": (1e-6, 1)}
        check_ranges(self, ranges)
