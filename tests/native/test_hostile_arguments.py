# SPDX-License-Identifier: Apache-2.0
"""What reaches the compiled core from files is refused or computed, whatever it is: nothing is read or written outside
of the arrays that were handed over. `scripts/tools/sanitize.sh address` and `undefined` watch these tests."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.abi.core import (
    DECLARED,
    AdamArguments,
    AdamArrays,
    CoreFault,
    CrossEntropyOfPixels,
    FeatureAdam,
    GaussianGradients,
    ImageGradients,
    MeshPictureInput,
    PixelTerms,
    TermVotes,
)
from ggslam.errors import CoreInputError, GgslamError
from ggslam.native.loader import NativeContext, load_library
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.points import FramePoints, extract_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings, TargetSettings

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
INT_MAX, INT_MIN = 2**31 - 1, -(2**31)
NUMBERS = (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e20, -1e9, 1e-45, 0.0)
COUNT = 200


@pytest.fixture(scope="module")
def context() -> NativeContext:
    return NativeContext(2)


def some_map(count: int = COUNT) -> GaussianMap:
    """Gaussians before the camera."""
    rng = np.random.default_rng(0)
    gaussians = GaussianMap(1, 16)
    rows = {name: torch.zeros(count, *column.shape[1:], dtype=column.dtype)
            for name, column in gaussians.take(torch.zeros(0, dtype=torch.long)).items()}  # fmt: skip
    rows["means"][:] = torch.from_numpy(rng.uniform([-1, -1, 1], [1, 1, 3], (count, 3)))
    rows["quaternions"][:, 0], rows["log_scales"][:], rows["opacity_logits"][:] = 1, -3, 2
    gaussians.append(rows)
    return gaussians


# --- nothing at all --------------------------------------------------------------------------------------------------

WITHOUT_ARGUMENTS = {"ggslam_abi_hash", "ggslam_structure_sizes", "ggslam_source_hash", "ggslam_best_isa"}
FUNCTIONS = [(name, arguments) for name, (_, arguments) in DECLARED.functions.items()]


@pytest.mark.parametrize("number", [0, 1, -1, INT_MAX, INT_MIN])
def test_null_pointers_and_any_numbers_end_no_process(number: int) -> None:
    library, refused = load_library(), 0
    for name, arguments in FUNCTIONS:
        if name in WITHOUT_ARGUMENTS or name == "ggslam_last_error":
            continue
        values: list[Any] = [
            float(number) if kind in (ctypes.c_float, ctypes.c_double)
            else number if issubclass(kind, ctypes._SimpleCData) and kind not in (ctypes.c_void_p, ctypes.c_char_p)
            else None
            for kind in arguments
        ]  # fmt: skip
        if name == "ggslam_context_create" and number in (1, INT_MAX):
            continue  # makes one, or as many threads as it is asked for until it is refused
        try:
            made = getattr(library, name)(*values)
        except GgslamError:
            refused += 1
        else:
            if name.endswith("_create") and made:
                getattr(library, name.replace("_create", "_destroy"))(ctypes.c_void_p(made))
    assert refused > len(FUNCTIONS) / 2
    assert library.ggslam_last_error(None, 0) in list(CoreFault)


# --- numbers of Gaussians --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gaussian", "count"), [(COUNT, 1), (-1, 1), (INT_MAX, 1), (INT_MIN, 1), (0, 3), (0, -1), (0, INT_MAX)]
)
def test_terms_of_gaussians_that_are_not_there_are_refused(context: NativeContext, gaussian: int, count: int) -> None:
    library, byref = load_library(), ctypes.byref
    numbers, weights = np.full((1, 2), gaussian, np.int32), np.ones((1, 2), np.float32)
    counts = np.array([count], np.int32)
    terms = PixelTerms(1, 2, numbers.ctypes.data, weights.ctypes.data, counts.ctypes.data)
    features, updates = np.zeros((COUNT, 4), np.float32), np.zeros(COUNT, np.int32)
    first, second, schedule = np.zeros_like(features), np.zeros_like(features), np.ones((3, 2), np.float32)
    adam = FeatureAdam(
        COUNT, features.ctypes.data, first.ctypes.data, second.ctypes.data, updates.ctypes.data,
        schedule.ctypes.data, 3, 4, 0.9, 0.99, 1e-15, None,
    )  # fmt: skip
    labels, ids, votes = np.ones(COUNT, np.uint16), np.zeros((COUNT, 2), np.int32), np.zeros((COUNT, 2), np.float32)
    given = TermVotes(labels.ctypes.data, None, ids.ctypes.data, votes.ctypes.data, 2)
    out, one = np.zeros((1, 4), np.float32), np.ones(1, np.uint16)
    handle = context.handle
    for function, arguments in [
        ("blend", (byref(terms), features.ctypes.data, COUNT, 4, out.ctypes.data)),
        ("step", (byref(terms), out.ctypes.data, byref(adam))),
        ("vote", (byref(terms), one.ctypes.data, None, COUNT, 2, ids.ctypes.data, votes.ctypes.data)),
        ("learn", (byref(terms), out.ctypes.data, byref(adam), byref(given))),
        ("label", (byref(terms), labels.ctypes.data, COUNT, one.ctypes.data, weights.ctypes.data)),
    ]:
        with pytest.raises(CoreInputError, match="terms: |counts: "):
            getattr(library, f"ggslam_terms_{function}")(handle, *arguments)
    assert not (features.any() or updates.any() or ids.any() or votes.any() or out.any())


@pytest.mark.parametrize(("updates", "expected"), [(-1, 1), (INT_MIN, 1), (INT_MAX, INT_MAX), (5, 6)])
def test_counters_of_updates_may_be_anything(updates: int, expected: int) -> None:
    """A row of the schedule is read by them."""
    gaussians, rasterizer = some_map(), CpuRasterizer(threads=2)
    gaussians.updates[:] = updates
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=False)
    before = gaussians.means.clone()
    step = rasterizer.backward_step(gaussians, torch.ones_like(view.image), optimizer=AdamSettings())
    touched = step.touched > 0
    assert touched.sum() > COUNT / 2
    assert set(gaussians.updates[touched].tolist()) == {expected}
    assert set(gaussians.updates[~touched].tolist()) <= {updates}
    moved = (gaussians.means - before).abs().max()
    assert 0 < moved < 0.1


def test_pixels_outside_of_the_picture_are_refused() -> None:
    rasterizer, library = CpuRasterizer(threads=1), load_library()
    with pytest.raises(CoreInputError, match="pixels: |picture"):
        rasterizer_terms(library, rasterizer, 0)
    rasterizer.forward(some_map(), CAMERA, np.eye(4))
    for pixel in (-1, 64 * 48, INT_MAX, INT_MIN):
        with pytest.raises(CoreInputError, match="pixels: "):
            rasterizer_terms(library, rasterizer, pixel)
    rasterizer_terms(library, rasterizer, 64 * 48 - 1)


def rasterizer_terms(library: ctypes.CDLL, rasterizer: CpuRasterizer, pixel: int) -> None:
    pixels, numbers = np.array([pixel], np.int32), np.zeros((1, 4), np.int32)
    weights, counts = np.zeros((1, 4), np.float32), np.zeros(1, np.int32)
    terms = PixelTerms(1, 4, numbers.ctypes.data, weights.ctypes.data, counts.ctypes.data)
    library.ggslam_rasterizer_pixel_terms(rasterizer._handle, pixels.ctypes.data, 0.01, ctypes.byref(terms))


def test_there_is_no_backward_without_a_picture_or_arrays() -> None:
    library, rasterizer, twist = load_library(), CpuRasterizer(threads=1), np.zeros(6)
    touched = np.zeros(COUNT, np.uint8)
    out, images = GaussianGradients(twist=twist.ctypes.data, touched=touched.ctypes.data), ImageGradients()
    backward = lambda adam=None: library.ggslam_rasterizer_backward(  # noqa: E731
        rasterizer._handle, ctypes.byref(images), ctypes.byref(out), adam
    )
    with pytest.raises(CoreInputError, match="picture"):
        backward()
    gaussians = some_map()
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=False)
    image = torch.ones_like(view.image)
    images.image = image.data_ptr()
    assert backward() == 0
    some = np.zeros((COUNT, 16), np.float32)
    out.means = some.ctypes.data
    with pytest.raises(CoreInputError, match="expected all arrays or none"):
        backward()
    out.means = None
    updates, schedule = np.zeros(COUNT, np.int32), np.ones((2, 8), np.float32)
    arrays = AdamArrays(some.ctypes.data, some.ctypes.data, some.ctypes.data)
    good = dict.fromkeys(("means", "quaternions", "log_scales", "opacity_logits", "sh", "features"), arrays)
    for name, value in [("updates", None), ("schedule", None), ("schedule_rows", 0), ("sh", AdamArrays())]:
        adam = AdamArguments(**{
            **good, "updates": updates.ctypes.data, "schedule": schedule.ctypes.data, "schedule_rows": 2, name: value,
        })  # fmt: skip
        with pytest.raises(CoreInputError, match=r"updates|schedule|moments"):
            backward(ctypes.byref(adam))
    rasterizer.forward(gaussians, CAMERA, np.eye(4), features=False, as_3dgs=True)
    with pytest.raises(CoreInputError, match="3DGS have no gradients"):
        backward()
    assert not updates.any()


# --- numbers of other things -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("corner", [3, -1, INT_MAX, INT_MIN])
def test_triangles_of_vertices_that_are_not_there_are_refused(context: NativeContext, corner: int) -> None:
    positions, colors = np.ones((3, 3), np.float32), np.zeros((3, 3), np.uint8)
    triangles, depth = np.array([[0, 1, corner]], np.int32), np.zeros((8, 8), np.float32)
    picture = np.zeros((8, 8, 3), np.uint8)
    mesh = MeshPictureInput(
        positions.ctypes.data, colors.ctypes.data, triangles.ctypes.data, 3, 1, 9.0, 9.0, 4.0, 4.0, 0.1, 8, 8, 0
    )
    with pytest.raises(CoreInputError, match="triangles: .*3"):
        load_library().ggslam_draw_mesh(context.handle, ctypes.byref(mesh), depth.ctypes.data, picture.ctypes.data)


@pytest.mark.parametrize("number", [5, INT_MAX, 2**32 - 1])
def test_colours_that_are_not_there_are_refused(context: NativeContext, number: int) -> None:
    rgb, order, out = np.zeros((5, 3), np.uint8), np.array([0, number], np.uint32), np.zeros((2, 3), np.int32)
    with pytest.raises(CoreInputError, match="order: .*5"):
        load_library().ggslam_gpcc_to_ycbcr(
            context.handle, rgb.ctypes.data, 5, order.ctypes.data, 2, out.ctypes.data
        )


@pytest.mark.parametrize("number", [3, -2, INT_MAX, INT_MIN])
def test_classes_that_are_not_there_are_refused(context: NativeContext, number: int) -> None:
    features, classes = np.zeros((2, 4), np.float32), np.array([0, number], np.int32)
    weight, bias, rows = np.zeros((3, 4), np.float32), np.zeros(3, np.float32), np.zeros((3, 5), np.float32)
    gradient = np.zeros_like(features)
    job = CrossEntropyOfPixels(
        features.ctypes.data, classes.ctypes.data, weight.ctypes.data, bias.ctypes.data, gradient.ctypes.data,
        rows.ctypes.data, 2, 4, 3, 1.0,
    )  # fmt: skip
    with pytest.raises(CoreInputError, match="classes: .*-1 .*2"):
        load_library().ggslam_cross_entropy_of_pixels(context.handle, ctypes.byref(job))


# --- numbers that are none -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits", "sh", "features"])
@pytest.mark.parametrize("value", NUMBERS)
def test_gaussians_of_any_numbers_are_rendered_and_trained(name: str, value: float) -> None:
    gaussians, rasterizer = some_map(), CpuRasterizer(threads=2)
    getattr(gaussians, name)[::3] = value
    others = torch.ones(COUNT, dtype=torch.bool)
    others[::3] = False
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4), median_depth=True)
    assert view.image.shape == (3, 48, 64)
    before = gaussians.means[others].clone()
    step = rasterizer.backward_step(
        gaussians, torch.ones_like(view.image), torch.ones_like(view.depth), optimizer=AdamSettings()
    )
    assert torch.isfinite(before).all() and step.touched[others].any()


def points(count: int = 300) -> FramePoints:
    rng = np.random.default_rng(1)
    where = rng.uniform([-1, -1, 2], [1, 1, 2.1], (count, 3)).astype(np.float32)
    normals = np.tile(np.float32([0, 0, -1]), (count, 1))
    covariances = np.tile(np.float32([1, 0, 0, 1, 0, 0.01]), (count, 1))
    return FramePoints(where, normals, covariances, np.zeros((count, 2), np.int32), np.ones(count, np.float32))


@pytest.mark.parametrize("value", NUMBERS)
@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits", "birth", "camera_positions"])
def test_targets_of_any_numbers_are_built(context: NativeContext, name: str, value: float) -> None:
    rng = np.random.default_rng(2)
    arrays = {
        "means": rng.uniform([-1, -1, 2], [1, 1, 2.1], (2000, 3)), "quaternions": np.tile([1.0, 0, 0, 0], (2000, 1)),
        "log_scales": np.tile([-4.0, -4, -7], (2000, 1)), "opacity_logits": np.full(2000, 3.0),
        "camera_positions": np.zeros((4, 3)),
    }  # fmt: skip
    floats = {key: np.ascontiguousarray(values, np.float32) for key, values in arrays.items()}
    birth = np.zeros(2000, np.int32)
    with np.errstate(all="ignore"):
        if name == "birth":
            birth[::3] = np.clip(np.nan_to_num(value), INT_MIN, INT_MAX).astype(np.int64)
        else:
            floats[name][::3] = value
    positions = floats.pop("camera_positions")
    target = GicpTarget.from_arrays(
        **floats, settings=TargetSettings(), context=context, birth=birth, camera_positions=positions
    )
    found = align(points(), target, np.eye(4), AlignSettings(), DepthNoise(), context)
    assert found.T_world_camera.shape == (4, 4)


@pytest.mark.parametrize("value", NUMBERS)
@pytest.mark.parametrize("name", ["points", "normals", "covariances", "weights"])
def test_points_of_any_numbers_are_aligned(context: NativeContext, name: str, value: float) -> None:
    source = points()
    flat = source.points.copy()
    target = GicpTarget.from_arrays(
        flat, np.tile(np.float32([1, 0, 0, 0]), (300, 1)), np.full((300, 3), -4, np.float32),
        np.full(300, 3, np.float32), TargetSettings(), context,
    )  # fmt: skip
    getattr(source, name)[::3] = value
    assert align(source, target, np.eye(4), AlignSettings(), DepthNoise(), context).T_world_camera.shape == (4, 4)


@pytest.mark.parametrize("value", NUMBERS)
def test_depth_of_any_numbers_gives_points(context: NativeContext, value: float) -> None:
    depth = np.full((48, 64), 2, np.float32)
    depth[10:30, 20:40] = value
    found = extract_points(depth, CAMERA, PointSettings(), DepthNoise(), context)
    assert np.isfinite(found.points).all()
    assert len(found) > 0 and found.points[:, 2].max() <= PointSettings().max_depth
