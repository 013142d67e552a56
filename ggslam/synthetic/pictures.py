# SPDX-License-Identifier: Apache-2.0
"""Materials that are drawn rather than woven: paintings, a window's view, screens, doors, clock faces."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.synthetic.materials import Color, Material, MaterialMaker


def _canvas(height: int, width: int, color: Color) -> np.ndarray:
    return np.full((height, width, 3), color, np.float64)


def landscape(make: MaterialMaker, sky: Color, emission: float = 0.0) -> Material:
    """Sky, clouds, layered hills and trees; with emission it is the view from a window."""
    height, width = 256, 320
    rows = np.linspace(0, 1, height)[:, None, None]
    image = np.array(sky) * (1 - 0.45 * rows) + np.array((0.95, 0.93, 0.86)) * 0.45 * rows
    clouds = np.clip(make.noise(height, width, 1.4, 0.5) - 0.4, 0, 1)[..., None]
    image = image * (1 - 0.6 * clouds) + 0.6 * clouds
    y = np.arange(height)[:, None]
    for depth, color in enumerate(((0.45, 0.56, 0.62), (0.36, 0.52, 0.36), (0.27, 0.42, 0.20))):
        line = height * (0.52 + 0.14 * depth) + 14 * make.noise(4, width, 1.6)[0]
        below = y > line[None, :]
        image[below] = np.array(color) * (1 + 0.1 * make.noise(height, width, 0.7)[below][:, None])
    for _ in range(14):
        x, foot, size = make.rng.integers(0, width), int(make.rng.integers(150, 250)), int(make.rng.integers(8, 24))
        shade = tuple(np.array((0.16, 0.32, 0.14)) * make.rng.uniform(0.7, 1.3))
        cv2.line(image, (int(x), foot), (int(x), foot - size), (0.3, 0.2, 0.12), 2)
        cv2.ellipse(image, (int(x), foot - size - size // 2), (size // 2, size), 0, 0, 360, shade, -1, cv2.LINE_AA)
    return make.finish(image, None, emission=emission)


def abstract(make: MaterialMaker, palette: list[Color]) -> Material:
    """Painting of overlapping discs and bars."""
    height, width = 240, 240
    image = _canvas(height, width, palette[0])
    for i in range(16):
        color = tuple(np.clip(np.array(palette[1 + i % (len(palette) - 1)]) * make.rng.uniform(0.8, 1.2), 0, 1))
        x, y, size = (int(v) for v in make.rng.integers((0, 0, 14), (width, height, 60)))
        if i % 3:
            cv2.circle(image, (x, y), size // 2 + 6, color, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(image, (x - size, y - size // 4), (x + size, y + size // 4), color, -1)
    image *= (1 + 0.05 * make.noise(height, width, 0.6))[..., None]
    return make.finish(image, None)


def portrait(make: MaterialMaker, ground: Color, figure: Color) -> Material:
    """A vase of flowers on a ground, for upright frames."""
    height, width = 300, 220
    image = _canvas(height, width, ground) * (1 + 0.06 * make.noise(height, width, 1.2))[..., None]
    cv2.rectangle(image, (0, 240), (width, height), tuple(np.array(ground) * 0.5), -1)
    cv2.ellipse(image, (110, 215), (34, 48), 0, 0, 360, figure, -1, cv2.LINE_AA)
    for _ in range(18):
        x, y = int(make.rng.integers(50, 170)), int(make.rng.integers(50, 165))
        cv2.line(image, (110, 180), (x, y), (0.2, 0.4, 0.2), 2, cv2.LINE_AA)
        petals = tuple(make.rng.uniform(0.35, 0.95, 3))
        cv2.circle(image, (x, y), int(make.rng.integers(8, 17)), petals, -1, cv2.LINE_AA)
        cv2.circle(image, (x, y), 4, (0.95, 0.85, 0.3), -1, cv2.LINE_AA)
    return make.finish(image, None)


def screen(make: MaterialMaker, ground: Color, lines: int = 14) -> Material:
    """A computer screen with windows and lines of text; shines a little."""
    height, width = 180, 300
    image = _canvas(height, width, ground)
    cv2.rectangle(image, (0, 0), (width, 12), (0.25, 0.27, 0.32), -1)
    for i in range(lines):
        y = 22 + i * 11
        indent = int(make.rng.integers(0, 4)) * 12
        color = tuple(make.rng.uniform(0.45, 0.95, 3))
        cv2.line(image, (16 + indent, y), (16 + indent + int(make.rng.integers(20, 110)), y), color, 3)
    for x, shade in ((190, 0.55), (222, 0.8), (254, 0.4)):
        cv2.rectangle(image, (x, 160 - int(110 * shade)), (x + 22, 160), (0.2, 0.3 + shade / 2, 0.75), -1)
    return make.finish(image, None, emission=0.75)


def diagram(make: MaterialMaker) -> Material:
    """A whiteboard with boxes, arrows and handwriting."""
    height, width = 240, 360
    image = _canvas(height, width, (0.93, 0.94, 0.95)) * (1 + 0.02 * make.noise(height, width, 1.2))[..., None]
    inks = [(0.15, 0.25, 0.65), (0.70, 0.15, 0.15), (0.12, 0.45, 0.22), (0.1, 0.1, 0.12)]
    for i in range(9):
        x, y = 20 + 118 * (i % 3) + int(make.rng.integers(0, 24)), 16 + 76 * (i // 3) + int(make.rng.integers(0, 18))
        ink = inks[int(make.rng.integers(len(inks)))]
        cv2.rectangle(image, (x, y), (x + 72, y + 42), ink, 2, cv2.LINE_AA)
        for line in range(3):
            ends = (x + 8, y + 10 + 11 * line), (x + int(make.rng.integers(24, 66)), y + 10 + 11 * line)
            cv2.line(image, *ends, inks[3], 2, cv2.LINE_AA)
        cv2.arrowedLine(image, (x + 74, y + 20), (x + 100, y + int(make.rng.integers(0, 40))), ink, 2, cv2.LINE_AA)
    return make.finish(image, None)


def door(make: MaterialMaker, color: Color) -> Material:
    """A panelled door."""
    height, width = 400, 180
    image = _canvas(height, width, color) * (1 + 0.03 * make.noise(height, width, 0.8))[..., None]
    dark, light = tuple(np.array(color) * 0.62), tuple(np.minimum(np.array(color) * 1.12, 1))
    for top, bottom in ((24, 150), (172, 236), (258, 376)):
        for left, right in ((22, 82), (98, 158)):
            cv2.rectangle(image, (left, top), (right, bottom), dark, 3)
            cv2.rectangle(image, (left + 5, top + 5), (right - 5, bottom - 5), light, 2)
    return make.finish(image, None)


def drawers(make: MaterialMaker, color: Color, columns: int, rows: int) -> Material:
    """Front of a chest: drawers with knobs, on wood-like ground."""
    height, width = 256, 512
    image = _canvas(height, width, color) * (1 + 0.09 * make.noise(height, width, 1.0, 10.0))[..., None]
    for i in range(columns):
        for j in range(rows):
            left, top = i * width // columns, j * height // rows
            right, bottom = (i + 1) * width // columns, (j + 1) * height // rows
            cv2.rectangle(image, (left + 6, top + 6), (right - 6, bottom - 6), tuple(np.array(color) * 0.45), 4)
            centre = ((left + right) // 2, (top + bottom) // 2)
            cv2.circle(image, centre, 9, (0.85, 0.78, 0.5), -1, cv2.LINE_AA)
    return make.finish(image, None)


def clock(make: MaterialMaker) -> Material:
    """A clock face for the cap of a cylinder."""
    image = _canvas(256, 256, (0.95, 0.94, 0.9))
    for hour in range(12):
        angle = np.pi * hour / 6
        inner, outer = 92 if hour % 3 else 80, 108
        ends = [(int(128 + r * np.sin(angle)), int(128 - r * np.cos(angle))) for r in (inner, outer)]
        cv2.line(image, ends[0], ends[1], (0.1, 0.1, 0.12), 6 if hour % 3 else 10, cv2.LINE_AA)
    cv2.line(image, (128, 128), (85, 95), (0.1, 0.1, 0.12), 9, cv2.LINE_AA)
    cv2.line(image, (128, 128), (190, 75), (0.1, 0.1, 0.12), 6, cv2.LINE_AA)
    cv2.circle(image, (128, 128), 122, (0.15, 0.15, 0.17), 9, cv2.LINE_AA)
    return make.finish(image, None)


def globe(make: MaterialMaker) -> Material:
    """Continents and seas."""
    height, width = 128, 256
    land = make.noise(height, width, 1.6) > 0.35
    sea = np.array((0.22, 0.42, 0.65)) * (1 + 0.04 * make.noise(height, width, 0.8))[..., None]
    earth = np.array((0.62, 0.60, 0.32)) * (1 + 0.14 * make.noise(height, width, 0.9))[..., None]
    image = np.where(land[..., None], earth, sea)
    image[::16] *= 0.85
    return make.finish(image, None)
