# SPDX-License-Identifier: Apache-2.0
"""Image scores follow their written definitions; masks, holes and exposure do what their names say."""

from __future__ import annotations

import json
import math
import weakref
from collections.abc import Iterator

import numpy as np
import pytest

from ggslam.evaluation.image_sets import ImageScoreMean, RenderedView, score_images
from ggslam.evaluation.images import ImageScores, depth_errors, fit_colors, psnr, score_image, ssim_map
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

RANDOM = np.random.default_rng(5)


def images(height: int = 24, width: int = 31) -> tuple[np.ndarray, np.ndarray]:
    reference = RANDOM.random((height, width, 3), dtype=np.float32)
    return (reference + 0.1 * RANDOM.normal(size=reference.shape).astype(np.float32)).clip(0, 1), reference


def test_psnr_by_hand() -> None:
    reference = np.full((4, 5, 3), 0.5, np.float32)
    image = reference.copy()
    image[0, 0, 0] += 0.3
    assert psnr(image, reference) == pytest.approx(10 * math.log10(60 / 0.09), rel=1e-6)
    mask = np.zeros((4, 5), bool)
    mask[0, :2] = True
    assert psnr(image, reference, mask) == pytest.approx(10 * math.log10(6 / 0.09), rel=1e-6)
    assert psnr(image, reference, ~mask) == psnr(reference, reference) == 100
    assert math.isnan(psnr(image, reference, np.zeros((4, 5), bool)))


def ssim_as_written(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, for each pixel with its own window; mirrored border."""
    t = np.arange(-5, 6)
    window = np.exp(-(t[:, None] ** 2 + t[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    padded = [np.pad(a.astype(float), ((5, 5), (5, 5), (0, 0)), mode="reflect") for a in (x, y)]
    out = np.empty(x.shape)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            a, b = (p[i : i + 11, j : j + 11] for p in padded)
            mean_a, mean_b = (window * a).sum((0, 1)), (window * b).sum((0, 1))
            var_a = (window * (a - mean_a) ** 2).sum((0, 1))
            var_b = (window * (b - mean_b) ** 2).sum((0, 1))
            cov = (window * (a - mean_a) * (b - mean_b)).sum((0, 1))
            c1, c2 = 0.01**2, 0.03**2
            out[i, j] = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
            out[i, j] /= (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    return out.mean(-1)


def test_ssim_is_the_written_formula() -> None:
    image, reference = images()
    np.testing.assert_allclose(ssim_map(image, reference), ssim_as_written(image, reference), atol=2e-5)
    np.testing.assert_allclose(ssim_map(reference, reference), 1, atol=1e-5)


def test_masked_scores_ignore_pixels_without_depth() -> None:
    image, reference = images()
    depth = np.ones(reference.shape[:2], np.float32)
    depth[:, 20:] = 0
    depth[0, 0] = np.nan
    scores = score_image(image, depth, reference, depth)
    assert scores.ssim == pytest.approx(float(ssim_map(image, reference)[depth > 0].mean()), abs=1e-6)
    assert scores.ssim_unmasked == pytest.approx(float(ssim_map(image, reference).mean()), abs=1e-6)
    spoiled = image.copy()
    spoiled[:, 26:] = 0  # farther from the mask than half a window
    after = score_image(spoiled, depth, reference, depth)
    assert (after.psnr, after.ssim, after.psnr_affine) == pytest.approx((scores.psnr, scores.ssim, scores.psnr_affine))
    assert after.psnr_unmasked < scores.psnr_unmasked - 3 and after.ssim_unmasked < scores.ssim_unmasked


def test_affine_psnr_forgives_exposure_only() -> None:
    reference = RANDOM.random((20, 30, 3), dtype=np.float32) * 0.5 + 0.2
    mask = RANDOM.random((20, 30)) > 0.3
    exposed = (reference * [0.8, 1.1, 0.9] + [0.05, -0.02, 0.1]).astype(np.float32)
    scores = score_image(exposed, None, reference, mask.astype(np.float32))
    assert scores.psnr < 30 and scores.psnr_affine > 90
    swapped = score_image(reference[..., ::-1].copy(), None, reference, mask.astype(np.float32))
    assert swapped.psnr_affine < 20
    for _ in range(5):  # never worse than without
        image, other = images()
        everything = np.ones(image.shape[:2], bool)
        assert psnr(fit_colors(image, other, everything), other) >= psnr(image, other) - 1e-9


def test_affine_psnr_is_the_best_of_least_squares() -> None:
    image, reference = images()
    mask = RANDOM.random(image.shape[:2]) > 0.4
    fitted = fit_colors(image, reference, mask)
    for channel in range(3):
        design = np.stack([image[..., channel][mask], np.ones(mask.sum())], 1)
        solution = np.linalg.lstsq(design, reference[..., channel][mask], rcond=None)[0]
        np.testing.assert_allclose(fitted[..., channel][mask], design @ solution, atol=1e-6)


def test_depth_errors_and_holes() -> None:
    measured = np.array([[1.0, 2.0, 0.0, 4.0], [1.0, 1.0, np.nan, 1.0]], np.float32)
    rendered = np.array([[1.1, 2.0, 9.0, 0.0], [1.0, 1.4, 9.0, np.nan]], np.float32)
    found = depth_errors(rendered, measured)
    assert found == pytest.approx({"depth_l1_m": 0.125, "depth_l1_median_m": 0.05, "depth_coverage": 4 / 6}, abs=1e-6)
    assert depth_errors(rendered, np.zeros_like(measured)) == {}
    assert depth_errors(np.zeros_like(rendered), measured) == {"depth_coverage": 0.0}


def test_bytes_and_floats_score_alike_and_wild_values_are_clipped() -> None:
    bytes_image, bytes_reference = ((255 * x).astype(np.uint8) for x in images())
    depth = np.ones(bytes_image.shape[:2], np.float32)
    a = score_image(bytes_image, depth, bytes_reference, depth)
    b = score_image(bytes_image / np.float32(255), depth, bytes_reference, depth)
    assert a.to_dict() == pytest.approx(b.to_dict(), nan_ok=True)
    wild = bytes_image / np.float32(255)
    wild[0, 0], wild[1, 1] = 7.0, np.nan
    tame = wild.copy()
    tame[0, 0], tame[1, 1] = 1.0, 0.0
    assert (
        score_image(wild, depth, bytes_reference, depth).psnr == score_image(tame, depth, bytes_reference, depth).psnr
    )
    with pytest.raises(ValueError, match="sizes differ"):
        score_image(wild[:10], depth, bytes_reference, depth)


def test_a_frame_without_depth_has_unmasked_scores_only() -> None:
    image, reference = images()
    nothing = np.zeros(image.shape[:2], np.float32)
    found = score_image(image, nothing, reference, nothing).to_dict()
    known = {name for name, value in found.items() if value is not None}
    assert known == {"psnr_unmasked", "ssim_unmasked"}


def test_lpips_masked_and_unmasked() -> None:
    calls = []

    def record(image: np.ndarray, reference: np.ndarray) -> float:
        calls.append((image, reference))
        return 0.25 * len(calls)

    image, reference = images(40, 40)
    depth = np.ones((40, 40), np.float32)
    scores = score_image(image, None, reference, depth, record)  # type: ignore[arg-type]
    assert len(calls) == 1 and scores.lpips == scores.lpips_unmasked == 0.25
    depth[:, 30:] = 0
    scores = score_image(image, None, reference, depth, record)  # type: ignore[arg-type]
    assert (scores.lpips_unmasked, scores.lpips) == (0.5, 0.75)
    assert all((x[:, 30:] == 0).all() and (x[:, :30] != 0).any() for x in calls[2])


def frames(count: int, held: list[weakref.ref]) -> Iterator[Frame]:
    for index in range(count):
        color = np.full((12, 16, 3), 10 * index, np.uint8)
        held.append(weakref.ref(color))
        depth = np.full((12, 16), 1.0, np.float32)
        yield Frame(index, index, index / 30, color, depth, Camera(16, 12, 20, 20, 7.5, 5.5))
        del color


def test_sets_are_scored_from_a_stream() -> None:
    held: list[weakref.ref] = []
    most_alive, seen = 0, []

    def render(frame: Frame) -> RenderedView | None:
        nonlocal most_alive
        most_alive = max(most_alive, sum(ref() is not None for ref in held))
        if frame.index == 3:
            return None
        shown = np.clip(frame.color / 255 + 0.01 * (1 + frame.index), 0, 1)
        elsewhere = np.clip(frame.color / 255 + 0.1, 0, 1) if frame.index else None
        return RenderedView(shown, frame.depth + 0.01 * frame.index, elsewhere)

    found = score_images(
        render, frames(8, held), {"keyframes": {0, 2}, "held_out": range(1, 8, 2)},
        on_frame=lambda frame, scores: seen.append(frame.index),
    )  # fmt: skip
    assert seen == [0, 1, 2, 3, 5, 7] and most_alive <= 2
    keyframes, held_out = found["keyframes"], found["held_out"]
    assert (keyframes.frames, keyframes.frames_without_pose) == (2, 0)
    assert (held_out.frames, held_out.frames_without_pose) == (3, 1)
    assert keyframes.mean().psnr == pytest.approx((40 - 20 * math.log10(3) + 40) / 2, abs=1e-3)
    assert keyframes.mean().psnr_3dgs == pytest.approx(20, abs=1e-3)  # of the frame that has one
    assert held_out.mean().depth_l1_m == pytest.approx((0.01 + 0.05 + 0.07) / 3, abs=1e-6)
    everything = score_images(render, frames(8, []), {"all": None})
    assert everything["all"].frames == 7
    json.dumps({name: mean.to_dict() for name, mean in found.items()}, allow_nan=False)


def test_means_leave_missing_scores_out() -> None:
    mean = ImageScoreMean()
    assert mean.to_dict()["psnr"] is None
    mean.add(ImageScores(psnr=20.0))
    mean.add(ImageScores(psnr=30.0, ssim=0.5))
    assert (mean.mean().psnr, mean.mean().ssim, mean.frames) == (25.0, 0.5, 2)
    assert math.isnan(mean.mean().lpips)


def test_exposed_psnr_brings_the_frame_to_the_maps_exposure() -> None:
    shown = (0.2 + 0.3 * RANDOM.random((24, 32, 3))).astype(np.float32)
    exposure, typical = np.array([[1.2, 0.05], [0.9, -0.03], [1.1, 0.1]]), np.array([1.1, 0.95, 1.0])
    recorded = np.rint(255 * (shown * exposure[:, 0] + exposure[:, 1])).astype(np.uint8)
    frame = Frame(0, 0, 0.0, recorded, np.ones((24, 32), np.float32), Camera(32, 24, 20, 20, 15.5, 11.5))
    right = RenderedView(shown, exposure=exposure, typical=typical).score(frame)
    assert right.psnr < 25 and right.psnr_exposed > 50
    for wrong in (np.array([0, 0.02]), np.array([0.05, 0])):
        assert RenderedView(shown, exposure=exposure + wrong, typical=typical).score(frame).psnr_exposed < 40
