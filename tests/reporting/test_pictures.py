# SPDX-License-Identifier: Apache-2.0
"""Pictures of object ids and identity vectors."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from sklearn.decomposition import PCA

from ggslam.reporting.pictures import IdentityColors, color_of_ids, compare_pictures, legend


def test_ids_have_their_colours_and_outlines_only_where_they_meet() -> None:
    palette = np.random.default_rng(0).integers(1, 255, (65536, 3)).astype(np.uint8)
    ids = np.zeros((6, 8), np.uint16)
    ids[:, 4:] = 65535
    assert (color_of_ids(ids, palette) == palette[ids]).all()
    outlined = color_of_ids(ids, palette, outlines=True)
    black = (outlined == 0).all(-1)
    assert black.any(0).sum() == 1 and black.all(0).sum() == 1 and black.any(0)[3:5].any()
    assert (outlined[~black] == palette[ids][~black]).all()


def test_identities_differ_in_colour_and_keep_it_from_picture_to_picture() -> None:
    rng = np.random.default_rng(1)
    kinds = rng.normal(size=(3, 16)).astype(np.float32)
    colors = IdentityColors(np.repeat(kinds, 50_000, 0))  # more than are fitted
    images = np.stack([np.broadcast_to(kind[:, None, None], (16, 4, 5)) for kind in kinds])
    alpha = np.ones((4, 5), np.float32)
    shown = np.array([colors.picture(image, alpha)[0, 0] for image in images]).astype(int)
    assert min(np.abs(shown[a] - shown[b]).max() for a, b in ((0, 1), (0, 2), (1, 2))) > 100
    faint = colors.picture(0.6 * images[0], 0.6 * alpha).astype(int)
    assert np.abs(faint - shown[0]).max() <= 1  # what is covered by less is not another identity
    alpha[0, 0] = 0.2
    assert not colors.picture(images[0], alpha)[0, 0].any()


@pytest.mark.parametrize("seed", range(4))
def test_identity_colours_are_the_principal_components_of_scikit_learn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vectors = (rng.normal(size=(600, 16)) * np.linspace(3, 0.1, 16) @ rng.normal(size=(16, 16))).astype(np.float32)
    components = PCA(3, svd_solver="full").fit(vectors.astype(float)).transform(vectors)
    low, high = np.percentile(components, [1, 99], axis=0)
    level = np.clip((components - low) / (high - low), 0, 1)
    picture = IdentityColors(vectors).picture(vectors.T.reshape(16, 20, 30), np.ones((20, 30), np.float32))
    ours = picture.reshape(-1, 3) / 255
    mirrored = np.abs(ours - (1 - level)).max(0) < np.abs(ours - level).max(0)  # the sign of a component is free
    assert np.abs(ours - np.where(mirrored, 1 - level, level)).max() < 1.5 / 255


@pytest.mark.parametrize("features", [np.zeros((0, 16)), np.ones((1, 16)), np.zeros((9, 16)), np.ones((9, 2))])
def test_identities_that_are_few_or_all_one(features: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        colors = IdentityColors(features.astype(np.float32))
        picture = colors.picture(np.zeros((features.shape[1], 4, 5), np.float32), np.ones((4, 5), np.float32))
    assert picture.shape == (4, 5, 3) and picture.dtype == np.uint8


def test_a_legend_shows_every_colour() -> None:
    entries = [(f"{i} größe", (i, 255 - i, 7)) for i in range(1, 60)]
    picture = legend(entries, rows=20)
    for _, color in entries:
        assert (picture == color).all(-1).sum() > 100
    assert legend([]).shape[2] == 3


def test_a_comparison_takes_a_third_row() -> None:
    color, depth = np.zeros((10, 12, 3), np.uint8), np.ones((10, 12), np.float32)
    two = compare_pictures(color, color, depth, depth)
    three = compare_pictures(color, color, depth, depth, [color + 50, color, color])
    assert three.shape[0] == two.shape[0] + 14 and (three[: len(two)] == two).all() and (three[-1, 0] == 50).all()
