# SPDX-License-Identifier: Apache-2.0
"""SOG at every degree of spherical harmonics, packed and in a folder, read back as its description says (sog_reader.py)
and by PlayCanvas' splat-transform."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from sog_reader import from_sog, sog_files, sog_pixels
from splat_maps import DIRECTIONS, Splats, convert, from_ply, small_map

from ggslam.errors import FormatError
from ggslam.formats.morton import morton_order
from ggslam.formats.sog import write_sog

DEGREES = [0, 1, 2, 3]


def check_packed(seen: Splats, written: Splats) -> None:
    """As near as the bytes allow, rows in Morton order."""
    written = written.take(morton_order(written.means))
    logs = np.sign(written.means) * np.log1p(np.abs(written.means))
    step = np.ptp(logs, axis=0) / 65535 * (1 + np.abs(written.means))
    assert (np.abs(seen.means - written.means) <= 0.51 * step + 1e-6).all()
    for found, given in ((seen.log_scales, written.log_scales), (seen.sh[:, 0], written.sh[:, 0])):
        evenly = np.ptp(given) / 255 / np.sqrt(12)  # the error of 256 numbers in equal steps
        assert np.sqrt(np.square(found - given).mean()) < evenly
    unit = [q / np.linalg.norm(q, axis=1, keepdims=True) for q in (seen.quaternions, written.quaternions)]
    assert np.abs((unit[0] * unit[1]).sum(1)).min() > 1 - 5e-5  # half a step of sqrt(2)/255 in each of three
    np.testing.assert_allclose(seen.opacities, written.opacities, atol=0.51 / 255)
    assert seen.sh.shape == written.sh.shape
    if written.sh.shape[1] > 1:  # every Gaussian has its own entry
        evenly = np.ptp(written.sh[:, 1:]) / 255 / np.sqrt(12)
        assert np.sqrt(np.square(seen.sh[:, 1:] - written.sh[:, 1:]).mean()) < evenly
    for direction in DIRECTIONS:
        np.testing.assert_allclose(seen.colors(direction), written.colors(direction), atol=0.05)


@pytest.mark.parametrize("degree", DEGREES)
def test_sog(degree: int, tmp_path: Path) -> None:
    gaussians = small_map(degree)
    size = write_sog(tmp_path / "map.sog", gaussians)
    assert size == (tmp_path / "map.sog").stat().st_size
    check_packed(from_sog(tmp_path / "map.sog"), Splats.of(gaussians))
    write_sog(tmp_path / "again.sog", gaussians)
    assert (tmp_path / "again.sog").read_bytes() == (tmp_path / "map.sog").read_bytes()


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("name", ["map.sog", "folder/meta.json"])
def test_sog_by_splat_transform(degree: int, name: str, tmp_path: Path, splat_transform: list[str]) -> None:
    """Nothing is turned on the way to PLY, and it reads the numbers that we read, colours and shapes included."""
    gaussians = small_map(degree)
    write_sog(tmp_path / name, gaussians, {1: "mug"})
    convert(splat_transform, tmp_path / name, tmp_path / "seen.ply")
    seen, own = from_ply(tmp_path / "seen.ply"), from_sog(tmp_path / name)
    check_packed(seen, Splats.of(gaussians))
    np.testing.assert_allclose(seen.means, own.means, atol=1e-5)
    np.testing.assert_allclose(seen.log_scales, own.log_scales, atol=1e-6)
    np.testing.assert_allclose(seen.quaternions, own.quaternions, atol=1e-6)
    np.testing.assert_allclose(seen.sh, own.sh, atol=1e-6)


@pytest.mark.long("their program writes it")
def test_sog_that_splat_transform_writes(tmp_path: Path, splat_transform: list[str]) -> None:
    """Our reader reads theirs: what the two agree on is the format, not our writer."""
    from ggslam.formats.gaussian_ply import write_gaussian_ply

    gaussians = small_map(2)
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    convert(splat_transform, "-g", "cpu", tmp_path / "map.ply", tmp_path / "theirs.sog")
    seen, written = from_sog(tmp_path / "theirs.sog"), Splats.of(gaussians)
    nearest = np.linalg.norm(seen.means[:, None] - written.means[None], axis=2).argmin(1)
    assert sorted(nearest) == list(range(600))
    written = written.take(nearest)
    np.testing.assert_allclose(seen.log_scales, written.log_scales, atol=0.1)
    np.testing.assert_allclose(seen.opacities, written.opacities, atol=1.01 / 255)
    unit = written.quaternions / np.linalg.norm(written.quaternions, axis=1, keepdims=True)
    assert np.abs((seen.quaternions * unit).sum(1)).min() > 1 - 2e-4


def test_objects_in_a_sog(tmp_path: Path) -> None:
    gaussians = small_map(0)
    gaussians.object_id[7] = 2**24 - 1
    write_sog(tmp_path / "meta.json", gaussians, {1: "mug", 2: "", 3: "chair \u00e4"})
    files = sog_files(tmp_path / "meta.json")
    meta = json.loads(files["meta.json"])
    assert meta["objects"]["names"] == {"1": "mug", "2": "", "3": "chair \u00e4"}
    pixels = sog_pixels(files[meta["objects"]["files"][0]], 600)
    ids = pixels[:, 0] | pixels[:, 1] << 8 | pixels[:, 2] << 16
    np.testing.assert_array_equal(ids, gaussians.object_id[torch.from_numpy(morton_order(gaussians.means.numpy()))])


def test_extremes_in_a_sog(tmp_path: Path) -> None:
    """One Gaussian far away, opaque, as flat as can be; two at one place, one of them invisible."""
    gaussians = small_map(1, 1)
    gaussians.means[0] = torch.tensor([1e6, -1e-6, 0.0])
    gaussians.opacity_logits[:] = 100.0
    gaussians.log_scales[0, 2] = -60.0
    write_sog(tmp_path / "one.sog", gaussians)
    seen = from_sog(tmp_path / "one.sog")
    np.testing.assert_allclose(seen.means, gaussians.means, rtol=1e-6)
    np.testing.assert_allclose(seen.log_scales, gaussians.log_scales, rtol=1e-6)
    np.testing.assert_allclose(seen.sh, gaussians.sh, rtol=1e-6)
    assert seen.opacities[0] == 1
    pair = small_map(0, 2)
    pair.means[1] = pair.means[0]
    pair.opacity_logits[0] = -100.0
    write_sog(tmp_path / "two.sog", pair)
    seen = from_sog(tmp_path / "two.sog")
    np.testing.assert_allclose(seen.means, pair.means, atol=1e-6)
    assert seen.opacities[0] == 0


def test_what_no_sog_can_hold(tmp_path: Path) -> None:
    gaussians = small_map(0, 5)
    with pytest.raises(FormatError, match="1 to 268304400.* 0"):
        write_sog(tmp_path / "map.sog", small_map(0, 0))
    gaussians.object_id[2] = 2**24
    with pytest.raises(FormatError, match="ids.*16777215"):
        write_sog(tmp_path / "map.sog", gaussians, {1: ""})
    gaussians.sh[4, 0, 0] = float("nan")
    with pytest.raises(FormatError, match="colour of Gaussian 4"):
        write_sog(tmp_path / "map.sog", gaussians)
    assert not list(tmp_path.iterdir())
