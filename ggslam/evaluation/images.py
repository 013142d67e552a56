# SPDX-License-Identifier: Apache-2.0
"""Scores of a rendered view against the recorded frame.

Names: a plain name (`psnr`, `ssim`, `lpips`) counts the pixels where the sensor measured depth, the part of the view
that an RGB-D map can be asked to know; `_unmasked` counts all pixels. Rendered colours are clipped to [0, 1] and
compared as they are, not rounded to 8 bits.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
import torch

from ggslam.errors import InputError
from ggslam.evaluation.lpips import SMALLEST_SIDE, Lpips
from ggslam.system.tuning import Tuning

SSIM_WINDOW: Final = 11
"""Pixels of SSIM's window; Gaussian of standard deviation 1.5, as in Wang et al., "Image Quality Assessment", TIP
2004."""


class ImageScoreTuning(Tuning):
    """A limit that keeps means finite."""

    max_psnr = 100.0
    """PSNR of identical images, in dB."""


@dataclass(frozen=True)
class ImageScores:
    """Scores of one view, or their means over several. NaN where a score does not exist (no depth, no weights).

    Attributes:
        psnr: dB over pixels with measured depth (mean square error over pixels and channels, data range 1).
        psnr_unmasked: dB over all pixels.
        psnr_3dgs: dB over pixels with measured depth, of the map as 3D Gaussian Splatting and viewers that follow it
            draw it.
        psnr_exposed: dB over pixels with measured depth, of the recorded frame and the rendering, both brought to the
            recording's typical exposure by one gain for each colour channel (see `rendering.exposure`), so that errors
            of dark frames count as those of bright ones do; only of runs in which the exposure changed.
        psnr_affine: dB over pixels with measured depth after the best gain and offset of each colour channel of the
            rendering: what remains when exposure and white balance are forgiven.
        ssim: mean over pixels with measured depth of the SSIM map, which is computed on the unaltered images.
        ssim_unmasked: mean of the SSIM map over all pixels.
        lpips: LPIPS (AlexNet, v0.1) of the two images with the pixels without measured depth set to black in both.
        lpips_unmasked: LPIPS of the two images.
        depth_l1_m, depth_l1_median_m: mean and median of |rendered - measured depth| in metres where both are known.
        depth_coverage: share of the pixels with measured depth where the rendering has depth; holes escape depth L1.
    """

    psnr: float = math.nan
    psnr_3dgs: float = math.nan
    psnr_unmasked: float = math.nan
    psnr_exposed: float = math.nan
    psnr_affine: float = math.nan
    ssim: float = math.nan
    ssim_unmasked: float = math.nan
    lpips: float = math.nan
    lpips_unmasked: float = math.nan
    depth_l1_m: float = math.nan
    depth_l1_median_m: float = math.nan
    depth_coverage: float = math.nan

    def to_dict(self) -> dict[str, float | None]:
        """For JSON: NaN becomes None."""
        return {name: None if math.isnan(value) else value for name, value in asdict(self).items()}


def score_image(
    rendered_color: np.ndarray,
    rendered_depth: np.ndarray | None,
    color: np.ndarray,
    depth: np.ndarray,
    lpips: Lpips | None = None,
) -> ImageScores:
    """Scores one view.

    Args:
        rendered_color: [H, W, 3], uint8 or floating point in [0, 1] (clipped here; NaN counts as black).
        rendered_depth: [H, W] metres, 0 (or not finite) where the map is empty; None leaves out the depth scores.
        color: recorded colour, uint8 or floating point [H, W, 3].
        depth: measured depth [H, W] in metres, 0 where unknown.
        lpips: the metric if it shall be scored.

    Raises:
        InputError: sizes that do not agree, or no numpy arrays.
    """
    named = {"rendered_color": rendered_color, "rendered_depth": rendered_depth, "color": color, "depth": depth}
    for name, given in named.items():
        if not isinstance(given, np.ndarray) and (given is not None or name != "rendered_depth"):
            hint = "; call .detach().cpu().numpy()" if isinstance(given, torch.Tensor) else ""
            raise InputError(f"score_image: {name}: expected a numpy array, found {type(given).__name__}{hint}")
    image, reference = unit_range(rendered_color), unit_range(color)
    if image.shape != reference.shape or image.ndim != 3 or image.shape[:2] != depth.shape:
        raise InputError(f"sizes differ: rendered {image.shape}, recorded {reference.shape}, depth {depth.shape}")
    valid = np.isfinite(depth) & (depth > 0)
    similarity = ssim_map(image, reference)
    scores: dict[str, float] = {
        "psnr": psnr(image, reference, valid),
        "psnr_unmasked": psnr(image, reference),
        "psnr_affine": psnr(fit_colors(image, reference, valid), reference, valid),
        "ssim": float(similarity[valid].mean()) if valid.any() else math.nan,
        "ssim_unmasked": float(similarity.mean()),
    }
    if lpips is not None and min(depth.shape) >= SMALLEST_SIDE:
        scores["lpips_unmasked"] = lpips(image, reference)
        if valid.all():
            scores["lpips"] = scores["lpips_unmasked"]
        elif valid.any():
            scores["lpips"] = lpips(image * valid[..., None], reference * valid[..., None])
    if rendered_depth is not None:
        scores.update(depth_errors(rendered_depth, depth))
    return ImageScores(**scores)


def unit_range(image: np.ndarray) -> np.ndarray:
    """An image as float32 in [0, 1]; uint8 is divided by 255, floating point is clipped and NaN becomes 0."""
    if image.dtype == np.uint8:
        return image.astype(np.float32) / 255
    return np.nan_to_num(image.astype(np.float32), nan=0.0).clip(0, 1)


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, at most `ImageScoreTuning.max_psnr`, of images [H, W, 3] in [0, 1].

    Args:
        image, reference: floating point.
        mask: bool [H, W], the pixels that count; None: all. NaN is returned if none does.
    """
    square = np.square(image - reference)
    if mask is not None:
        square = square[mask]
    if not square.size:
        return math.nan
    error = float(square.mean(dtype=np.float64))
    return -10 * math.log10(max(error, 10 ** (-ImageScoreTuning.max_psnr / 10)))


def fit_colors(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image with the gain and offset per channel that bring it nearest to the reference within the mask.

    Least squares in each channel; not clipped, so the error within the mask cannot grow. A channel without contrast
    gets an offset alone.
    """
    out = image.astype(np.float64)
    if not mask.any():
        return out
    for channel in range(3):
        x, y = out[..., channel][mask], reference[..., channel][mask].astype(np.float64)
        variance = x.var()
        gain = float(((x - x.mean()) * (y - y.mean())).mean() / variance) if variance > 1e-12 else 0.0
        out[..., channel] = gain * (out[..., channel] - x.mean()) + y.mean()
    return out


def ssim_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Structural similarity of two images [H, W, 3] in [0, 1], averaged over the channels: float32 [H, W].

    Wang et al. 2004: Gaussian window 11x11 with standard deviation 1.5, K1 = 0.01, K2 = 0.03, data range 1. Beyond the
    border the images are mirrored (without repeating the border pixel), so every pixel has a value; both sides of the
    image must be longer than 5 pixels.
    """
    from kornia.metrics import ssim  # slow to import

    tensors = [torch.from_numpy(np.ascontiguousarray(x.transpose(2, 0, 1)))[None].float() for x in (image, reference)]
    with torch.inference_mode():
        values = ssim(tensors[0], tensors[1], SSIM_WINDOW, max_val=1.0, eps=0.0, padding="same")
        return values[0].mean(0).numpy()


def depth_errors(rendered: np.ndarray, measured: np.ndarray) -> dict[str, float]:
    """`depth_l1_m`, `depth_l1_median_m` and `depth_coverage` (see `ImageScores`) of depth images [H, W] in metres."""
    valid = np.isfinite(measured) & (measured > 0)
    both = valid & np.isfinite(rendered) & (rendered > 0)
    if not valid.any():
        return {}
    coverage = {"depth_coverage": float(both.sum() / valid.sum())}
    if not both.any():
        return coverage
    error = np.abs(rendered[both].astype(np.float64) - measured[both])
    return {"depth_l1_m": float(error.mean()), "depth_l1_median_m": float(np.median(error)), **coverage}
