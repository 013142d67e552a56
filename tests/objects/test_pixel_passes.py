# SPDX-License-Identifier: Apache-2.0
"""The compiled core's passes over a depth image against their reference in numpy. They are compiled once, for all
instruction sets."""

from __future__ import annotations

import ctypes
import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pixel_passes_reference as reference
import pytest
from test_geometric_segmenter import CAMERA, ray_cast

import ggslam.objects
from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.errors import CoreInputError, InputError
from ggslam.native.loader import load_library
from ggslam.objects import depth_surface, pixel_passes
from ggslam.objects.depth_surface import surface_of
from ggslam.objects.geometric_segmenter import GeometricSegmenter
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence

NAMES = (
    "link_surfaces", "connected_pieces", "grow_regions", "claim_planes", "share_near_planes", "find_bodies",
    "count_borders", "count_contacts", "normals_of_inverse", "count_alike", "outlier_colors",
)  # fmt: skip
PASSES = {name: getattr(depth_surface if name == "normals_of_inverse" else pixel_passes, name) for name in NAMES}
Image = tuple[np.ndarray, np.ndarray, Camera]
MODULES = [importlib.import_module(f"ggslam.objects.{m.name}") for m in pkgutil.iter_modules(ggslam.objects.__path__)]


def replace_passes(monkeypatch: pytest.MonkeyPatch, replacement: Callable[[str], Callable[..., Any]]) -> None:
    for name in NAMES:
        for module in MODULES:
            if module is not pixel_passes and hasattr(module, name):
                monkeypatch.setattr(module, name, replacement(name))


def flatten(result: Any) -> list[np.ndarray]:
    if isinstance(result, pixel_passes.Bodies):
        return [result.count, result.centre, result.radius, result.bend]
    return [array for part in result for array in flatten(part)] if isinstance(result, tuple) else [result]


def papers_on(color: np.ndarray) -> np.ndarray:
    """An image with papers and a gradient of light, so that there are colours to compare."""
    height, width = color.shape[:2]
    color = np.clip(color * np.linspace(0.6, 1.2, width)[None, :, None], 0, 255).astype(np.uint8)
    for k, paint in enumerate([(220, 40, 30), (240, 240, 230), (30, 60, 200)]):
        color[height * 2 // 3 :, width * (1 + 3 * k) // 10 : width * (3 + 3 * k) // 10] = paint
    return color


def drawn_images() -> list[Image]:
    images = []
    for camera, noise, steps in ((CAMERA, 0.0, 0.0), (CAMERA, 0.001, 0.0), (CAMERA.scale(2), 5e-4, 0.0028)):
        depth, _ = ray_cast(camera, noise, steps)
        depth[: camera.height // 6, : camera.width // 5] = 0  # not measured
        images.append((papers_on(np.full((*depth.shape, 3), 150, np.uint8)), depth, camera))
    rng = np.random.default_rng(3)
    odd = Camera(37, 23, 30.0, 30.0, 18.0, 11.0)
    clutter = rng.uniform(0.3, 3, (23, 37)).astype(np.float32) * (rng.random((23, 37)) > 0.2)
    images.append((rng.integers(0, 255, (23, 37, 3), np.uint8), clutter, odd))
    return images


def recorded_images(folder: Path, numbers: tuple[int, ...]) -> list[Image]:
    frames = [open_sequence(folder).frame(number) for number in numbers]
    return [(frame.color, frame.depth, frame.camera) for frame in frames]


def assert_equal_to_reference(monkeypatch: pytest.MonkeyPatch, images: list[Image], passes: set[str]) -> None:
    """Every pass, on what the segmenter hands it, and what comes out in the end."""
    called: set[str] = set()

    def compare(name: str) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            called.add(name)
            result = PASSES[name](*arguments, **named)
            expected = getattr(reference, name)(*arguments, **named)
            for ours, theirs in zip(flatten(result), flatten(expected), strict=True):
                assert ours.shape == theirs.shape, name
                if np.issubdtype(ours.dtype, np.floating):  # sums of float64, or of three products
                    assert np.allclose(ours, theirs, rtol=1e-5, atol=1e-6, equal_nan=True), name
                else:
                    assert np.count_nonzero(ours != theirs) <= 1e-4 * ours.size, name  # roundings decide
            return result

        return run

    settings = GeometricSettings()
    found = [GeometricSegmenter(settings).segment(*image) for image in images]
    with monkeypatch.context() as patch:
        replace_passes(patch, compare)
        for image in images:
            GeometricSegmenter(settings).segment(*image)
    assert passes <= called
    with monkeypatch.context() as patch:
        replace_passes(patch, lambda name: getattr(reference, name))
        expected = [GeometricSegmenter(settings).segment(*image) for image in images]
    assert any(labels.max() > 3 for labels in expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.mean(ours != theirs) <= 1e-3


def test_passes_over_drawn_images_are_those_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    assert_equal_to_reference(monkeypatch, drawn_images(), set(NAMES) - {"share_near_planes"})


def test_passes_over_the_generated_room_are_those_of_the_reference(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_equal_to_reference(monkeypatch, recorded_images(room, (0, 7)), set(NAMES))


@pytest.mark.parametrize("name", ["livingroom", "redkitchen"])
def test_passes_over_recordings_are_those_of_the_reference(
    shared_data: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_equal_to_reference(monkeypatch, recorded_images(shared_data / name, (0, 60)), set())


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (60, 80)])
def test_pieces_of_random_links_are_numbered_in_raster_order(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    height, width = shape
    links = rng.random((height, width - 1)) < 0.55, rng.random((height - 1, width)) < 0.55
    ids = rng.integers(0, 2, shape)
    assert np.array_equal(pixel_passes.connected_pieces(ids, links), reference.connected_pieces(ids, links))
    assert np.array_equal(pixel_passes.connected_pieces(ids), reference.connected_pieces(ids))


@pytest.mark.parametrize("passes", [0, 1, 3, 50])
def test_regions_grow_as_far_and_as_evenly_as_the_reference(passes: int) -> None:
    rng = np.random.default_rng(2)
    regions = np.where(rng.random((40, 53)) < 0.02, rng.integers(1, 9, (40, 53)), 0).astype(np.int32)
    valid, before = rng.random((40, 53)) < 0.9, regions.copy()
    links = rng.random((40, 52)) < 0.8, rng.random((39, 53)) < 0.8
    grown = pixel_passes.grow_regions(regions, valid, links, passes)
    assert np.array_equal(grown, reference.grow_regions(regions, valid, links, passes))
    assert np.array_equal(regions, before)


def test_more_borders_and_contacts_than_room_was_made_for() -> None:
    """Every pixel a region of its own: more pairs than the first room that is made for them."""
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    surface = surface_of(np.full((30, 40), 2, np.float32), camera, 8.0)
    regions = np.arange(1, 1201, dtype=np.int32).reshape(30, 40)
    nothing, colors = np.zeros(regions.shape, np.int32), np.zeros((30, 40, 3), np.float32)
    rest = (nothing, np.zeros((0, 3), np.float32), colors, 2, GeometricSettings())
    ours, theirs = (module.count_borders(regions, surface, *rest) for module in (pixel_passes, reference))
    assert len(ours[0]) == 30 * 39 + 29 * 40
    assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
    arguments = (regions, np.arange(1201), surface.depth, (0.04, 0.015), (0.02, 0.005), 0.001)
    for a, b in zip(pixel_passes.count_contacts(*arguments), reference.count_contacts(*arguments), strict=True):
        assert np.array_equal(a, b)


def test_numbers_outside_of_their_tables_are_refused() -> None:
    regions, points = np.array([0, 3, 1], np.int32), np.zeros((3, 3), np.float32)
    asked = core.RegionOnPlane(region=1)
    job = core.RegionsOnPlanesJob(address(points), address(regions), 3, 3, 0.1, ctypes.addressof(asked), 1)
    with pytest.raises(CoreInputError, match="regions:.* 0 .*2.* 3"):
        load_library().ggslam_regions_on_planes(ctypes.byref(job))
    regions[1], asked.region = 2, -1
    with pytest.raises(CoreInputError, match="region:.* 0 .*2.* -1"):
        load_library().ggslam_regions_on_planes(ctypes.byref(job))


def test_surfaces_of_another_type_are_refused_and_depth_of_any_is_taken() -> None:
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    surface = surface_of(np.full((30, 40), 2.0), camera, 8.0)  # float64
    assert pixel_passes.link_surfaces(surface, surface.valid, GeometricSettings())[0][0].all()
    wrong = replace(surface, depth=surface.depth.astype(np.float64))
    with pytest.raises(InputError, match=r"depth.*float32 \[30, 40\].*float64"):
        pixel_passes.link_surfaces(wrong, surface.valid, GeometricSettings())
