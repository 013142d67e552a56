# SPDX-License-Identifier: Apache-2.0
"""Colours that depend on the view, for the Gaussians whose views ask for them.

Training gives every Gaussian the one colour that suits most of its views (an L1 norm asks for the median). What views
miss then is a linear problem: each view tells by how much a Gaussian's pixels are brighter or darker on average, and
harmonics of degree 1 and above are fitted to that by ridge regression, in closed form. So noise of single steps does
not become colour, as it does with an optimiser that makes every gradient equally long; directions that no view has seen
stay as they are; and the constant part is the colour that was trained, which formats and viewers without harmonics
show as before.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import ViewColorsOfView
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class ViewColorTuning(Tuning):
    """Colours that are fitted to what views show."""

    degree = 2
    """Of the harmonics. Degree 1 gains half as much; degree 3 little more, for twice the numbers."""
    ridge = 0.03
    """Added to the diagonal of a Gaussian's equations, in pixels of all views: what fewer see stays as it is."""
    noisy_ridge = 0.1
    """The same where depth is noisy, and misplaced surfaces look like reflections."""
    usual_residual = 0.02
    """Difference of colours, 0 to 1, above which views weigh less: a shadow is not to become a reflection."""
    least_pixels = 0.05
    """Weight in a view, pixels, below which it says nothing of a Gaussian."""
    most_pixels = 8.0
    """Weight in a view, pixels, above which it says no more."""
    least_gain = 1e-3
    """Squared colours, summed over pixels and channels of all views, that harmonics have to explain to be given: those
    of ten pixels that differ by 1.5 of 255."""
    least_share = 0.1
    """Share of the Gaussians that ask for harmonics below which none gets any, and the map stays of degree 0: a room
    without any shine has 0.04, livingroom 0.27."""
    most_bytes = 128 << 20
    """Memory of the equations. If there are more, Gaussians have their turns and all views are rendered for each."""


@dataclass(frozen=True)
class ShownColors:
    """What a view shows of Gaussians, as a rasterizer's `backward` tells by gradients of their constant coefficients.

    Attributes:
        centre: of the camera [3], world frame.
        weights: gradient of the sum over the image's pixels, [N, K, 3].
        residuals: gradient of the sum of the colours missing at each pixel times what is rendered there, [N, K, 3].
    """

    centre: np.ndarray
    weights: torch.Tensor
    residuals: torch.Tensor


def fit_view_colors(
    gaussians: GaussianMap, views: Callable[[], Iterator[ShownColors]], ridge: float, context: NativeContext
) -> float:
    """Adds harmonics to the Gaussians that ask for them, if enough do; returns their share.

    Args:
        gaussians: the map, on any device; its degree rises if need be.
        views: what views show of it as it is, on the CPU; is called anew for each group of Gaussians.
        ridge: see `ViewColorTuning.ridge`.
        context: threads to work on. The result is the same, bit for bit, for any number of them.
    """
    found = [(begin, *_fit(gaussians, begin, views, ridge, context)) for begin in _begins(gaussians.count)]
    share = sum(len(rows) for _, rows, _ in found) / max(1, gaussians.count)
    if share < ViewColorTuning.least_share:
        return 0.0
    gaussians.raise_degree(ViewColorTuning.degree)
    count = _unknowns()
    for begin, rows, added in found:
        index = torch.from_numpy(begin + rows).to(gaussians.device)
        gaussians.sh[index, 1 : count + 1] += torch.from_numpy(added).to(gaussians.device)
    return share


def _unknowns() -> int:
    return int((ViewColorTuning.degree + 1) ** 2 - 1)


def _row_floats() -> int:
    count = _unknowns()
    return count * (count + 1) // 2 + 3 * count


def _group() -> int:
    """Gaussians whose equations are made at once."""
    return max(1, int(ViewColorTuning.most_bytes) // (4 * _row_floats()))


def _begins(count: int) -> range:
    return range(0, count, _group())


def _fit(
    gaussians: GaussianMap, begin: int, views: Callable[[], Iterator[ShownColors]], ridge: float, context: NativeContext
) -> tuple[np.ndarray, np.ndarray]:
    """Rows from `begin` on [M] that ask for harmonics, and these [M, K - 1, 3]."""
    library, t = load_library(), ViewColorTuning
    means = gaussians.means[begin : begin + _group()].cpu().numpy()
    equations = np.zeros((len(means), _row_floats()), np.float32)
    for view in views():
        weights, residuals = (array.numpy()[begin : begin + len(means)] for array in (view.weights, view.residuals))
        job = ViewColorsOfView(
            address(means), address(weights), address(residuals), address(equations), gaussians=len(means),
            stride=weights[0].size, count=_unknowns(), least_weight=t.least_pixels, most_weight=t.most_pixels,
            usual_residual=t.usual_residual,
        )  # fmt: skip
        job.centre[:] = view.centre.tolist()
        library.ggslam_view_colors_add(context.handle, ctypes.byref(job))
    gains = np.empty(len(means), np.float32)
    library.ggslam_view_colors_solve(
        context.handle, address(equations), len(means), _unknowns(), ridge, address(gains)
    )  # fmt: skip
    rows = np.flatnonzero(gains >= t.least_gain)
    return rows, equations[rows, -3 * _unknowns() :].reshape(len(rows), _unknowns(), 3)
