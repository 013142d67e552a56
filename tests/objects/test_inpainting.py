# SPDX-License-Identifier: Apache-2.0
"""The hole under a removed object, against what is really there."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from table_scene import CAMERA, CYLINDER, TABLE, TableScene, build_table_scene

from ggslam.errors import ConfigError
from ggslam.objects import texture
from ggslam.objects.editing import move_objects, remove_objects
from ggslam.objects.hole_refinement import Recorded
from ggslam.objects.hole_views import CameraView, HoleView
from ggslam.objects.inpainting import Filling, InpaintSettings, inpaint
from ggslam.objects.plane_filling import Chart, as_seen, paint
from ggslam.objects.removal_artifacts import drop_artifacts, places
from ggslam.objects.segmented_rows import copies_of, join_gaussians
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.system.tuning import overridden


@dataclass
class Filled:
    """The table with the cylinder removed, before and after inpainting, as seen from the middle."""

    table: TableScene
    number: int
    filling: Filling
    kept: np.ndarray
    removed_only: np.ndarray
    original: np.ndarray
    image: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


def look_at(table: TableScene, number: int) -> RenderBuffers:
    return CpuRasterizer().forward(table.scene.gaussians, CAMERA, table.views[number].T_camera_world)


def picture(out: RenderBuffers) -> np.ndarray:
    return out.image.numpy().transpose(1, 2, 0).clip(0, 1)


def recorded(table: TableScene, number: int) -> Recorded:
    return Recorded(table.images[number].color, table.images[number].depth)


@pytest.fixture(scope="module")
def pristine() -> TableScene:
    return build_table_scene()


@pytest.fixture
def table(pristine: TableScene) -> TableScene:
    """To be edited."""
    return copy.deepcopy(pristine)


@pytest.fixture(scope="module")
def filled(pristine: TableScene) -> Filled:
    table, number = copy.deepcopy(pristine), 2
    original = picture(look_at(table, number))
    removed = remove_objects(table.scene, [CYLINDER]).before
    removed_only = picture(look_at(table, number))
    filling = inpaint(table.scene, removed, table.views, recorded=lambda frame: recorded(table, frame))
    out = look_at(table, number)
    kept = table.scene.gaussians.means.numpy()[: len(table.scene.gaussians) - filling.added]
    return Filled(
        table, number, filling, kept, removed_only, original, picture(out), out.expected_depth.numpy().copy(),
        out.alpha.numpy().copy(),
    )  # fmt: skip


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_no_blot_stays_and_the_colour_is_that_of_the_table(filled: Filled) -> None:
    covered = filled.table.images[filled.number].mask == CYLINDER
    truth = filled.table.truth[filled.number].color / 255
    assert psnr(filled.removed_only[covered], truth[covered]) < 20  # there is a hole to fill
    assert psnr(filled.image[covered], truth[covered]) > 29
    assert (filled.alpha[covered] > 0.8).mean() > 0.99 and filled.filling.open_pixels <= 6


def test_the_new_surface_lies_where_the_table_is(filled: Filled) -> None:
    covered = filled.table.images[filled.number].mask == CYLINDER
    error = np.abs(filled.depth - filled.table.truth[filled.number].depth)[covered]
    assert np.median(error) < 0.036  # the map's own table is off by 0.017, and by 0.023 around the hole


def test_nothing_changes_away_from_the_hole(filled: Filled) -> None:
    covered = filled.table.images[filled.number].mask == CYLINDER
    rows, columns = np.nonzero(covered)
    away = np.ones(covered.shape, bool)
    away[max(rows.min() - 8, 0) : rows.max() + 9, columns.min() - 8 : columns.max() + 9] = False
    assert away.mean() > 0.6
    changed = np.abs(filled.image - filled.original).max(2) > 1 / 255
    assert changed[away].mean() < 2e-3  # places that only other views could not see


def test_what_is_new_is_the_table_s(filled: Filled) -> None:
    scene, first = filled.table.scene, len(filled.kept)
    assert filled.filling.added > 100
    assert (scene.gaussians.object_id[first:] == TABLE).float().mean() > 0.9
    labels = scene.classifier.labels(scene.gaussians.features.numpy()[first:])[0]
    assert np.array_equal(labels, scene.gaussians.object_id.numpy()[first:])
    assert scene.votes is not None and np.array_equal(scene.votes.labels()[first:], labels)


def test_training_changes_only_what_is_new(table: TableScene) -> None:
    removed = remove_objects(table.scene, [CYLINDER]).before
    before = {row.tobytes() for row in table.scene.gaussians.sh.numpy().reshape(len(table.scene.gaussians), -1)}
    images = {frame: recorded(table, frame) for frame in range(len(table.views))}
    asked: list[int] = []
    filling = inpaint(
        table.scene, removed, table.views, recorded=lambda frame: (asked.append(frame), images[frame])[1],
        settings=InpaintSettings(refine_iterations=5),
    )  # fmt: skip
    assert asked
    old = table.scene.gaussians.sh[: len(table.scene.gaussians) - filling.added].numpy()
    assert all(row.tobytes() in before for row in old.reshape(len(old), -1))


def test_the_place_that_a_moved_object_left_is_closed_and_the_object_is_untouched(table: TableScene) -> None:
    change = move_objects(table.scene, [CYLINDER], (0.3, 0.05, 0))
    moved = table.scene.gaussians.means[table.scene.gaussians.object_id == CYLINDER].clone()
    filling = inpaint(table.scene, change.before, table.views, ignored=[CYLINDER])
    assert filling.added > 100
    assert torch.equal(table.scene.gaussians.means[table.scene.gaussians.object_id == CYLINDER], moved)


def test_traces_that_bear_another_label_go_and_the_rest_stays(table: TableScene) -> None:
    gaussians = table.scene.gaussians
    own = torch.nonzero(gaussians.object_id == CYLINDER)[:, 0]
    gaussians.object_id[own[::4]] = TABLE  # wrong masks
    removed = copies_of(gaussians, (gaussians.object_id == CYLINDER).numpy())
    wrong = {row.tobytes() for row in gaussians.means[own[::4]].numpy()}
    rest = gaussians.object_id != CYLINDER
    gaussians.keep(rest)
    table.scene.votes = None
    count = len(gaussians)
    dropped = drop_artifacts(table.scene, removed, table.views)
    left = sum(row.tobytes() in wrong for row in gaussians.means.numpy())
    assert left < 0.05 * len(wrong)
    assert dropped == count - len(gaussians) < 3 * len(wrong)


def test_things_apart_leave_holes_of_their_own(table: TableScene) -> None:
    cylinder = copies_of(table.scene.gaussians, (table.scene.gaussians.object_id == CYLINDER).numpy())
    other = copies_of(cylinder, np.arange(len(cylinder.means)) < len(cylinder.means) // 2)
    other.means += torch.tensor([1.0, 0, 0])
    floater = copies_of(cylinder, np.arange(len(cylinder.means)) < 1)
    floater.means -= torch.tensor([1.0, 0, 0])
    sizes = sorted(len(part.means) for part in places(join_gaussians([cylinder, other, floater])))
    assert sizes == [len(other.means), len(cylinder.means)]


@pytest.mark.parametrize("patches", [400, 20])
def test_stripes_run_on_through_a_gap(patches: int) -> None:
    """20 patches are too few for this gap, so that it is filled coarsely."""
    stripes = np.where(np.arange(120) // 10 % 2, 0.8, 0.2)
    image = np.broadcast_to(stripes[None, :, None], (60, 120, 3)).astype(np.float32)
    gap = np.zeros((60, 120), bool)
    gap[15:45, 30:90] = True
    with overridden(texture.GapTextureTuning, max_patches=patches):
        filled = texture.fill_gap(np.where(gap[..., None], 0, image).astype(np.float32), ~gap, gap)
    wrong = (np.abs(filled - image[gap]).mean(1) > 0.25).mean()
    assert wrong < 0.15


def chart_with_a_hole() -> tuple[Chart, np.ndarray]:
    """A light plane with a hole that has a dark shadow along one side, seen from a metre."""
    hole = np.zeros((90, 120), bool)
    hole[30:60, 40:80] = True
    color = np.random.default_rng(0).normal((0.8, 0.65, 0.45), 0.02, (90, 120, 3)).clip(0, 1).astype(np.float32)
    color[30:60, 68:92] = (0.2, 0.15, 0.1)
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
    return Chart(np.array([-0.6, -0.45, 1.0]), axes, 0.01, color, ~hole, ~hole), hole


def test_a_shadow_beside_the_hole_is_no_texture_of_the_plane() -> None:
    chart, hole = chart_with_a_hole()
    assert np.abs(paint(chart, hole) - [0.8, 0.65, 0.45]).max() < 0.15


def test_colours_come_from_views_off_the_object_s_outline() -> None:
    chart, hole = chart_with_a_hole()
    camera = Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
    now, picture = np.ones((90, 120), np.float32), np.full((90, 120, 3), 0.5, np.float32)
    outline = cv2.dilate(hole.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    picture[outline] = 0.0
    view = HoleView(CameraView(camera, np.eye(4)), hole, now, now, picture)
    seen = as_seen(replace(chart, clean=np.zeros_like(hole)), [view])
    assert seen.clean.sum() > 0.6 * seen.clean.size and not (seen.clean & outline).any()
    assert (seen.color[seen.clean] == 0.5).all()


def test_nothing_removed_is_nothing_to_do(table: TableScene) -> None:
    nothing = copies_of(table.scene.gaussians, np.zeros(len(table.scene.gaussians), bool))
    assert inpaint(table.scene, nothing, table.views) == Filling()


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="refine_iterations"):
        InpaintSettings(refine_iterations=-1)
