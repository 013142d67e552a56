# SPDX-License-Identifier: Apache-2.0
"""The map keeps rows, bookkeeping and optimizer moments together through growth, pruning and movement."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh, sh_to_rgb
from ggslam.scene.poses import quaternion_to_matrix, se3_exp

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")


def insert(out: GaussianMap, count: int, start: int = 0, keyframe: int = 0) -> slice:
    """Gaussians whose mean's x tells their number."""
    number = torch.arange(start, start + count, dtype=torch.float32)
    means = torch.stack([number, number * 0, number * 0], 1)
    return out.insert(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.zeros(count, 3), number, torch.rand(count, 3),
        number[:, None].repeat(1, out.feature_channels), keyframe, number.int() + 1,
    )  # fmt: skip


def mark_moments(out: GaussianMap) -> None:
    """Puts each Gaussian's number into all its moments."""
    for first, second in out.moments.values():
        shape = (-1, *[1] * (first.dim() - 1))
        first[:] = out.means[:, 0].view(shape)
        second[:] = 2 * out.means[:, 0].view(shape)


def check_rows(out: GaussianMap, numbers: list[int], with_marks: bool = True) -> None:
    expected = torch.tensor(numbers, dtype=torch.float32)
    assert len(out) == len(numbers) and out.object_id.tolist() == [n + 1 for n in numbers]
    torch.testing.assert_close(out.means[:, 0], expected)
    torch.testing.assert_close(out.opacity_logits, expected)
    for name in PARAMETERS:
        first, second = out.moments[name]
        assert first.shape == second.shape == getattr(out, name).shape
        if with_marks:
            shape = (-1, *[1] * (first.dim() - 1))
            torch.testing.assert_close(first, expected.view(shape).expand_as(first))
            torch.testing.assert_close(second, 2 * expected.view(shape).expand_as(second))


def test_growth_keeps_what_was_there_and_is_amortised() -> None:
    out = GaussianMap(sh_degree=1, feature_channels=2)
    assert len(out) == 0 and out.means.shape == (0, 3) and out.sh.shape == (0, 4, 3)
    capacities = set()
    for step in range(40):
        rows = insert(out, 1000, 1000 * step, keyframe=step)
        assert (rows.start, rows.stop) == (1000 * step, 1000 * (step + 1))
        assert all((moment[rows] == 0).all() for pair in out.moments.values() for moment in pair)
        mark_moments(out)
        capacities.add(out.capacity)
    check_rows(out, list(range(40_000)))
    assert len(capacities) <= 4 and out.birth_keyframe[12_345] == 12 and out.version == 40


def test_while_growing_no_more_than_one_array_is_there_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    out = GaussianMap(feature_channels=2)
    insert(out, 10)
    old = [weakref.ref(array) for array in out._storage.values()]
    zeros, left = torch.zeros, []

    def counting_zeros(*arguments: object, **options: object) -> torch.Tensor:
        left.append(sum(array() is not None for array in old))
        return zeros(*arguments, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(torch, "zeros", counting_zeros)
    out.reserve(out.capacity + 1)
    assert left == list(range(24, 0, -1)) and not any(array() is not None for array in old)


def test_views_write_through() -> None:
    out = GaussianMap()
    insert(out, 10)
    out.means[3, 1] = 7.0
    out.moments["means"][0][3] = 5.0
    assert out.means[3, 1] == 7 and (out.moments["means"][0][3] == 5).all()


def test_keep_and_reorder_carry_everything_along() -> None:
    out = GaussianMap(feature_channels=1)
    insert(out, 100)
    mark_moments(out)
    version = out.version
    assert out.keep(torch.ones(100, dtype=torch.bool)) == 0 and out.version == version
    selected = torch.arange(100) % 3 == 0
    assert out.keep(selected) == 66 and out.version == version + 1
    check_rows(out, list(range(0, 100, 3)))
    out.reorder(torch.arange(33, -1, -1))
    check_rows(out, list(range(99, -1, -3)))
    assert out.keep(torch.zeros(34, dtype=torch.bool)) == 34 and len(out) == 0


def test_rows_inserted_after_pruning_start_afresh() -> None:
    """The storage beyond the used rows still holds what was pruned; none of it may come back."""
    out = GaussianMap(sh_degree=2, feature_channels=3)
    insert(out, 50)
    out.sh[:] = 9.0
    out.updates[:] = 4
    mark_moments(out)
    out.keep(torch.arange(50) < 10)
    rows = out.insert(torch.zeros(5, 3), torch.ones(5, 4), torch.zeros(5, 3), torch.zeros(5), torch.full((5, 3), 0.25))
    assert all((moment[rows] == 0).all() for pair in out.moments.values() for moment in pair)
    assert (out.sh[rows, 1:] == 0).all() and (out.features[rows] == 0).all()
    assert (
        (out.updates[rows] == 0).all() and (out.object_id[rows] == 0).all() and (out.birth_keyframe[rows] == -1).all()
    )
    torch.testing.assert_close(out.rgb[rows], torch.full((5, 3), 0.25))


def test_a_copy_on_a_device_has_everything_and_is_its_own(cuda_library: CudaLibrary) -> None:
    original = GaussianMap(sh_degree=1, feature_channels=2, growth=0.25)
    insert(original, 60)
    mark_moments(original)
    original.keep(torch.arange(60) % 2 == 0)
    original.updates[:], original.vote_ids[:], original.vote_weights[:] = 3, 5, 0.5
    there = original.copy(cuda_library.whole_device(None))
    assert there.device == there.means.device == cuda_library.whole_device(None)
    assert there.capacity == there.count == 30 and there.growth == 0.25
    there.means[0] = 77.0
    assert original.means[0, 0] == 0
    there.means[0] = 0.0
    back = there.to("cpu")
    assert (back.count, back.version, back.order) == (30, original.version, original.order)
    rows = torch.arange(30)
    found, expected = back.take(rows), original.take(rows)
    assert found.keys() == expected.keys() and len(found) == 24
    assert all(torch.equal(found[name], array) for name, array in expected.items())
    assert GaussianMap(with_moments=False).copy("cpu").moments == {} and original.to("cpu") is original


def test_a_map_on_a_device_grows_and_shrinks_as_on_the_host(cuda_library: CudaLibrary) -> None:
    here = GaussianMap(feature_channels=1)
    insert(here, 100)
    mark_moments(here)
    there = here.copy(cuda_library.whole_device(None))
    new = {"quaternions": torch.rand(20, 4), "log_scales": torch.rand(20, 3), "rgb": torch.rand(20, 3)}
    for out in (here, there):
        device = out.device
        given = {name: value.to(device) for name, value in new.items()}
        out.insert(torch.zeros(20, 3, device=device), opacity_logits=0.25, birth_keyframe=4, **given)
        out.keep(torch.arange(120, device=device) % 3 > 0)
        out.reorder(torch.arange(79, -1, -1))
        out.append(out.take(torch.tensor([3, 5], device=device)))
    found, expected = there.to("cpu").take(torch.arange(82)), here.take(torch.arange(82))
    assert all(torch.equal(found[name], array) for name, array in expected.items())
    assert (there.opacity_logits[:13] == 0.25).all() and (there.version, there.order) == (here.version, here.order)


def test_moving_turns_position_and_orientation() -> None:
    generator = np.random.default_rng(0)
    T = se3_exp(generator.normal(size=6))
    means, quaternions = generator.normal(size=(20, 3)), generator.normal(size=(20, 4))
    for rows in (torch.arange(20) % 2 == 0, torch.arange(0, 20, 2)):
        out = GaussianMap()
        out.insert(
            torch.from_numpy(means).float(), torch.from_numpy(quaternions).float(), torch.zeros(20, 3), torch.zeros(20),
            torch.zeros(20, 3),
        )  # fmt: skip
        out.move(rows, torch.from_numpy(T))
        moved = means[::2] @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(out.means[::2].numpy(), moved, atol=1e-5)
        np.testing.assert_allclose(out.means[1::2].numpy(), means[1::2], atol=1e-6)
        turned = T[:3, :3] @ quaternion_to_matrix(quaternions[::2])
        np.testing.assert_allclose(quaternion_to_matrix(out.quaternions[::2].numpy()), turned, atol=1e-5)


def test_colours_and_activations() -> None:
    rgb = torch.rand(5, 3)
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(rgb)), rgb)
    out = GaussianMap(with_moments=False)
    insert(out, 4)
    assert out.moments == {} and (out.scales == 1).all()
    torch.testing.assert_close(out.opacities, torch.sigmoid(torch.arange(4.0)))
    assert out != GaussianMap(with_moments=False, count=0)  # maps are compared by identity, not by their settings
    assert out in {out}
    with pytest.raises(ValueError, match="sh_degree"):
        GaussianMap(sh_degree=4)
    with pytest.raises(AttributeError):
        _ = out.no_such_array


def test_a_higher_degree_keeps_what_is_there_and_starts_moments_anew() -> None:
    gaussians = GaussianMap(0, 2)
    gaussians.insert(torch.rand(5, 3), torch.eye(1, 4).expand(5, 4), torch.zeros(5, 3), 0.0, torch.rand(5, 3))
    first, second = gaussians.moments["sh"]
    first[:], second[:] = 1.0, 2.0
    means, colors, allocations = gaussians.means.clone(), gaussians.sh.clone(), gaussians.allocations
    gaussians.raise_degree(2)
    assert gaussians.sh_degree == 2 and gaussians.allocations > allocations
    assert torch.equal(gaussians.sh[:, :1], colors) and not gaussians.sh[:, 1:].any()
    assert torch.equal(gaussians.means, means)
    assert [tuple(m.shape) for m in gaussians.moments["sh"]] == [(5, 9, 3)] * 2 and not gaussians.moments["sh"][0].any()
    gaussians.raise_degree(1)
    assert gaussians.sh_degree == 2
    places = torch.rand(30000, 3)
    gaussians.insert(places, torch.eye(1, 4).expand(30000, 4), torch.zeros(30000, 3), 0.0, torch.rand(30000, 3))
    assert gaussians.sh.shape == (30005, 9, 3) and torch.equal(gaussians.sh[:5, :1], colors)
