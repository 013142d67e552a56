# SPDX-License-Identifier: Apache-2.0
"""Checks intrinsics against the images by themselves: angle of view, shape of pixels, and the principal point, which
shows what image size they are for."""

from __future__ import annotations

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.sequences.verdicts import Verdict
from ggslam.system.tuning import Tuning


class IntrinsicsTuning(Tuning):
    """When intrinsics are doubted by their own numbers."""

    min_angle_deg = 20.0
    """Smallest horizontal angle of view of usual lenses, in degrees."""
    max_angle_deg = 130.0
    """Largest horizontal angle of view of usual lenses, in degrees."""
    max_aspect = 1.25
    """Largest ratio of a pixel's width and height, or the reverse."""
    max_off = 0.2
    """Largest distance of the principal point from the middle, as a share of the image."""
    other_size = 1.4
    """Ratio of twice the principal point and the image's size, or the reverse, that suggests another size."""
    same_size = 0.06
    """Largest difference of that ratio between rows and columns (natural logarithm)."""
    turned_px = 0.5
    """Distance of the principal point from the middle of a turned image up to which it is taken for one, in pixels."""
    min_oblong = 1.05
    """Ratio of width and height, or the reverse, from which a turned image can be told."""
    lens_off = 0.05
    """Distance from the middle, as a share of the image, that lenses stay within; crops may not."""


Size = tuple[int, int]
"""(width, height) in pixels."""


def judge_intrinsics(camera: Camera, stated: Size | None = None, source: str = "") -> list[Verdict]:
    """What is implausible of intrinsics by themselves: "wrong" if they can belong to no such image.

    Args:
        camera: intrinsics of the images.
        stated: size that they were told for before they were brought to that of the images; None: not known.
        source: where they come from, for people.
    """
    told = f" ({source.partition(', scaled')[0]})" if source else ""
    inside = 0 <= camera.cx <= camera.width - 1 and 0 <= camera.cy <= camera.height - 1
    text = _quarter_turn(camera, told) or _other_size(camera, stated, told) or _off_centre(camera, inside, told)
    if not inside:
        return [Verdict("intrinsics", "wrong", text)]
    text = text or _odd_focal(camera, told)
    return [Verdict("intrinsics", "doubtful", text)] if text else []


def _odd_focal(camera: Camera, told: str) -> str:
    angle = 2 * np.degrees(np.arctan(camera.width / (2 * camera.fx)))
    if not IntrinsicsTuning.min_angle_deg <= angle <= IntrinsicsTuning.max_angle_deg:
        size = f"fx {camera.fx:.1f} of images of {camera.width}x{camera.height}"
        return f"intrinsics{told} are suspicious: horizontal angle of view {angle:.0f} degrees ({size}); check fx"
    wide = abs(camera.fy / camera.fx)
    if not 1 / IntrinsicsTuning.max_aspect <= wide <= IntrinsicsTuning.max_aspect:
        text = f"fx {camera.fx:.1f} and fy {camera.fy:.1f} mean pixels {wide:.2f} times as wide as high"
        return f"intrinsics{told} are suspicious: {text}; check fx and fy"
    return ""


def doubt_centre(camera: Camera) -> str:
    """What to check of a principal point that lies clearly beside the middle, as that of a crop does; "": nothing. It
    may be right, so that it is no doubt of its own."""
    if _beside(camera) <= IntrinsicsTuning.lens_off:
        return ""
    middle = f"{(camera.width - 1) / 2:g}, {(camera.height - 1) / 2:g}"
    here = f"cx {camera.cx:.1f} and cy {camera.cy:.1f}"
    return f"check {here}, of images before a crop perhaps: the middle of {camera.width}x{camera.height} is {middle}"


def _beside(camera: Camera) -> float:
    """Distance of the principal point from the middle, share of the image."""
    return max(abs((camera.cx + 0.5) / camera.width - 0.5), abs((camera.cy + 0.5) / camera.height - 0.5))


def _quarter_turn(camera: Camera, told: str) -> str:
    """That the principal point is the middle of images with width and height exchanged; "" if it is not."""
    width, height = camera.width, camera.height
    off = max(abs(camera.cx - (height - 1) / 2), abs(camera.cy - (width - 1) / 2))
    if off > IntrinsicsTuning.turned_px or max(width, height) < IntrinsicsTuning.min_oblong * min(width, height):
        return ""
    point = f"the principal point {camera.cx:.1f}, {camera.cy:.1f} is the middle of {height}x{width}"
    return (
        f"intrinsics{told} are of images turned by 90 degrees: {point}, and the images are {width}x{height}; exchange "
        "fx with fy and cx with cy, or turn the images back"
    )


def _off_centre(camera: Camera, inside: bool, told: str) -> str:
    """That the principal point lies outside of the image, or far from its middle; "" if it does not."""
    size = f"{camera.width}x{camera.height}"
    if not inside:
        text = f"the principal point {camera.cx:.1f}, {camera.cy:.1f} lies outside of the images of {size}"
        return f"intrinsics{told} cannot be of these images: {text}; check cx and cy, and the size they are for"
    off = _beside(camera)
    if off <= IntrinsicsTuning.max_off:
        return ""
    text = f"the principal point lies {off:.0%} of the image away from its middle"
    return f"intrinsics{told} are suspicious: {text} ({camera.cx:.1f}, {camera.cy:.1f} of {size}); check cx and cy"


def _other_size(camera: Camera, stated: Size | None, told: str) -> str:
    """That the principal point is the middle of images of another size; "" if it is not."""
    size = np.array([camera.width, camera.height])
    ratios = 2 * (np.array([camera.cx, camera.cy]) + 0.5) / size
    if ratios.min() <= 0 or abs(np.log(ratios[0] / ratios[1])) > IntrinsicsTuning.same_size:
        return ""
    ratio = float(np.sqrt(ratios.prod()))
    if 1 / IntrinsicsTuning.other_size < ratio < IntrinsicsTuning.other_size:
        return ""
    said = stated or (camera.width, camera.height)
    width, height = np.rint(ratio * np.array(said)).astype(int)
    words = f"the principal point is the middle of images of {width}x{height}, not of {said[0]}x{said[1]}"
    if stated is not None and stated != (camera.width, camera.height):
        words += f", the size that they are given for (the images are {camera.width}x{camera.height})"
    remedy = "give width, height, fx, fy, cx and cy of the same images"
    return f"intrinsics{told} are for another image size: {words}; {remedy}"
