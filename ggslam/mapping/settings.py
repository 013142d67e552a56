# SPDX-License-Identifier: Apache-2.0
"""Settings of the mapper. The defaults are one recipe for all recordings; bench_slam.py shows what it does."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from ggslam.system.settings import setting, settings_class, tuning_class

SamplingOrder = Literal["spread", "random", "newest", "covisible"]
"""Which keyframe is trained next, see `ggslam.mapping.sampling`."""


@tuning_class(frozen=True)
class InsertionTuning:
    """Numbers of inserting Gaussians."""

    alpha_threshold: float = setting(0.6, 0, 1)
    """A pixel is unexplained if its rendered alpha is below this."""
    depth_tolerance_m: float = setting(0.05, 0, 1e3, "m")
    """A pixel is unexplained if measured this far in front of the rendered depth; see `depth_tolerance_relative`."""
    depth_tolerance_relative: float = setting(0.03, 0, 1)
    """The same as a share of the depth; the larger of the two counts."""
    scale_pixels: float = setting(0.7, 1e-2, 100, "px")
    """Standard deviation of a new Gaussian along the surface, in pixels times the stride."""
    flatness: float = setting(1.0, 1e-3, 1)
    """Standard deviation along the normal as a share of that along the surface."""
    max_slope: float = setting(3.0, 1, 100)
    """Largest stretch of a Gaussian on a surface seen at a grazing angle."""
    adaptive_stride: bool = True
    """Insert one Gaussian per 2 x 2 pixels where colour and depth are smooth, else one per pixel."""
    texture_threshold: float = setting(90.0, 0, 1e4)
    """Sobel magnitude of grey, 0 to 255, below which `adaptive_stride` sees a pixel as smooth."""


@settings_class(frozen=True)
class InsertionSettings(InsertionTuning):
    """Where Gaussians are inserted and what they look like."""

    opacity: float = setting(0.4, 1e-3, 0.999)
    """Opacity of a new Gaussian."""
    fill_stride: int = setting(3, 0, 1000, "px")
    """Where a pixel has no depth and nothing is rendered, insert Gaussians on a grid of this stride at the depth of the
    nearest pixel that has one; 0: none. Gains 0.3 dB on redkitchen."""
    max_depth_m: float = setting(20.0, 0.05, 1e4, "m", basic=True)
    """Farther measurements do not become Gaussians."""


@tuning_class(frozen=True)
class RateTuning:
    """Numbers of Adam."""

    means_px: float = setting(0.5, 0, 1e3, "px")
    """Largest first step of a mean in the image, at the median depth."""
    quaternions: float = setting(1.8e-2, 0, 10)
    """First step of a quaternion."""
    fall_updates: float = setting(64.0, 0.1, 10**4)
    """At update u the steps of means, quaternions and `sh_dc` are divided by the root of 1 + (u - 1) / this, at most by
    20."""
    sh_rest: float = setting(5e-4, 0, 10)
    """Step of the other coefficients of a colour."""
    beta1: float = setting(0.9, 0, 0.9999)
    """Decay rate of the first moment."""
    beta2: float = setting(0.99, 0, 0.99999)
    """Decay rate of the second moment."""
    epsilon: float = setting(1e-15, 1e-30, 1)
    """Added to the root of the second moment."""
    young_factor: float = setting(3.0, 1, 100)
    """Factor on a new Gaussian's first step of standard deviations, opacity and `sh_rest`."""
    young_updates: int = setting(8, 1, 10**4)
    """Updates over which `young_factor` falls to 1."""


@settings_class(frozen=True)
class LearningRates(RateTuning):
    """Adam step sizes of each group of parameters.

    Steps of means, quaternions and colours shrink with the root of a Gaussian's updates (`fall_updates`): a new one
    settles fast, an old one averages over many views. Standard deviations and opacities keep their steps after a few
    longer ones (`young_updates`), because shrinking or larger steps there cost depth accuracy.
    """

    means: float = setting(1.8e-3, 0, 10, "m")
    """Largest first step of a Gaussian's mean; later steps shrink with the root of its updates."""
    log_scales: float = setting(8e-2, 0, 10)
    """Step of the logarithm of a standard deviation. Larger steps cover surfaces with fewer Gaussians."""
    opacity_logits: float = setting(5e-2, 0, 10)
    """Step of the logit of an opacity."""
    sh_dc: float = setting(0.108, 0, 10)
    """First step of the constant part of a colour."""


@tuning_class(frozen=True)
class PruningTuning:
    """Numbers of pruning."""

    enabled: bool = True
    """Remove useless Gaussians."""
    every_keyframes: int = setting(5, 1, 10**6, "keyframes")
    """Prune and densify after every n-th keyframe."""


@settings_class(frozen=True)
class PruningSettings(PruningTuning):
    """Which Gaussians are removed."""

    min_opacity: float = setting(0.05, 1e-6, 0.999)
    """Less opaque Gaussians are removed."""
    max_scale_m: float = setting(0.25, 1e-4, 1e4, "m")
    """Gaussians with a larger standard deviation are removed."""
    min_weight: float = setting(0.05, 0, 1)
    """Gaussians that contribute less than this share to every pixel of every keyframe are removed as hidden
    (before the final refinement, and during a run with noisy depth). 0: none."""


@tuning_class(frozen=True)
class PoseRefinementTuning:
    """Numbers of the refinement of keyframe poses."""

    rate_sigmas: float = setting(0.1, 0, 100)
    """Step in standard deviations of the depth noise at the median depth; a turn by one radian counts as 1 m."""
    noisy_rate_sigmas: float = setting(0.3, 0, 100)
    """The same where depth is noisy, see `MapperSettings.sparse_noise`."""
    max_rate: float = setting(5e-4, 0, 1, "m")
    """Upper bound of the step."""


@settings_class(frozen=True)
class PoseRefinementSettings(PoseRefinementTuning):
    """Refinement of keyframe poses through the renderer's pose gradient (Adam on the twist).

    The steps go with the noise of the depth camera: where depth is exact, tracking leaves nothing to refine, and the
    steps would only shake the map.
    """

    enabled: bool = setting(True, basic=True)
    """Refine the poses of keyframes while the map is trained. Gains 0.4 dB with a noisy depth camera (redkitchen),
    nothing with exact depth (livingroom)."""


@tuning_class(frozen=True)
class ExposureTuning:
    """Numbers of exposure compensation."""

    least: float = setting(0.1, 0.001, 10)
    """A keyframe then gets its own exposure if a gain changes by this, as a natural logarithm."""
    typical: float = setting(0.2, 0.001, 10)
    """The map is brought to the keyframes' median exposure if it differs by this, as a natural logarithm."""
    rate: float = setting(2e-3, 0, 1)
    """Learning rate of gains and offsets."""
    regularization: float = setting(1e-2, 0, 1e6)
    """Weight of half the squared distance from the identity or the measured exposure."""


@settings_class(frozen=True)
class ExposureSettings(ExposureTuning):
    """Affine colour of each keyframe (gain and offset per channel). `psnr_exposed` alone is scored with it."""

    enabled: bool = setting(False, basic=True)
    """Train an exposure for each keyframe. Scores are of renders without exposure, which lose 0.4 to 1.1 dB with a
    steady camera."""
    compensate: bool = setting(True, basic=True)
    """Train an exposure for keyframes that are clearly brighter or darker than the map."""
    change: float = setting(0.45, 0.01, 10)
    """Compensation starts at this mean change of the gains, as a natural logarithm (0.45: a factor of 1.57)."""


@tuning_class(frozen=True)
class ViewAlignmentTuning:
    """Numbers of the alignment of frames to the map by colour."""

    hidden_noise: float = setting(8.0, 1, 1e6)
    """Align frames as they arrive if tracking residuals are this many times the noise that the first image shows."""
    last_noise: float = setting(0.2, 0, 1e6, "px")
    """Align frames after the last one if the depth noise is at least this wide in the image."""
    keyframe_noise: float = setting(0.1, 0, 1e6, "px")
    """The same for keyframes before the final refinement, which goes on from there."""
    points: int = setting(8000, 500, 10**6)
    """Maximum number of textured pixels."""
    min_gradient: float = setting(0.01, 1e-4, 1)
    """A pixel is textured if its grey value, in [0, 1], changes by this much per pixel."""
    iterations: int = setting(8, 1, 1000)
    """Maximum steps at each of two scales."""
    tolerance: float = setting(2e-5, 0, 1, "m")
    """Iteration stops at a smaller step; a turn by one radian counts as 1 m."""
    farthest_sigmas: float = setting(5.0, 0, 1e3)
    """A pose farther from the tracked one than this many standard deviations of the depth noise is rejected."""


@settings_class(frozen=True)
class ViewAlignmentSettings(ViewAlignmentTuning):
    """Alignment of frames to the map by colour alone.

    After the last frame it aligns frames between keyframes; where depth errs by more than its images show, also all
    frames of synchronous runs as they arrive, and keyframes before the final refinement.
    """

    enabled: bool = setting(True, basic=True)
    """Align frames to the map photometrically where depth is noisy, after the last frame or as they arrive."""


@tuning_class(frozen=True)
class LossTuning:
    """Numbers of the loss."""

    minimum_alpha: float = setting(0.05, 1e-6, 1)
    """For "normalised", pixels rendered fainter than this are left out."""
    charbonnier_epsilon: float = setting(1e-3, 1e-6, 1e6)
    """Epsilon of "charbonnier", in units of colour."""
    no_depth_weight: float = setting(1.0, 0, 1)
    """Weight of colour where the keyframe has no depth; 0: none."""
    opacity_weight: float = setting(0.0, 0, 1e6)
    """Weight of 1 - alpha where the keyframe has depth."""


@settings_class(frozen=True)
class LossSettings(LossTuning):
    """Terms of the training loss.

    Raises:
        ConfigError: a value outside its range.
    """

    dssim_weight: float = setting(0.2, 0, 1)
    """Weight of 1 - SSIM in the colour loss, 1 - this of the difference in colour. 0 skips SSIM, which is most of the
    work."""
    depth_weight: float = setting(0.5, 0, 1e6, "1/m")
    """Weight of the difference in depth."""
    depth_kind: Literal["accumulated", "normalised"] = "accumulated"
    """What is compared with the measured depth. accumulated: the sum along the ray; normalised: that divided by
    alpha."""
    color_kind: Literal["l1", "charbonnier"] = "l1"
    """Norm of the colour difference r. l1: |r|; charbonnier: sqrt(r^2 + epsilon^2) - epsilon."""


@tuning_class(frozen=True)
class MapperTuning:
    """Numbers of training."""

    order: SamplingOrder = "spread"
    """Keyframe that is trained next. spread: all evenly, successive ones far apart; random: uniform draws; newest: from
    the newest one back; covisible: the newest one and those that share most surface with it, and now and then
    others."""
    densification: Literal["never", "added", "instead"] = "never"
    """Clone and split Gaussians that images pull at, as 3DGS does (CPU). added: besides inserting them at unexplained
    pixels; instead: these are inserted at every fourth pixel of every fourth row only."""
    sparse_noise: float = setting(0.2, 0, 1e6, "px")
    """If the depth noise is at least this wide in the image, a step after the last frame becomes two on two keyframes,
    sparse ones on the CPU; 0: always."""
    close_below: float = setting(0.01, 0, 0.5)
    """In training a pixel ends when less than this share of its light is left: the last Gaussian takes it. That saves a
    sixth of a step's time on the CPU; 0: draw all Gaussians."""
    refine_decay: float = setting(0.1, 1e-6, 1)
    """Learning rates decay to this share in a final refinement that does not average."""


@settings_class(frozen=True)
class MapperSettings(MapperTuning):
    """How the map is trained."""

    iterations_per_frame: int = setting(4, 0, 1000, basic=True)
    """Training steps after each frame in synchronous runs; 1, 4 and 16 give 27.0, 29.1 and 30.4 dB on the first 80
    frames of redkitchen. On the CPU, without a memory limit, a step draws every second pixel of every second row, which
    takes 0.57 of the time of a full step."""
    first_frame_iterations: int = setting(10, 0, 10**5)
    """Training steps on the first keyframe before the second frame is read."""
    average_last: float = setting(0.3, 0, 1)
    """Share of the final refinement's steps over which the map is averaged; 0: learning rates decay instead."""
    insertion: InsertionSettings = field(default_factory=InsertionSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    loss: LossSettings = field(default_factory=lambda: LossSettings(depth_weight=0.6))
    pruning: PruningSettings = field(default_factory=PruningSettings)
    pose_refinement: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    view_alignment: ViewAlignmentSettings = field(default_factory=ViewAlignmentSettings)
