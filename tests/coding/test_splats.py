# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps through the splat preset: what is kept exactly, what nearly, and what the pictures lose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ggslam.coding import AttributeSettings, CodecSettings, PointCloud, decode_cloud, encode_cloud
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.splats import (
    POSITION_BITS,
    RANGES,
    RATES,
    VALUE_BITS,
    gaussians_of,
    is_splat_cloud,
    splat_attributes,
    splat_settings,
)
from ggslam.errors import ConfigError, FormatError
from ggslam.evaluation.images import score_image
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
BARS = {
    0: {"r01": (26.0, 0.90), "r02": (32.5, 0.97), "r03": (39.5, 0.99), "r04": (45.0, 0.998)},
    1: {"r01": (25.0, 0.89), "r02": (32.0, 0.97), "r03": (38.0, 0.99), "r04": (43.0, 0.998)},
    3: {"r01": (19.5, 0.84), "r02": (23.0, 0.92), "r03": (31.0, 0.97), "r04": (35.5, 0.99)},
}
"""By degree and rate: PSNR and SSIM of the decoded map's picture against the original's. The rates spend little on the
coefficients of degree 3."""


def wavy_wall(degree: int, count: int = 4000) -> GaussianMap:
    """A textured wall 2 m in front of the camera, of flat Gaussians in any orientation, with ids in vertical bands."""
    random = torch.Generator().manual_seed(degree)
    x, y = (torch.rand(2, count, generator=random) - 0.5) * torch.tensor([[2.6], [2.0]])
    means = torch.stack([x, y, 2 + 0.1 * torch.sin(6 * x)], 1)
    rgb = 0.5 + 0.3 * torch.stack([torch.sin(9 * x), torch.cos(7 * y), torch.sin(5 * (x + y))], 1)
    quaternions = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1)
    scales = torch.tensor([-3.6, -3.8, -5.5]) + 0.3 * torch.randn(count, 3, generator=random)
    out = GaussianMap(degree, with_moments=False)
    ids = (3 * (1 + torch.floor(x + 1.3) * 100)).int()
    ids[::7] = 0
    out.insert(means, quaternions, scales, 1.5 + torch.randn(count, generator=random), rgb, object_id=ids)
    phases = torch.arange(3 * (out.sh.shape[1] - 1)).reshape(1, -1, 3)
    out.sh[:, 1:] = 0.1 * torch.sin(3 * x[:, None, None] + 4 * y[:, None, None] + phases)
    return out


def coded(gaussians: GaussianMap, rate: str, finest: bool = False) -> PointCloud:
    """A map as it comes out of the decoder; `finest`: with the smallest quantiser parameter instead of the rate's."""
    attributes = splat_attributes(gaussians)
    settings = splat_settings(CodecSettings(slices=2), rate, attributes)
    if finest:
        own = {name: replace(chosen, qp=4, chroma_offset=0) for name, chosen in settings.attributes.items()}
        settings = replace(settings, attributes=own)
    cloud = decode_cloud(encode_cloud(gaussians.means.numpy().astype(np.float64), attributes, settings).data)
    assert is_splat_cloud(cloud)
    return cloud


def rows_in_order_of_decoding(gaussians: GaussianMap, cloud: PointCloud) -> np.ndarray:
    """Row of the original for each decoded Gaussian; no two of the map share a voxel."""
    grid = cloud.quantization.apply(gaussians.means.numpy().astype(np.float64))
    assert len(np.unique(grid, axis=0)) == len(gaussians) == len(cloud)
    rows = np.empty(len(cloud), np.int64)
    rows[np.lexsort(cloud.grid_points.T)] = np.lexsort(grid.T)
    assert np.array_equal(grid[rows], cloud.grid_points)
    return rows


def picture(gaussians: GaussianMap) -> np.ndarray:
    return CpuRasterizer().forward(gaussians, CAMERA, np.eye(4)).image.numpy().clip(0, 1).transpose(1, 2, 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_finest_quantiser_keeps_parameters_within_steps(degree: int) -> None:
    gaussians = wavy_wall(degree)
    cloud = coded(gaussians, "r04", finest=True)
    decoded, rows = gaussians_of(cloud), rows_in_order_of_decoding(gaussians, cloud)
    assert decoded.sh_degree == degree
    extent = float((gaussians.means.amax(0) - gaussians.means.amin(0)).max())
    assert (decoded.means - gaussians.means[rows]).abs().max() < 0.51 * extent / ((1 << POSITION_BITS) - 1) + 1e-6
    for name, kind in {"sh": "sh", "opacity_logits": "opacity", "log_scales": "scale"}.items():
        low, high = RANGES[kind]
        step = (high - low) / ((1 << VALUE_BITS) - 1)
        error = (getattr(decoded, name) - getattr(gaussians, name)[rows]).abs() / step
        # The transform's 15-bit factors let values shrink by up to a thousandth: four steps of the largest.
        assert error.mean() < 1.5 and error.max() < 5
    cosine = (decoded.quaternions * gaussians.quaternions[rows]).sum(1).abs()
    assert cosine.min() > 0.99999
    assert torch.equal(decoded.object_id, gaussians.object_id[rows])


@pytest.mark.parametrize("degree", list(BARS))
@pytest.mark.parametrize("rate", list(RATES))
def test_count_and_ids_are_exact_and_pictures_near_at_every_rate(rate: str, degree: int) -> None:
    gaussians = wavy_wall(degree)
    cloud = coded(gaussians, rate)
    decoded, rows = gaussians_of(cloud), rows_in_order_of_decoding(gaussians, cloud)
    assert torch.equal(decoded.object_id, gaussians.object_id[rows])
    original = picture(gaussians)
    assert original.std() > 0.1
    scores = score_image(picture(decoded), None, original, np.ones(original.shape[:2], np.float32))
    assert scores.psnr > BARS[degree][rate][0] and scores.ssim > BARS[degree][rate][1]


def test_higher_rates_are_larger_and_nearer() -> None:
    gaussians, sizes, errors = wavy_wall(1), [], []
    attributes = splat_attributes(gaussians)
    for rate in RATES:
        settings = splat_settings(CodecSettings(), rate, attributes)
        encoded = encode_cloud(gaussians.means.numpy().astype(np.float64), attributes, settings)
        sizes.append(len(encoded.data))
        errors.append(float(np.square(picture(gaussians_of(decode_cloud(encoded.data))) - picture(gaussians)).mean()))
    assert sizes == sorted(sizes) and errors == sorted(errors, reverse=True) and sizes[0] < 0.7 * sizes[-1]


def test_attributes_coded_alike_share_a_parameter_set() -> None:
    gaussians = wavy_wall(3, 50)
    attributes = splat_attributes(gaussians)
    assert len(attributes) == 21  # more than the ids of parameter sets, which have 4 bits
    points = gaussians.means.numpy().astype(np.float64)
    data = encode_cloud(points, attributes, splat_settings(CodecSettings(), "r03", attributes)).data
    assert sum(unit.kind == UnitType.ATTRIBUTE_PARAMETERS for unit in read_units(data)) == 8
    different = {f"v{k}": np.arange(50, dtype=np.uint8) for k in range(17)}
    own = {name: AttributeSettings(qp=10 + k) for k, name in enumerate(different)}
    with pytest.raises(ConfigError, match="17 different quantisers"):
        encode_cloud(points, different, CodecSettings(attributes=own))
    assert set(decode_cloud(encode_cloud(points, different).data).attributes) == set(different)


def test_values_outside_their_ranges_are_clipped_and_the_sign_of_a_quaternion_is_free() -> None:
    gaussians = wavy_wall(0, 20)
    gaussians.sh[0], gaussians.opacity_logits[1], gaussians.log_scales[2] = 9.0, -30.0, 7.0
    gaussians.quaternions[3] = -2 * gaussians.quaternions[3]
    cloud = coded(gaussians, "r04", finest=True)
    decoded, rows = gaussians_of(cloud), rows_in_order_of_decoding(gaussians, cloud).tolist()
    assert torch.allclose(decoded.sh[rows.index(0)], torch.tensor(4.0), atol=0.02)
    assert torch.allclose(decoded.opacity_logits[rows.index(1)], torch.tensor(-7.0), atol=0.05)
    assert torch.allclose(decoded.log_scales[rows.index(2)], torch.tensor(4.0), atol=0.05)
    cosine = torch.nn.functional.cosine_similarity(decoded.quaternions[rows.index(3)], gaussians.quaternions[3], dim=0)
    assert abs(float(cosine)) > 0.9999


def test_gaussians_in_one_voxel_stay_apart() -> None:
    gaussians = wavy_wall(0, 40)
    gaussians.means[:10] = gaussians.means[0].clone()
    gaussians.object_id[:10] = torch.arange(10, dtype=torch.int32)
    decoded = gaussians_of(coded(gaussians, "r01"))
    assert sorted(decoded.object_id.tolist()) == sorted(gaussians.object_id.tolist())


def test_what_cannot_be_coded_or_is_no_map_is_said_plainly() -> None:
    gaussians = wavy_wall(0, 20)
    attributes = splat_attributes(gaussians)
    with pytest.raises(ConfigError, match="r01, r02, r03, r04, found 'r05'"):
        splat_settings(CodecSettings(), "r05", attributes)
    cloud = coded(gaussians, "r01")
    del cloud.attributes["opacity"]
    with pytest.raises(FormatError, match="opacity"):
        gaussians_of(cloud)
    gaussians.object_id[4] = 70000
    with pytest.raises(ConfigError, match="70000"):
        splat_attributes(gaussians)
