# SPDX-License-Identifier: Apache-2.0
"""How well the map of a run shows its keyframes: the figures that `verdict.json` stands on.

Each of some keyframes is rendered from its refined pose, in its own exposure, and compared where depth was measured and
nothing moved. Colours are divided by the brightness of the keyframe first, so that a dark image counts as a bright one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ggslam.evaluation.images import SSIM_WINDOW, fit_colors, ssim_map
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, make_keyframe
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences import Sequence as Recording
from ggslam.slam.result import SlamResult
from ggslam.system.tuning import Tuning
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.settings import DepthNoise


class MapFitTuning(Tuning):
    """How a map is compared with its keyframes."""

    keyframes = 12
    """Keyframes that are compared, spread over the run."""
    max_depth_error = 0.05
    """Depths agree within this share of the measured depth..."""
    max_depth_sigmas = 3.0
    """...or within this many standard deviations of its noise."""
    target_brightness = 0.8
    """The 95th percentile of a keyframe's values is scaled to this, in [0, 1]."""
    min_brightness = 0.02
    """A smaller percentile is taken for this, in [0, 1]."""
    structure_width = 160
    """Image width at which structure is compared, in pixels: noise averages out, misplaced structure stays."""
    min_pixels = 500
    """Fewest pixels with depth that a keyframe is compared by."""
    opaque_alpha = 0.5
    """Alpha above which a pixel shows a surface."""


_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_C2: Final = 0.03**2
"""The constant C2 of SSIM for a data range of 1: 0.03 squared."""
_MEDIAN_OF_NORMAL: Final = 0.6745
"""The median of |x| of a standard normal distribution."""


@dataclass(frozen=True)
class MapFit:
    """Medians over keyframes; `agreeing` and `covered` are means.

    Attributes:
        views: keyframes that were compared.
        psnr: dB, in the keyframe's own exposure.
        structure: SSIM of images reduced to `MapFitTuning.structure_width` pixels of width, over that of the keyframe
            without its noise.
        brightness: of the map against the keyframes: 1: as bright.
        agreeing: share of the pixels with depth whose rendered depth is the measured one, see
            `MapFitTuning.max_depth_error`.
        covered: share of them that have a rendered depth.
        depth_error: median of |rendered - measured| / measured.
        located: whether the frames were only located in the map, which was not made of them.
    """

    views: int
    psnr: float
    structure: float
    brightness: float
    agreeing: float
    covered: float
    depth_error: float
    located: bool = False


def measure_fit(
    keyframes: Sequence[Keyframe], map_in_view: Callable[[Camera, np.ndarray], GaussianMap], exposed: bool = True
) -> MapFit | None:
    """Compares a map with what it was made from; None: no keyframe of this run has enough depth.

    Args:
        keyframes: of the run, their images still there.
        map_in_view: what of the map a camera at T_camera_world [4, 4] may see.
        exposed: whether the keyframes tell their exposure, and the map was made of them; else the best exposure is
            taken, and what the map does not show is left out.
    """
    rasterizer, rows = CpuRasterizer(), []
    for keyframe in _spread([k for k in keyframes if k.frame_index != FROM_EARLIER_RUN]):
        view = rasterizer.forward(
            map_in_view(keyframe.camera, keyframe.T_camera_world), keyframe.camera, keyframe.T_camera_world,
            features=False,
        )  # fmt: skip
        depth = np.where(view.alpha.numpy() > MapFitTuning.opaque_alpha, view.expected_depth.numpy(), 0)
        image = view.image.numpy().transpose(1, 2, 0)
        if not exposed:
            keyframe = replace(keyframe, depth=np.where(depth > 0, keyframe.depth, np.uint16(0)))
            image = _expose(image, keyframe)
        row = _compare(keyframe, image, depth)
        rows += [] if row is None else [row]
    found = _summary(rows)
    return found if found is None else replace(found, located=not exposed)


def located_views(recording: Recording, result: SlamResult) -> list[Keyframe]:
    """Frames spread over a run that was located in a map that stays as it is, as the keyframes that it did not make."""
    poses = result.trajectory()
    known = [k for k in range(len(poses)) if np.isfinite(poses[k]).all()]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(MapFitTuning.keyframes, len(known))).round().astype(int))
    return [
        make_keyframe(number, recording.frame(result.frames[known[k]].frame_index, masks=False), poses[known[k]])
        for number, k in enumerate(chosen.tolist())
    ]


def _expose(image: np.ndarray, keyframe: Keyframe) -> np.ndarray:
    """The image [H, W, 3] in the exposure that brings it nearest to the keyframe."""
    known = keyframe.depth > 0
    return fit_colors(image, keyframe.color.astype(np.float32) / 255, known).astype(np.float32)


def _spread(keyframes: list[Keyframe]) -> Iterable[Keyframe]:
    chosen = np.linspace(0, len(keyframes) - 1, min(MapFitTuning.keyframes, len(keyframes))).round().astype(int)
    return (keyframes[i] for i in chosen.tolist())


def _compare(keyframe: Keyframe, image: np.ndarray, rendered: np.ndarray) -> list[float] | None:
    """Figures of one keyframe in the order of `MapFit`; `image` [H, W, 3] in the map's exposure."""
    depth, color = keyframe.depth_m(), keyframe.color.astype(np.float32) / 255
    known = depth > 0
    if keyframe.moving is not None:
        known &= ~keyframe.moving
    if known.sum() < MapFitTuning.min_pixels:
        return None
    gain, offset = keyframe.exposure.astype(np.float32).T
    own = np.clip(image * gain + offset, 0, 1)
    level = MapFitTuning.target_brightness / max(float(np.percentile(color[known], 95)), MapFitTuning.min_brightness)
    square = float(np.square(own - color)[known].mean())
    brightness = float(np.clip(image, 0, 1)[known].mean() / max(float(color[known].mean()), 1e-3))
    return [
        -10 * np.log10(max(square, 1e-10)), _structure(level * own, level * color, known), brightness,
        *_compare_depth(depth, rendered, known, keyframe.camera),
    ]  # fmt: skip


def _structure(own: np.ndarray, color: np.ndarray, known: np.ndarray) -> float:
    """SSIM of two images [H, W, 3], reduced to `MapFitTuning.structure_width` pixels of width, over what noise allows;
    where all of a pixel is known."""
    factor = min(1.0, MapFitTuning.structure_width / color.shape[1])
    size = (max(16, round(factor * color.shape[1])), max(16, round(factor * color.shape[0])))
    images = (own, color, known.astype(np.float32))
    ours, seen, share = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images)
    whole = share > 0.99 if (share > 0.99).any() else share > 0
    return min(1.0, float(ssim_map(ours, seen)[whole].mean() / _best_ssim(seen, whole)))


def _best_ssim(color: np.ndarray, known: np.ndarray) -> float:
    """SSIM with an image [H, W, 3] of what it would be without noise, whose standard deviation is measured where the
    image is smooth (Immerkaer, "Fast Noise Variance Estimation", 1996, with the median): the structure of a window of
    variance v is v - noise^2."""
    response = cv2.filter2D(color, -1, _NOISE_KERNEL)
    noise = float(np.median(np.abs(response[known]))) / (6 * _MEDIAN_OF_NORMAL)
    mean, square = (cv2.GaussianBlur(image, (SSIM_WINDOW, SSIM_WINDOW), 1.5) for image in (color, color * color))
    variance = np.maximum(square - mean * mean, 0)
    true = np.maximum(variance - noise * noise, 0)
    return float(((2 * true + _C2) / (true + variance + _C2))[known].mean())


def _compare_depth(
    depth: np.ndarray, rendered: np.ndarray, known: np.ndarray, camera: Camera
) -> tuple[float, float, float]:
    """Share that agrees, share that is covered, median relative error."""
    noise = estimate_noise(depth, camera) or DepthNoise()
    z, both = depth[known], rendered[known] > 0
    if not both.any():
        return 0.0, 0.0, 1.0
    error = np.abs(rendered[known] - z)
    within = MapFitTuning.max_depth_sigmas * (noise.constant + noise.square * z * z)
    agrees = both & (error <= np.maximum(MapFitTuning.max_depth_error * z, within))
    return float(agrees.mean()), float(both.mean()), float(np.median((error / z)[both]))


def _summary(rows: list[list[float]]) -> MapFit | None:
    if not rows:
        return None
    psnr, structure, brightness, agreeing, covered, error = np.array(rows).T
    return MapFit(
        len(rows), psnr=float(np.median(psnr)), structure=float(np.median(structure)),
        brightness=float(np.median(brightness)), agreeing=float(agreeing.mean()), covered=float(covered.mean()),
        depth_error=float(np.median(error)),
    )  # fmt: skip
