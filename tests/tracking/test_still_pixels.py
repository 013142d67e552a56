# SPDX-License-Identifier: Apache-2.0
"""The compiled parts of the check for a camera that stands still, against plain numpy: exactly the same."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ggslam.abi.arrays import address
from ggslam.abi.core import StillPixelsJob
from ggslam.errors import CoreInputError
from ggslam.native.loader import load_library
from ggslam.system.tuning import overridden
from ggslam.tracking.still_camera import SmallFrame, StillTuning, _pixels_that_stay

WAYS = ((1.0, 0.0), (0.7071, 0.7071), (0.0, 1.0), (-0.7071, 0.7071))


def some_frame(seed: int, like: np.ndarray | None = None, noise: float = 0.0, off: int = 0) -> SmallFrame:
    """A textured image at reduced size, or one like another; a tenth of its depth is unknown."""
    rng = np.random.default_rng(seed)
    grey = cv2.resize(rng.integers(0, 256, (12, 16)).astype(np.float32), (160, 120)) if like is None else like
    grey = np.roll(grey, off, 1) + rng.normal(0, noise, grey.shape).astype(np.float32) if noise else grey
    depth = rng.uniform(1, 3, (120, 160)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    found = SmallFrame(np.ascontiguousarray(grey, np.float32), depth)
    found.prepare()
    return found


def stay(anchor: SmallFrame, now: SmallFrame) -> tuple[np.ndarray, np.ndarray]:
    """What the core says."""
    assert anchor.planes is not None and now.planes is not None
    return _pixels_that_stay(anchor, now)


def pixels_that_stay(anchor: SmallFrame, now: SmallFrame) -> tuple[np.ndarray, np.ndarray, bool]:
    """The compared pixels, whether each stays, and whether most do, all over the image and each way."""
    assert anchor.planes is not None and now.planes is not None
    t, (smooth, gx, gy, *_), shape = StillTuning, anchor.planes, anchor.grey.shape
    textured = (gx * gx + gy * gy > t.min_gradient**2) & (anchor.depth > 0) & (now.depth > 0)
    pixels = np.flatnonzero(textured)
    if len(pixels) < t.min_pixels:
        return pixels[:0], np.zeros(0, bool), False
    pixels = pixels[:: max(1, len(pixels) // t.max_pixels)]
    gx, gy = gx.ravel()[pixels], gy.ravel()[pixels]
    difference = now.planes[0].ravel()[pixels] - smooth.ravel()[pixels]
    slope = np.hypot(gx, gy)
    stays = np.abs(difference - np.median(difference)) < t.max_flow_pixels * slope
    rows, columns = np.divmod(pixels, shape[1])
    cells = rows * t.cells // shape[0] * t.cells + columns * t.cells // shape[1]
    count, still = (np.bincount(c, minlength=t.cells**2) for c in (cells, cells[stays]))
    counted = count >= t.min_cell_pixels
    stay = counted & (still >= t.min_still_share * count)
    over = counted.sum() >= t.cells and stay.sum() >= t.min_still_cells * counted.sum()
    telling = [np.abs(gx / slope * way[0] + gy / slope * way[1]) >= t.across for way in WAYS]
    each = all(one.sum() >= t.min_across and stays[one].mean() >= t.min_still_share for one in telling)
    return pixels, stays, bool(over and each)


@pytest.mark.parametrize("most", [2500, 700])
def test_pixels_are_those_of_numpy(most: int) -> None:
    anchor, decided = some_frame(0), set()
    with overridden(StillTuning, max_pixels=most):
        for seed, (noise, off) in enumerate(((0.5, 0), (4.0, 0), (8.0, 0), (1.0, 1), (1.0, 8))):
            now = some_frame(seed + 1, anchor.grey, noise, off)
            pixels, stays, still = pixels_that_stay(anchor, now)
            found = stay(anchor, now)
            decided.add(still)
            assert len(found[0]) == (len(pixels) if still else 0)
            if still:
                np.testing.assert_array_equal(found[0], pixels)
                np.testing.assert_array_equal(found[1], stays)
                assert not found[1].all() or noise < 1
    assert decided == {True, False}


def test_too_little_texture_says_nothing() -> None:
    anchor = some_frame(0)
    assert len(stay(anchor, some_frame(1, anchor.grey, 0.5))[0])
    with overridden(StillTuning, min_pixels=19201):
        assert not len(stay(anchor, some_frame(1, anchor.grey, 0.5))[0])
    with overridden(StillTuning, min_across=19201):
        assert not len(stay(anchor, some_frame(1, anchor.grey, 0.5))[0])


def test_what_is_no_number_is_not_still() -> None:
    anchor = some_frame(0)
    grey = anchor.grey.copy()
    grey[60] = np.nan
    assert not len(stay(anchor, some_frame(1, grey))[0])


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (160, 120), (1280, 720), (800, 600), (480, 270), (330, 200)])
def test_small_grey_images_are_those_of_opencv(size: tuple[int, int]) -> None:
    """Also where the sides are no multiples, which OpenCV itself shrinks."""
    color = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    color[: size[1] // 2] = np.indices((size[1] // 2, size[0])).sum(0)[..., None] % 256  # halves to be rounded
    found = SmallFrame.of(color, np.ones((size[1], size[0]), np.float32))
    small = cv2.resize(color, found.grey.shape[::-1], interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(found.grey, cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32))


def test_copied_depth_is_counted() -> None:
    depth = np.random.default_rng(0).uniform(-1, 1, 1003).astype(np.float32)
    depth[:4] = np.nan, np.inf, 0, -0.0
    copy = np.zeros(len(depth) + 1, np.float32)
    assert load_library().ggslam_copy_depth(address(depth), len(depth), address(copy)) == np.count_nonzero(depth > 0)
    np.testing.assert_array_equal(copy[:-1], depth)
    assert copy[-1] == 0


def test_images_that_cannot_be_are_refused() -> None:
    library, image = load_library(), np.zeros((120, 160, 3), np.uint8)
    grey = np.zeros((120, 160), np.float32)
    for height, width, factor in ((120, 160, 0), (120, 160, 7), (120, 160, 40), (0, 160, 1), (120, -160, 1)):
        with pytest.raises(CoreInputError):
            library.ggslam_shrink_grey(address(image), height, width, factor, address(grey))
    with pytest.raises(CoreInputError):
        library.ggslam_shrink_grey(None, 120, 160, 1, address(grey))
    with pytest.raises(CoreInputError):
        library.ggslam_copy_depth(None, 5, address(grey))
    with pytest.raises(CoreInputError):
        library.ggslam_copy_depth(address(grey), -1, address(grey))
    with pytest.raises(CoreInputError):
        library.ggslam_still_pixels(StillPixelsJob(height=120, width=160, fewest=1, most=10, cells=4))
