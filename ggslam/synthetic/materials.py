# SPDX-License-Identifier: Apache-2.0
"""What surfaces look like: small pictures of reflectance, made from noise and patterns."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.system.tuning import Tuning

Color = tuple[float, float, float]
"""Red, green, blue in [0, 1] as shown on a screen (gamma 2.2)."""


class TextureTuning(Tuning):
    """How fine textures are."""

    size = 512
    """Pixels along each side of a tiled texture."""


@dataclass(frozen=True, eq=False)
class Material:
    """A texture.

    Attributes:
        image: float32 [h, w, 3], linear reflectance; the last row is the lowest on an upright face.
        tile: metres that one copy of the image covers along its width; None: stretched once over each face.
        grain: turn the texture so that its width runs along the longer side of a face.
        emission: 0: lit by the scene; above: shines by itself with reflectance times this.
    """

    image: np.ndarray
    tile: float | None = None
    grain: bool = False
    emission: float = 0.0

    def pyramid(self) -> list[np.ndarray]:
        """The image and its successive halves, for views from afar."""
        levels = [self.image]
        while min(levels[-1].shape[:2]) >= 8:
            height, width = levels[-1].shape[:2]
            levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
        return levels


class MaterialMaker:
    """Makes textures from one random generator: the same seed gives the same pictures."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    # --- building blocks ---------------------------------------------------------------------------------------------

    def noise(
        self,
        height: int = TextureTuning.size,
        width: int = TextureTuning.size,
        slope: float = 1.0,
        stretch: float = 1.0,
    ) -> np.ndarray:
        """Cloudy noise [height, width] that tiles, mean 0, deviation 1; power falls with frequency^-2 slope.

        `stretch` above 1 draws it out along the width (wood grain).
        """
        fy = np.fft.fftfreq(height)[:, None] * height
        fx = np.fft.rfftfreq(width)[None, :] * width * stretch
        frequency = np.sqrt(fx**2 + fy**2)
        frequency[0, 0] = 1.0
        spectrum = np.fft.rfft2(self.rng.standard_normal((height, width))) / frequency**slope
        spectrum[0, 0] = 0
        values = np.fft.irfft2(spectrum, (height, width))
        return values / values.std()

    def finish(self, image: np.ndarray, tile: float | None, grain: bool = False, emission: float = 0.0) -> Material:
        """Material of a picture in screen colours."""
        linear = np.clip(image, 0.01, 0.97) ** 2.2
        return Material(np.ascontiguousarray(linear, np.float32), tile, grain, emission)

    def plain(self, color: Color, contrast: float = 0.03, tile: float = 0.6, emission: float = 0.0) -> Material:
        """One colour with a little cloudiness and speckle."""
        shade = contrast * (0.6 * self.noise(256, 256, 1.2) + 0.5 * self.noise(256, 256, 0.4))
        return self.finish(np.array(color) * (1 + shade[..., None]), tile, emission=emission)

    def wood(self, dark: Color, light: Color, tile: float = 0.9) -> Material:
        """Straight grain along the width."""
        return self.finish(_mix(dark, light, self._grain(TextureTuning.size, TextureTuning.size)), tile, grain=True)

    def _grain(self, height: int, width: int) -> np.ndarray:
        rings = np.sin(3.0 * self.noise(height, width, 1.5, 10.0) + 1.2 * self.noise(height, width, 1.2, 4.0))
        return np.clip(0.5 + 0.28 * rings + 0.16 * self.noise(height, width, 0.5, 12.0), 0, 1)

    # --- floors and walls --------------------------------------------------------------------------------------------

    def planks(self, dark: Color, light: Color, rows: int = 8, tile: float = 1.6) -> Material:
        """Floor boards along the width, each with its own tone and grain."""
        image = np.empty((TextureTuning.size, TextureTuning.size, 3))
        height = TextureTuning.size // rows
        for row in range(rows):
            band = _mix(dark, light, self._grain(height, TextureTuning.size))
            cut = int(self.rng.integers(TextureTuning.size // 8, 7 * TextureTuning.size // 8))
            for part in (slice(0, cut), slice(cut, TextureTuning.size)):
                band[:, part] *= 1 + 0.14 * self.rng.standard_normal()
            band[:, [cut, cut - 1]] *= 0.45
            band[[0, -1]] *= 0.5
            image[row * height : (row + 1) * height] = band
        return self.finish(image, tile)

    def bricks(self, color: Color, mortar: Color, tile: float = 1.28) -> Material:
        """Running bond, 16 rows a tile."""
        rows, columns, joint = 16, 5, 4
        height, width = TextureTuning.size // rows, TextureTuning.size / columns
        y, x = np.mgrid[: TextureTuning.size, : TextureTuning.size]
        row = y // height
        shifted = (x + (row % 2) * width / 2) % TextureTuning.size
        column = (shifted // width).astype(int)
        wobble = 1.2 * self.noise(slope=1.0)
        inside = (y % height + wobble > joint) & (shifted % width + wobble > joint)
        tone = 1 + 0.13 * self.rng.standard_normal((rows, columns))[row, column]
        hue = 0.022 * self.rng.standard_normal((rows, columns, 3))[row, column]
        rough = 1 + 0.07 * self.noise(slope=0.5)
        brick = (np.array(color) + hue) * (tone * rough)[..., None]
        return self.finish(np.where(inside[..., None], brick, np.array(mortar) * rough[..., None]), tile)

    def wallpaper(self, ground: Color, motif: Color, tile: float = 0.5) -> Material:
        """Staggered flower-like motifs."""
        y, x = np.mgrid[:256, :256] / 256.0
        strength = np.zeros((256, 256))
        for cx, cy in ((0.25, 0.25), (0.75, 0.75)):
            dx, dy = (x - cx + 0.5) % 1 - 0.5, (y - cy + 0.5) % 1 - 0.5
            radius, angle = np.hypot(dx * 1.25, dy), np.arctan2(dy, dx)
            petals = 0.13 + 0.055 * np.cos(6 * angle)
            strength = np.maximum(strength, _step((petals - radius) * 60) - _step((0.045 - radius) * 60))
            strength = np.maximum(strength, _step((0.012 - np.abs(radius - 0.215)) * 120))
        strength = np.maximum(strength, 0.35 * _step((np.abs(np.sin(8 * np.pi * x)) - 0.96) * 60))
        image = _mix(ground, motif, strength) * (1 + 0.025 * self.noise(256, 256, 0.5))[..., None]
        return self.finish(image, tile)

    def plaster(self, color: Color, tile: float = 1.5) -> Material:
        """Painted wall with faint unevenness."""
        shade = 0.022 * self.noise(slope=1.3) + 0.012 * self.noise(slope=0.2)
        return self.finish(np.array(color) * (1 + shade[..., None]), tile)

    def stripes(self, first: Color, second: Color, count: int = 4, tile: float = 0.8) -> Material:
        """Upright stripes."""
        x = np.arange(256) / 256.0
        strength = np.broadcast_to(_step(np.sin(2 * np.pi * count * x) * 12), (256, 256))
        return self.finish(_mix(first, second, strength) * (1 + 0.03 * self.noise(256, 256, 0.6))[..., None], tile)

    def limewash(self, color: Color, contrast: float, tile: float = 2.4) -> Material:
        """Limewash, carpet, stone: irregular patches of all sizes, no two alike within a tile."""
        shade = contrast * (0.7 * self.noise(slope=1.1) + 0.5 * self.noise(slope=0.6))
        hue = 0.25 * contrast * np.stack([self.noise(slope=1.3) for _ in range(3)], -1)
        return self.finish(np.array(color) * (1 + shade[..., None] + hue), tile)

    def tiles(self, first: Color, second: Color, joint: Color, across: int, tile: float) -> Material:
        """Square tiles of two colours by turns, each with its own tone; `across` (even) of them a copy."""
        y, x = np.mgrid[: TextureTuning.size, : TextureTuning.size] * across / TextureTuning.size
        row, column = y.astype(int), x.astype(int)
        tone = 1 + 0.10 * self.rng.standard_normal((across, across))[row, column] + 0.05 * self.noise(slope=0.7)
        image = _mix(first, second, ((row + column) % 2).astype(float)) * tone[..., None]
        inside = (np.abs(y % 1 - 0.5) < 0.475) & (np.abs(x % 1 - 0.5) < 0.475)
        return self.finish(np.where(inside[..., None], image, np.array(joint)), tile)

    # --- cloth and things --------------------------------------------------------------------------------------------

    def fabric(self, color: Color, tile: float = 0.35) -> Material:
        """Coarse weave."""
        y, x = np.mgrid[:256, :256]
        weave = np.sin(2 * np.pi * x * 32 / 256) * np.sin(2 * np.pi * y * 32 / 256)
        shade = 0.05 * weave + 0.06 * self.noise(256, 256, 0.6) + 0.05 * self.noise(256, 256, 1.3)
        return self.finish(np.array(color) * (1 + shade[..., None]), tile)

    def folds(self, color: Color, count: int = 7) -> Material:
        """Curtain with upright folds."""
        x = np.linspace(0, 1, 256)[None, :] + 0.004 * self.noise(256, 256, 1.5)
        shade = 0.16 * np.sin(2 * np.pi * count * x) + 0.05 * np.sin(2 * np.pi * 2.7 * count * x + 1)
        image = np.array(color) * (1 + shade + 0.02 * self.noise(256, 256, 0.5))[..., None]
        return self.finish(image, None)

    def rug(self, ground: Color, first: Color, second: Color) -> Material:
        """Bordered carpet with rows of diamonds."""
        height, width = 340, 512
        y, x = np.mgrid[:height, :width] / 512.0
        border = np.minimum.reduce([x, y, 1 - x, height / 512 - y])
        diamond = np.abs((x * 9) % 1 - 0.5) + np.abs((y * 9 + 0.05) % 1 - 0.5)
        image = _mix(ground, first, _step((0.36 - diamond) * 30))
        image = _mix(image, second, _step((0.17 - diamond) * 30))
        image = _mix(image, first, ((border < 0.075) & (border > 0.025)).astype(float))
        image = _mix(image, second, ((border < 0.058) & (border > 0.042)).astype(float))
        image = image * (1 + 0.08 * self.noise(height, width, 0.3) + 0.04 * self.noise(height, width, 1.2))[..., None]
        return self.finish(image, None)

    def checker(self, first: Color, second: Color, across: int = 8) -> Material:
        """Chequered, `across` fields over a face's width and half as many over its height."""
        y, x = np.mgrid[:128, :256]
        fields = (x * across // 256 + y * across // 256) % 2
        image = _mix(first, second, fields.astype(float)) * (1 + 0.03 * self.noise(128, 256, 0.8))[..., None]
        return self.finish(image, None)

    def bands(self, colors: list[Color], height: int = 128) -> Material:
        """Horizontal bands of random width, stretched over the face: book spines, mugs, balls."""
        edges = np.sort(self.rng.uniform(0.05, 0.95, len(colors) - 1))
        row = np.searchsorted(edges, np.linspace(0, 1, height))
        image = np.repeat(np.array(colors)[row][:, None], 128, 1) * (1 + 0.04 * self.noise(height, 128, 0.8))[..., None]
        return self.finish(image, None)


def _step(x: np.ndarray) -> np.ndarray:
    """Smooth step from 0 to 1 around x = 0, about 1 wide."""
    return np.clip(0.5 + x, 0, 1)


def _mix(first: Color | np.ndarray, second: Color | np.ndarray, share: np.ndarray) -> np.ndarray:
    """first + share (second - first) for colours and a share [h, w]."""
    return np.asarray(first) * (1 - share[..., None]) + np.asarray(second) * share[..., None]
