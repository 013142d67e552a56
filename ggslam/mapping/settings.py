# SPDX-License-Identifier: Apache-2.0
"""Settings of the mapper. The defaults are one recipe for all recordings; bench_slam.py shows what it does."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class InsertionSettings:
    """Where new Gaussians are born and what they look like."""

    alpha_threshold: float = setting(0.6, 0, 1)
    """A pixel whose rendered alpha is below this is not yet explained by the map."""
    depth_tolerance_m: float = setting(0.05, 0, 1e3, "m")
    """A pixel whose measured depth lies this much in front of the rendered depth is not explained, either."""
    depth_tolerance_relative: float = setting(0.03, 0, 1)
    """As `depth_tolerance_m`, a share of the depth; the larger of the two counts."""
    opacity: float = setting(0.4, 1e-3, 0.999)
    """Opacity at birth."""
    scale_pixels: float = setting(0.7, 1e-2, 100, "px")
    """Standard deviation at birth along the surface, in pixels of the frame that inserts it (times the stride)."""
    flatness: float = setting(1.0, 1e-3, 1)
    """Standard deviation along the surface normal as a share of that along the surface. Flat discs (0.2) cost 0.5 dB
    at 4 iterations a frame: a Gaussian that is thick at birth is still seen from the side."""
    max_slope: float = setting(3.0, 1, 100)
    """How far a footprint may be stretched along a surface seen at a grazing angle."""
    adaptive_stride: bool = True
    """One Gaussian per 2x2 pixels where colour and depth are smooth, one per pixel elsewhere."""
    texture_threshold: float = setting(90.0, 0, 1e4)
    """For `adaptive_stride`: Sobel magnitude of the grey image (0 to 255) under which a pixel is flat."""
    fill_stride: int = setting(3, 0, 1000, "px")
    """Pixels without depth, where nothing is rendered either, get a Gaussian on a grid of this stride at the depth of
    the nearest pixel that has one; 0: none. Training with colour then makes them fit what is seen there."""
    max_depth_m: float = setting(20.0, 0.05, 1e4, "m", basic=True)
    """Farther measurements do not become Gaussians."""


@settings_class(frozen=True)
class LearningRates:
    """Adam step sizes of each group of parameters.

    Those of means, quaternions and colours fall with the root of a Gaussian's steps (`fall_updates`): what was just
    born finds its place fast, what is old averages over many views. Standard deviations and opacities keep theirs
    after a few longer steps (`young_updates`): falling or longer steps of these lose depth.
    """

    means: float = setting(1.8e-3, 0, 10, "m")
    """Of the means, at a Gaussian's first step, at most."""
    means_px: float = setting(0.5, 0, 1e3, "px")
    """The same as it moves a Gaussian in the image, at the scene's median depth, at most: near scenes have small
    pixels."""
    quaternions: float = setting(1.8e-2, 0, 10)
    """Of the quaternions, at a Gaussian's first step."""
    log_scales: float = setting(8e-2, 0, 10)
    """Of the logarithms of the standard deviations."""
    opacity_logits: float = setting(5e-2, 0, 10)
    """Of the logits of the opacities."""
    sh_dc: float = setting(0.108, 0, 10)
    """Of the colours' coefficient of degree 0, at a Gaussian's first step."""
    fall_updates: float = setting(64.0, 0.1, 10**4)
    """Steps of means, quaternions and `sh_dc` at a Gaussian's u-th update are shorter than its first by the root of
    1 + (u - 1) / this, at most by 20."""
    sh_rest: float = setting(5e-4, 0, 10)
    """Of the colours' other coefficients."""
    features: float = setting(1e-2, 0, 10)
    """Of the feature vectors."""
    beta1: float = setting(0.9, 0, 0.9999)
    """Decay rate of the first moment."""
    beta2: float = setting(0.99, 0, 0.99999)
    """Decay rate of the second moment."""
    epsilon: float = setting(1e-15, 1e-30, 1)
    """Added to the root of the second moment."""
    young_factor: float = setting(3.0, 1, 100)
    """A Gaussian's first step of standard deviations, opacity and `sh_rest` is this much longer; see
    `young_updates`."""
    young_updates: int = setting(8, 1, 10**4)
    """Over this many steps of a Gaussian `young_factor` falls to 1."""


@settings_class(frozen=True)
class PruningSettings:
    """Which Gaussians are dropped, and how often one looks."""

    every_keyframes: int = setting(5, 1, 10**6, "keyframes")
    """One looks after every n-th keyframe."""
    min_opacity: float = setting(0.05, 1e-6, 0.999)
    """Fainter Gaussians are dropped."""
    max_scale_m: float = setting(0.25, 1e-4, 1e4, "m")
    """Larger Gaussians are dropped."""
    min_weight: float = setting(0.05, 0, 1)
    """Those that have no larger share than this of any pixel in any keyframe are dropped, for surfaces hide them: on
    the CPU before the final refinement, and where depth is noisy (see `sparse_noise`) at 10, 20, 40, ... keyframes
    if frames need not be kept up with. Eight keyframes or more look with a quarter of their pixels each. 0: none; nor
    are any of a map that is partly on disk, or that it has from before."""


@settings_class(frozen=True)
class PoseRefinementSettings:
    """Refinement of keyframe poses through the renderer's pose gradient (Adam on the twist).

    The steps go with the noise of the depth camera: where depth is exact, tracking leaves nothing to refine, and the
    steps would only shake the map.
    """

    enabled: bool = setting(True, basic=True)
    """Whether keyframe poses are refined."""
    rate_sigmas: float = setting(0.1, 0, 100)
    """Step in standard deviations of the depth noise at the scene's median depth; a turn by one radian
    counts as 1 m."""
    max_rate: float = setting(5e-4, 0, 1, "m")
    """Upper bound of the step."""


@settings_class(frozen=True)
class ExposureSettings:
    """Per-keyframe affine colour (gain and offset per channel). Scores are those of renders without it, but for
    `psnr_exposed`."""

    enabled: bool = setting(False, basic=True)
    """Whether all keyframes get an exposure of their own."""
    compensate: bool = setting(True, basic=True)
    """Whether keyframes that the camera saw with another exposure than the map get one of their own; on the CPU."""
    change: float = setting(0.45, 0.01, 10)
    """Mean change of the gains, as a natural logarithm, from which exposures are compensated, earlier ones too; cameras
    that regulate themselves a little stay below."""
    least: float = setting(0.1, 0.001, 10)
    """Change of a gain, as a natural logarithm, from which a keyframe is then given an exposure of its own."""
    typical: float = setting(0.2, 0.001, 10)
    """Once exposures are compensated, the map gets the keyframes' median exposure when they differ from it by this, as
    a natural logarithm, and after the last frame in any case: a first frame of a camera that was still regulating
    itself does not colour the map. A map made before keeps its exposure."""
    rate: float = setting(2e-3, 0, 1)
    """Learning rate of gains and offsets."""
    regularization: float = setting(1e-2, 0, 1e6)
    """Weight of half the squared distance from the identity, or from what was measured, in the loss."""


@settings_class(frozen=True)
class ViewAlignmentSettings:
    """Alignment of frames to the map by colour alone (on the CPU): of those that are no keyframes after the last frame,
    and, where depth errs more than its images show, of all as they come (in synchronous runs) and of keyframes before
    the last steps."""

    enabled: bool = setting(True, basic=True)
    """Whether frames are aligned to the map so."""
    hidden_noise: float = setting(8.0, 1, 1e6)
    """Frames are aligned so where the residuals of tracking are this many times what the first image shows of noise:
    errors that neighbouring pixels share, and so many points do not help against them."""
    last_noise: float = setting(0.2, 0, 1e6, "px")
    """After the last frame, frames are aligned where the noise of depth is as wide as this in the image: there colour
    tells a pose better."""
    points: int = setting(8000, 500, 10**6)
    """Textured pixels at most."""
    min_gradient: float = setting(0.01, 1e-4, 1)
    """A pixel is textured if grey, in [0, 1], changes by this per pixel."""
    iterations: int = setting(8, 1, 1000)
    """Steps at each of two scales at most."""
    tolerance: float = setting(2e-5, 0, 1, "m")
    """The iteration stops at a step below this; a turn by one radian counts as 1 m."""
    farthest_sigmas: float = setting(5.0, 0, 1e3)
    """A pose that is farther from the tracked one than so many standard deviations of the depth noise at the frame's
    median depth is not believed; a turn by one radian counts as that depth."""


@settings_class(frozen=True)
class LossSettings:
    """Weights and kinds of the terms of the loss.

    Raises:
        ConfigError: a value outside its range.
    """

    dssim_weight: float = setting(0.2, 0, 1)
    """Share of 1 - SSIM in the colour loss. 0 skips SSIM, which is most of the work."""
    depth_weight: float = setting(0.5, 0, 1e6, "1/m")
    """Weight of the difference in depth."""
    depth_kind: Literal["accumulated", "normalised"] = "accumulated"
    """What is compared with the target: the accumulated depth (so that a transparent pixel is too near), or the
    accumulated depth divided by alpha."""
    minimum_alpha: float = setting(0.05, 1e-6, 1)
    """For "normalised": pixels rendered fainter than this have no depth to speak of and are left out."""
    color_kind: Literal["l1", "charbonnier"] = "l1"
    """rho(r) = |r|, or sqrt(r^2 + epsilon^2) - epsilon."""
    charbonnier_epsilon: float = setting(1e-3, 1e-6, 1e6)
    """Epsilon of "charbonnier", in units of colour."""
    no_depth_weight: float = setting(1.0, 0, 1)
    """How much colour counts where the keyframe has no depth. 0: not at all."""
    opacity_weight: float = setting(0.0, 0, 1e6)
    """Weight of 1 - alpha where the keyframe has depth, i.e. where there is a surface."""


@settings_class(frozen=True)
class MapperSettings:
    """Everything the mapper needs to know."""

    iterations_per_frame: int = setting(4, 0, 1000, basic=True)
    """Optimisation steps after each frame (synchronous runs); on the CPU each is on every second pixel of every second
    row of a keyframe, other ones each time, in 0.57 of the time of a step on all, unless memory is limited."""
    sparse_noise: float = setting(0.2, 0, 1e6, "px")
    """Where the noise of depth is as wide as this in the image, an iteration after the last frame is two steps on two
    keyframes, each on every second pixel of every second row, instead of one step on all pixels of one: there that is
    worth nearly twice the iterations for a seventh more time. With exact depth it is not. 0: always; on the CPU."""
    close_below: float = setting(0.01, 0, 0.5)
    """Steps on the CPU end a pixel with the Gaussian behind which less than this share of the light is left, and give
    it all of that: what lies behind shows too little to teach anything, and takes a sixth of a step's time. 0: steps
    draw pixels as pictures do."""
    first_frame_iterations: int = setting(10, 0, 10**5)
    """Steps on the first keyframe before the second frame is read."""
    refine_decay: float = setting(0.1, 1e-6, 1)
    """Where the map is not averaged (see `average_last`) learning rates fall exponentially to this share of their value
    in the final refinement; so they do on the GPU, at the seams of merged runs and in the cells of stores."""
    average_last: float = setting(0.5, 0, 1)
    """Final refinement on the CPU: learning rates, but not those of poses, stay, and the map becomes the mean over this
    share of the steps, the last ones; 0: rates fall, and it is what the last step leaves."""
    insertion: InsertionSettings = field(default_factory=InsertionSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    loss: LossSettings = field(default_factory=lambda: LossSettings(depth_weight=0.6))
    pruning: PruningSettings = field(default_factory=PruningSettings)
    pose_refinement: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    view_alignment: ViewAlignmentSettings = field(default_factory=ViewAlignmentSettings)
