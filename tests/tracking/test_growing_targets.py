# SPDX-License-Identifier: Apache-2.0
"""Targets that grow by the blocks that new Gaussians lie in."""

from __future__ import annotations

import threading
from collections.abc import Callable
from ctypes import byref

import numpy as np
import pytest

from ggslam.abi.core import TargetChanges, TargetCopy
from ggslam.native.loader import NativeContext, load_library
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.points import disc_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, TargetSettings

Gaussians = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
CONTEXT = NativeContext(2)


def gaussians(seed: int, count: int = 2000, offset: float = 0.0) -> Gaussians:
    """Discs on a wavy floor about x = offset, some of them upside down."""
    rng = np.random.default_rng(seed)
    means = np.float32(rng.uniform(-0.8, 0.8, (count, 3)))
    means[:, 2] = 0.1 * np.sin(4 * means[:, 0]) + rng.normal(0, 0.005, count)
    means[:, 0] += np.float32(offset)
    quaternions = np.float32([1, 0, 0, 0]) + np.float32(rng.normal(0, 0.1, (count, 4)))
    quaternions[rng.uniform(size=count) < 0.1] = [0, 1, 0, 0]
    scales = np.float32(np.log([0.01, 0.01, 0.001]) + rng.normal(0, 0.2, (count, 3)))
    return means, quaternions, scales, np.float32(rng.normal(3, 1, count))


def grown(parts: list[Gaussians], settings: TargetSettings, context: NativeContext = CONTEXT) -> list[GicpTarget]:
    """The target after each of the parts."""
    found: list[GicpTarget] = []
    for part in parts:
        found.append(GicpTarget.from_arrays(*part, settings, context, base=found[-1] if found else None))
    return found


def rows(target: GicpTarget, level: int) -> np.ndarray:
    """Voxels, sorted: whatever their order in memory."""
    values = np.concatenate([v.reshape(len(v), -1) for v in target.voxels(level).values()], 1)
    return values[np.lexsort(values[:, :3].T)]


def is_same(one: GicpTarget, other: GicpTarget) -> bool:
    return len(one) == len(other) and all(rows(one, k).tobytes() == rows(other, k).tobytes() for k in (0, 1))


PARTS = [gaussians(seed, offset=0.25 * seed) for seed in range(8)]


@pytest.mark.parametrize("change", [{}, {"neighbour_weight": 0.0}, {"scatter_weight": 0.0}])
@pytest.mark.parametrize("threads", [1, 3])
def test_growing_gives_the_voxels_of_all_gaussians_at_once(change: dict[str, float], threads: int) -> None:
    settings, context = TargetSettings(**change), NativeContext(threads)
    for count, target in enumerate(grown(PARTS, settings, context), 1):
        together = (np.concatenate(arrays) for arrays in zip(*PARTS[:count], strict=True))
        assert is_same(target, GicpTarget.from_arrays(*together, settings, context))


def test_earlier_versions_stay_what_they_were() -> None:
    settings = TargetSettings()
    versions = grown(PARTS, settings)
    kept = [[rows(target, level).tobytes() for level in (0, 1)] for target in versions]
    for _ in range(3):  # places of versions that are gone are used again
        grown([PARTS[0], *PARTS], settings)
    fork = GicpTarget.from_arrays(*PARTS[0], settings, CONTEXT, base=versions[3])  # 4 has grown from it, too
    again = grown([*PARTS[:4], PARTS[0]], settings)[-1]
    assert is_same(fork, again)
    for number in (5, 1, 3):
        del kept[number], versions[number]
        GicpTarget.from_arrays(*PARTS[2], settings, CONTEXT, base=versions[-1])
        assert [[rows(target, level).tobytes() for level in (0, 1)] for target in versions] == kept


def frame(seed: int) -> Callable[[GicpTarget], tuple[bytes, bytes, float]]:
    """Aligns a view of the floor: pose, matched normals and cost."""
    means = gaussians(seed, 600)[0] + np.float32([0, 0, 2])
    points = disc_points(means, np.tile(np.float32([0, 0, 1]), (600, 1)), DepthNoise())
    T = np.eye(4)
    T[:3, 3] = [0.01, -0.01, -1.99]
    context = NativeContext(1)

    def run(target: GicpTarget) -> tuple[bytes, bytes, float]:
        found = align(points, target, T, AlignSettings(coarse_points=300), DepthNoise(), context)
        return found.T_world_camera.tobytes(), target.normals(found.matches.read().voxels).tobytes(), found.cost

    return run


def test_an_earlier_version_is_aligned_to_while_later_ones_are_made() -> None:
    settings, run = TargetSettings(), frame(3)
    first = grown(PARTS[:2], settings)[-1]
    expected, found, done = run(first), list[bool](), threading.Event()

    def track() -> None:
        while not done.is_set():
            found.append(run(first) == expected)

    tracker = threading.Thread(target=track)
    tracker.start()
    newest = first
    for turn in range(12):  # arrays and tables are outgrown several times
        newest = GicpTarget.from_arrays(*gaussians(turn, 3000, offset=turn), settings, CONTEXT, base=newest)
    done.set()
    tracker.join()
    assert found and all(found) and run(first) == expected != run(newest)


def test_shapes_that_were_left_out_are_those_made_at_once() -> None:
    settings, whole = TargetSettings(), grown(PARTS, TargetSettings())
    late: list[GicpTarget] = []
    for part in PARTS:
        late.append(GicpTarget.from_arrays(*part, settings, CONTEXT, base=late[-1] if late else None, finish=False))
    for number in (4, 2, 7, 6, 0):  # in any order
        assert is_same(late[number], whole[number])
    assert is_same(GicpTarget.from_arrays(*PARTS[0], settings, CONTEXT, base=late[7]),
                   GicpTarget.from_arrays(*PARTS[0], settings, CONTEXT, base=whole[7]))  # fmt: skip


def lacking(target: GicpTarget, copy: TargetCopy) -> TargetChanges:
    changes = TargetChanges()
    load_library().ggslam_gicp_target_changes(target.handle, byref(copy), 1, None, 0, byref(changes))
    return changes


def test_a_copy_lacks_what_was_touched() -> None:
    settings = TargetSettings()
    target = GicpTarget.from_arrays(*gaussians(0, 20000), settings, CONTEXT)
    for turn in range(40):
        target = GicpTarget.from_arrays(*gaussians(turn, 2000, offset=0.8 * turn), settings, CONTEXT, base=target)
    whole = lacking(target, TargetCopy())
    assert whole.whole and whole.fine.voxel_count == len(target) and whole.fine.block_count == whole.fine.all_blocks
    assert lacking(target, whole.target).fine.block_count == lacking(target, whole.target).coarse.voxel_count == 0
    corner = tuple(a[:60] for a in gaussians(1, 4000))
    corner[0][:] = corner[0] * np.float32(0.1)
    nearer = GicpTarget.from_arrays(*corner, settings, CONTEXT, base=target)
    some = lacking(nearer, whole.target)
    assert not some.whole and 0 < some.fine.block_count < 0.05 * whole.fine.block_count
    assert 0 < some.coarse.block_count < 0.2 * whole.coarse.block_count
    assert some.fine.all_blocks >= whole.fine.all_blocks
    held = whole.target
    for other in (TargetCopy(held.number + 999, held.version, 1), TargetCopy(held.number, held.version, 0)):
        assert lacking(nearer, other).whole
    assert lacking(target, some.target).whole  # the copy is of a later version


def test_places_are_used_again() -> None:
    settings = TargetSettings()
    target = GicpTarget.from_arrays(*PARTS[0], settings, CONTEXT)
    for turn in range(60):
        target = GicpTarget.from_arrays(*PARTS[turn % 3], settings, CONTEXT, base=target)
    changes = lacking(target, TargetCopy())
    for level in (changes.fine, changes.coarse):
        assert level.places < 4 * level.voxel_count


def test_voxels_without_shapes_are_not_copied_as_if_they_had_some() -> None:
    unfinished = GicpTarget.from_arrays(*PARTS[0], TargetSettings(), CONTEXT, finish=False)
    with pytest.raises(ValueError, match="it is not finished"):
        load_library().ggslam_gicp_target_changes(
            unfinished.gathered_handle, byref(TargetCopy()), 1, None, 0, byref(TargetChanges())
        )
