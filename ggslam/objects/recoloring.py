# SPDX-License-Identifier: Apache-2.0
"""Another colour for Gaussians whose light and shade stay."""

from __future__ import annotations

import re

import cv2
import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh

NAMED_COLORS = {
    "black": (0, 0, 0), "white": (255, 255, 255), "grey": (128, 128, 128), "gray": (128, 128, 128),
    "silver": (192, 192, 192), "red": (220, 30, 30), "green": (30, 150, 50), "blue": (30, 80, 220),
    "yellow": (240, 210, 30), "orange": (255, 140, 0), "purple": (128, 0, 128), "violet": (140, 80, 220),
    "pink": (255, 130, 180), "magenta": (255, 0, 255), "cyan": (0, 200, 220), "turquoise": (64, 200, 190),
    "brown": (130, 75, 40), "beige": (235, 220, 185), "gold": (230, 180, 30), "navy": (0, 0, 128),
}  # fmt: skip
_LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])


def parse_color(text: str) -> tuple[int, int, int]:
    """RGB of "#rrggbb", "#rgb" or one of `NAMED_COLORS`.

    Raises:
        ConfigError: neither.
    """
    wanted = text.strip().lower()
    if wanted in NAMED_COLORS:
        return NAMED_COLORS[wanted]
    digits = wanted.removeprefix("#")
    if re.fullmatch("[0-9a-f]{3}", digits):
        digits = "".join(2 * digit for digit in digits)
    if not re.fullmatch("[0-9a-f]{6}", digits):
        raise ConfigError(f"color {text!r}: expected #rrggbb or one of {', '.join(NAMED_COLORS)}")
    red, green, blue = (int(digits[i : i + 2], 16) for i in (0, 2, 4))
    return red, green, blue


def recolor(gaussians: GaussianMap, rows: np.ndarray, color: tuple[int, int, int]) -> None:
    """Gives Gaussians (bool [N]) a mean colour, weighted by opacity; their differences of lightness and hue are kept.

    The shift is made in CIELAB. Where it would leave the range of lightness, differences are compressed instead of
    clipped, so that a mug painted white still has folds and edges. Colour that depends on the viewing direction
    (spherical harmonics above degree 0) becomes colourless, or the old colour would shine through at an angle.
    """
    if not rows.any():
        return
    index = torch.from_numpy(np.flatnonzero(rows))
    lab = cv2.cvtColor(gaussians.rgb[index].clamp(0, 1).numpy()[None], cv2.COLOR_RGB2LAB)[0]
    target = cv2.cvtColor((np.array(color, np.float32) / 255)[None, None], cv2.COLOR_RGB2LAB)[0, 0]
    weights = gaussians.opacities[index].numpy()
    difference = lab - np.average(lab, axis=0, weights=weights)
    low, high = np.percentile(difference[:, 0], [1, 99])
    darker = min(1.0, float(target[0]) / max(-float(low), 1e-6))
    lighter = min(1.0, (100 - float(target[0])) / max(float(high), 1e-6))
    difference[:, 0] *= np.where(difference[:, 0] < 0, darker, lighter)
    painted = np.clip(target + difference, [0, -127, -127], [100, 127, 127]).astype(np.float32)
    rgb = np.clip(cv2.cvtColor(painted[None], cv2.COLOR_LAB2RGB)[0], 0, 1)
    gaussians.sh[index, 0] = rgb_to_sh(torch.from_numpy(rgb))
    gaussians.sh[index, 1:] = (gaussians.sh[index, 1:] @ _LUMINANCE)[..., None].expand(-1, -1, 3)
