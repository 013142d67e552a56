# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import ConfigError
from ggslam.objects.geometric_segmenter import GeometricSegmenter
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
FLOOR, WALL, BOX, BALL = 1, 2, 3, 4


def ray_cast(camera: Camera, noise: float = 0.0, steps: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Depth and true ids of a floor, a wall, a box and a ball that stand on the floor.

    Args:
        noise: standard deviation of inverse depth, 1/m.
        steps: inverse depth is rounded to multiples of this, as a structured-light camera does.
    """
    angle = np.radians(30)
    down = np.array([0, np.cos(angle), np.sin(angle)])
    ahead = np.array([0, -np.sin(angle), np.cos(angle)])
    rays = camera.rays().astype(np.float64)
    x, y, z = rays[..., 0], rays @ down, rays @ ahead  # axes of the room; its origin is the camera
    ids, depth = np.zeros(x.shape, int), np.full(x.shape, np.inf)

    def draw(distance: np.ndarray, inside: np.ndarray, number: int) -> None:
        closer = inside & (distance > 0) & (distance < depth)
        ids[closer], depth[closer] = number, distance[closer]

    with np.errstate(divide="ignore", invalid="ignore"):
        draw(1.0 / y, y > 0, FLOOR)
        draw(2.6 / z, z > 0, WALL)
        low, high = np.array([-0.45, 0.75, 1.3]), np.array([-0.15, 1.0, 1.6])
        for axis, side in ((0, high), (1, low), (2, low)):
            t = side[axis] / (x, y, z)[axis]
            hit = np.stack([t * x, t * y, t * z], -1)
            others = [k for k in range(3) if k != axis]
            draw(t, ((hit >= low) & (hit <= high))[..., others].all(-1), BOX)
        centre, r = np.array([0.35, 0.88, 1.4]), 0.12
        direction = np.stack([x, y, z], -1)
        a, b = (direction**2).sum(-1), direction @ centre
        root = b**2 - a * (centre @ centre - r**2)
        draw((b - np.sqrt(root)) / a, root > 0, BALL)
    inverse = 1 / depth + noise * np.random.default_rng(0).normal(size=depth.shape)
    if steps:
        inverse = np.rint(inverse / steps) * steps
    return (1 / inverse).astype(np.float32), ids


def best_iou(segments: np.ndarray, true: np.ndarray) -> dict[int, float]:
    scores = {}
    for number in np.unique(true[true > 0]).tolist():
        inside = true == number
        candidates = np.unique(segments[inside & (segments > 0)])
        overlaps = [((segments == k) & inside).sum() / ((segments == k) | inside).sum() for k in candidates]
        scores[number] = float(max(overlaps, default=0.0))
    return scores


def grey(camera: Camera) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), 128, np.uint8)


@pytest.mark.parametrize(
    ("camera", "noise", "steps", "bar"),
    [
        (CAMERA, 0.0, 0.0, 0.95), (CAMERA.scale(2), 0.0, 0.0, 0.93),
        (CAMERA, 0.001, 0.0, 0.85), (CAMERA, 0.0005, 0.0028, 0.8), (CAMERA.scale(2), 0.001, 0.0028, 0.8),
    ],
)  # fmt: skip
def test_things_on_a_floor_are_segments(camera: Camera, noise: float, steps: float, bar: float) -> None:
    depth, true = ray_cast(camera, noise, steps)
    segments = GeometricSegmenter().segment(grey(camera), depth, camera)
    scores = best_iou(segments, true)
    assert min(scores.values()) > bar, scores
    assert segments.max() <= 12


def test_a_box_is_one_segment_although_it_has_edges() -> None:
    depth, true = ray_cast(CAMERA)
    segments = GeometricSegmenter().segment(grey(CAMERA), depth, CAMERA)
    inside = segments[true == BOX]
    assert np.bincount(inside).max() > 0.95 * len(inside)


def test_small_holes_are_bridged_and_large_ones_stay() -> None:
    depth, _ = ray_cast(CAMERA)
    depth[::16], depth[:, ::16] = 0, 0
    depth[20:60, 20:80] = 0
    segments = GeometricSegmenter().segment(grey(CAMERA), depth, CAMERA)
    assert (segments[24:56, 24:76] == 0).all()
    assert (segments[80::16] > 0).mean() > 0.95
    whole = GeometricSegmenter().segment(grey(CAMERA), ray_cast(CAMERA)[0], CAMERA)
    assert segments.max() <= whole.max() + 2


def test_same_image_same_segments_and_largest_first() -> None:
    depth, _ = ray_cast(CAMERA, noise=0.001)
    first, second = (GeometricSegmenter().segment(grey(CAMERA), depth.copy(), CAMERA) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert first.dtype == np.uint16
    area = np.bincount(first.ravel())[1:]
    assert (np.diff(area) <= 0).all() and area.min() >= GeometricSettings().min_area * first.size


@pytest.mark.parametrize("size", [(320, 240), (40, 30), (9, 7)])
def test_images_without_depth_of_one_wall_and_tiny_ones(size: tuple[int, int]) -> None:
    camera = CAMERA.resize(*size)
    nothing = np.zeros((size[1], size[0]), np.float32)
    assert not GeometricSegmenter().segment(grey(camera), nothing, camera).any()
    segments = GeometricSegmenter().segment(grey(camera), nothing + 1.5, camera)
    assert (segments == 1).all()


def test_objects_of_the_generated_room(room: Path) -> None:
    sequence = open_sequence(room)
    found = []
    for index in (0, 8, 16):
        frame = sequence.frame(index)
        assert frame.mask is not None
        segments = GeometricSegmenter().segment(frame.color, frame.depth, frame.camera)
        scores = best_iou(segments, np.where(frame.depth > 0, frame.mask, 0))
        found += [score > 0.5 for number, score in scores.items() if (frame.mask == number).sum() > 100]
    assert np.mean(found) > 0.4


def test_objects_on_a_table(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "livingroom", scale=0.5)
    found = []
    for index in (0, 50, 100, 150):
        frame = sequence.frame(index)
        assert frame.mask is not None
        segments = GeometricSegmenter().segment(frame.color, frame.depth, frame.camera)
        things = np.where(frame.mask <= 11, frame.mask, 0)
        found += [score > 0.5 for score in best_iou(segments, things).values()]
    assert np.mean(found) > 0.8


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="GeometricSettings.concave_degrees"):
        GeometricSettings(concave_degrees=0)


def painted(camera: Camera, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Colours of a grey plane with something on it, and where that is, bool [H, W]."""
    color = np.full((camera.height, camera.width, 3), 128, np.uint8)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    thing = (abs(rows - 100) < 30) & (abs(columns - 140) < 40)
    if kind == "picture":  # of two colours in a frame
        color[thing] = (90, 50, 20)
        color[(abs(rows - 100) < 24) & (abs(columns - 140) < 34)] = (40, 90, 200)
        color[(rows > 100) & (rows < 124) & (abs(columns - 140) < 34)] = (40, 160, 60)
    elif kind == "shadow":
        color[thing] = 90
    elif kind == "tiles":
        color[(rows // 30 + columns // 30) % 2 == 0] = (200, 60, 60)
    elif kind == "ragged":
        color[(abs(rows - 100) < 2) | (abs(columns - 140) < 2)] = (200, 60, 60)
    return color, thing


@pytest.mark.parametrize(("kind", "expected"), [("picture", 2), ("shadow", 1), ("tiles", 1), ("ragged", 1)])
@pytest.mark.parametrize("size", [1, 2])
def test_colour_tells_what_lies_flat_on_a_plane(kind: str, expected: int, size: int) -> None:
    camera = CAMERA.scale(size)
    color, thing = painted(CAMERA, kind)
    color, thing = (image.repeat(size, 0).repeat(size, 1) for image in (color, thing))
    depth = np.full(thing.shape, 1.5, np.float32)
    segments = GeometricSegmenter().segment(color, depth, camera)
    assert segments.max() == expected
    if expected == 2:
        assert ((segments == 2) & thing).sum() / ((segments == 2) | thing).sum() > 0.9
    assert GeometricSegmenter(GeometricSettings(color_contrast=0)).segment(color, depth, camera).max() == 1


def test_a_flat_rim_of_the_same_colour_is_a_part_of_its_plane() -> None:
    rows, columns = np.mgrid[:240, :320]
    outside = np.hypot(rows - 120, columns - 160)
    ring = (outside > 80) & (outside < 95)
    depth = (1.5 - 0.028 * np.maximum(1 - abs(outside - 87.5) / 7.5, 0)).astype(np.float32)
    color = grey(CAMERA)
    for settings, expected in ((GeometricSettings(), True), (GeometricSettings(color_contrast=0), False)):
        segments = GeometricSegmenter(settings).segment(color, depth, CAMERA)
        assert (segments[120, 20] == segments[120, 160 + 87]) == expected
    color[ring] = (128, 20, 20)
    segments = GeometricSegmenter().segment(color, depth, CAMERA)
    assert segments[120, 20] != segments[120, 160 + 87]


@pytest.mark.parametrize("size", [(9, 1000), (1000, 9), (1, 60), (4, 4)])
def test_images_of_any_shape_have_segments(size: tuple[int, int]) -> None:
    camera = Camera(size[1], size[0], 300.0, 300.0, size[1] / 2 - 0.5, size[0] / 2 - 0.5)
    found = GeometricSegmenter().segment(np.zeros((*size, 3), np.uint8), np.full(size, 2.0, np.float32), camera)
    assert found.shape == size and found.dtype == np.uint16
