# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps through the splat preset: what is kept exactly, what nearly, and what the pictures lose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ggslam.coding import AttributeSettings, CodecSettings, PointCloud, decode_cloud, encode_cloud
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.least_rotations import least_rotations
from ggslam.coding.splats import (
    RANGES,
    RATES,
    SplatCodingTuning,
    gaussians_of,
    is_splat_cloud,
    means_of,
    rest_range,
    splat_attributes,
    splat_reach,
    splat_settings,
)
from ggslam.errors import ConfigError, FormatError
from ggslam.evaluation.images import score_image
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
BARS = {
    0: {"r01": (36.3, 0.988), "r02": (41.2, 0.995), "r03": (45.5, 0.998), "r04": (48.7, 0.999)},
    1: {"r01": (36.1, 0.988), "r02": (40.9, 0.995), "r03": (44.7, 0.998), "r04": (47.7, 0.999)},
    3: {"r01": (35.1, 0.985), "r02": (39.1, 0.993), "r03": (42.5, 0.996), "r04": (45.3, 0.998)},
}
"""By degree and rate: PSNR and SSIM of the decoded map's picture against the original's."""


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
    rest = rest_range([gaussians])
    attributes = splat_attributes(gaussians, rest=rest)
    settings = splat_settings(CodecSettings(slices=2), rate, attributes, rest)
    if not finest:
        settings = splat_reach(lambda: [gaussians], len(gaussians), settings, rate).settings
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


def shapes(gaussians: GaussianMap) -> torch.Tensor:
    """Covariances [N, 3, 3], which do not depend on how axes are named."""
    w, x, y, z = torch.nn.functional.normalize(gaussians.quaternions, dim=1).double().T
    R = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
        1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ], 1).reshape(-1, 3, 3)  # fmt: skip
    return R @ torch.diag_embed((2 * gaussians.log_scales.double()).exp()) @ R.mT


def test_axes_are_named_so_that_rotations_are_least() -> None:
    gaussians = wavy_wall(0, 3000)
    quaternions, scales = least_rotations(gaussians.quaternions.numpy(), gaussians.log_scales.numpy())
    assert quaternions[:, 0].min() > 0.85 and np.abs(np.linalg.norm(quaternions, axis=1) - 1).max() < 1e-6
    before = shapes(gaussians)
    gaussians.quaternions[:], gaussians.log_scales[:] = torch.tensor(quaternions), torch.tensor(scales)
    after = shapes(gaussians)
    assert ((after - before).flatten(1).norm(dim=1) < 1e-5 * before.flatten(1).norm(dim=1)).all()


def test_small_coefficients_have_a_small_range() -> None:
    gaussians = wavy_wall(3)
    assert rest_range([gaussians]) == 0.125 and rest_range([wavy_wall(0, 5)]) == 4
    gaussians.sh[7, 5] = 0.3
    assert rest_range([wavy_wall(1), gaussians]) == 0.5
    gaussians.sh[7, 5] = -9
    assert rest_range([gaussians]) == 4
    cloud = coded(wavy_wall(3, 50), "r04")
    assert cloud.metadata["rest_range"] == 0.125
    for damaged in ("x", 0, 9.0):
        cloud.metadata["rest_range"] = damaged
        with pytest.raises(FormatError, match="range of the SH"):
            gaussians_of(cloud)


def test_positions_are_as_fine_as_gaussians_are_small() -> None:
    gaussians = wavy_wall(0)
    settings = splat_settings(CodecSettings(), "r03", splat_attributes(gaussians))
    size = float(gaussians.log_scales.median(1).values.median().exp())
    found = splat_reach(lambda: [gaussians], len(gaussians), settings, "r03").settings
    assert found.voxel_size == pytest.approx(size / 24, rel=1e-3)
    gaussians.log_scales -= 9  # finer than 18 bits of the longest side: these it is
    assert splat_reach(lambda: [gaussians], len(gaussians), settings, "r03").settings.voxel_size is None
    named = replace(settings, voxel_size=0.01)
    assert splat_reach(lambda: [gaussians], len(gaussians), named, "r03").settings.voxel_size == 0.01


def picture(gaussians: GaussianMap) -> np.ndarray:
    return CpuRasterizer().forward(gaussians, CAMERA, np.eye(4)).image.numpy().clip(0, 1).transpose(1, 2, 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_finest_quantiser_keeps_parameters_within_steps(degree: int) -> None:
    gaussians = wavy_wall(degree)
    cloud = coded(gaussians, "r04", finest=True)
    decoded, rows = gaussians_of(cloud), rows_in_order_of_decoding(gaussians, cloud)
    assert decoded.sh_degree == degree
    extent = float((gaussians.means.amax(0) - gaussians.means.amin(0)).max())
    step = extent / ((1 << SplatCodingTuning.position_bits) - 1)
    assert (decoded.means - gaussians.means[rows]).abs().max() < 0.51 * step + 1e-6
    rest = rest_range([gaussians])
    pairs = {"sh": (decoded.sh[:, :1], gaussians.sh[rows, :1]), "rest": (decoded.sh[:, 1:], gaussians.sh[rows, 1:]),
             "opacity": (decoded.opacity_logits, gaussians.opacity_logits[rows]),
             "scale": (decoded.log_scales.sort(1).values, gaussians.log_scales[rows].sort(1).values)}  # fmt: skip
    for kind, (found, true) in pairs.items():
        low, high = RANGES.get(kind, (-rest, rest))
        if not found.numel():
            continue
        error = (found - true).abs() / ((high - low) / ((1 << SplatCodingTuning.value_bits) - 1))
        # The transform's 15-bit factors let values shrink by up to a thousandth: four steps of the largest.
        assert error.mean() < 1.5 and error.max() < 5
    found, true = (shapes(m) for m in (decoded, gaussians))
    assert ((found - true[rows]).flatten(1).norm(dim=1) < 0.1 * true[rows].flatten(1).norm(dim=1)).all()
    assert torch.equal(decoded.object_id, gaussians.object_id[rows])


@pytest.mark.parametrize("degree", list(BARS))
@pytest.mark.parametrize("rate", list(RATES))
def test_count_and_ids_are_exact_and_pictures_near_at_every_rate(rate: str, degree: int) -> None:
    gaussians = wavy_wall(degree)
    cloud = coded(gaussians, rate)
    decoded, grid = gaussians_of(cloud), cloud.quantization.apply(means_of(gaussians))
    pairs = ((grid, gaussians), (cloud.grid_points, decoded))
    there, here = (np.column_stack([places, m.object_id.numpy()]) for places, m in pairs)  # may share a voxel
    assert np.array_equal(there[np.lexsort(there.T)], here[np.lexsort(here.T)])
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
    assert sum(unit.kind == UnitType.ATTRIBUTE_PARAMETERS for unit in read_units(data)) == 6
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
    found, true = shapes(decoded)[rows.index(3)], shapes(gaussians)[3]
    assert float((found - true).norm() / true.norm()) < 0.03


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
