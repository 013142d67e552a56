# SPDX-License-Identifier: Apache-2.0
"""What makes segments of single frames, and their ids over frames, things: gaps that are none, insides, frames, faces
of one body, colours that a plane has nowhere else, floors that furniture divides."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ggslam.objects.association import Associator, MapView
from ggslam.objects.depth_surface import surface_of
from ggslam.objects.geometric_segmenter import GeometricSegmenter
from ggslam.objects.pixel_passes import link_surfaces
from ggslam.objects.settings import AssociationSettings, GeometricSettings
from ggslam.scene.camera import Camera

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
GREY = np.full((240, 320, 3), 128, np.uint8)


class Scene:
    """Boxes, parallel to the camera's axes turned down by `pitch` degrees; x right, y down, z ahead, metres."""

    def __init__(self, pitch: float = 30.0) -> None:
        angle = np.radians(pitch)
        rays = CAMERA.rays().astype(np.float64)
        down, ahead = np.array([0, np.cos(angle), np.sin(angle)]), np.array([0, -np.sin(angle), np.cos(angle)])
        self._rays = np.stack([rays[..., 0], rays @ down, rays @ ahead], -1)
        self.depth = np.full(rays.shape[:2], np.inf)
        self.ids = np.zeros(rays.shape[:2], int)

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], number: int) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = np.array(low) / self._rays, np.array(high) / self._rays
        near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        self._draw(near, (near < far) & (near > 0), number)

    def bowl(self, centre: tuple[float, float, float], radius: float, number: int) -> None:
        """The lower half of a hollow ball, open above."""
        middle = np.array(centre)
        a, b = (self._rays**2).sum(-1), self._rays @ middle
        root = np.sqrt(np.maximum(b**2 - a * (middle @ middle - radius**2), 0))
        for t in ((b - root) / a, (b + root) / a):
            self._draw(t, (root > 0) & (t * self._rays[..., 1] >= middle[1]), number)

    def _draw(self, t: np.ndarray, hit: np.ndarray, number: int) -> None:
        closer = hit & (t < self.depth)
        self.depth[closer], self.ids[closer] = t[closer], number

    def segments(self, color: np.ndarray = GREY) -> np.ndarray:
        return GeometricSegmenter().segment(color, np.where(np.isfinite(self.depth), self.depth, 0), CAMERA)

    def share(self, segments: np.ndarray, number: int) -> float:
        """IoU of an object with its best segment."""
        inside = self.ids == number
        best = np.bincount(segments[inside & (segments > 0)]).argmax()
        return float((inside & (segments == best)).sum() / (inside | (segments == best)).sum())


def test_a_top_seen_at_a_flat_angle_is_unbroken_and_what_stands_before_a_wall_is_not() -> None:
    scene = Scene(pitch=0)
    scene.box((-9, -9, 4), (9, 9, 4.1), 1)
    scene.box((-0.6, 0.5, 2.2), (0.6, 1, 3.4), 2)  # its top spans twenty rows, centimetres of depth each
    surface = surface_of(scene.depth.astype(np.float32), CAMERA, 8.0)
    (_, closed), _ = link_surfaces(surface, surface.valid, GeometricSettings())
    column = scene.ids[:, 160]
    top = np.flatnonzero(column == 2)[:6]
    assert (np.diff(scene.depth[top, 160]) < -0.03).any()
    assert closed[top[:-1], 160].all()
    assert not closed[top[0] - 1, 160]  # from the wall to the top's far edge


def test_the_inside_of_a_bowl_belongs_to_it_and_a_box_behind_a_box_does_not() -> None:
    scene = Scene()
    scene.box((-9, 0.8, -9), (9, 0.9, 9), 1)
    scene.bowl((0, 0.68, 1.1), 0.12, 2)
    assert scene.share(scene.segments(), 2) > 0.9
    scene = Scene()
    scene.box((-9, 0.8, -9), (9, 0.9, 9), 1)
    scene.box((-0.1, 0.68, 1.0), (0.1, 0.8, 1.1), 2)
    scene.box((-0.1, 0.6, 1.2), (0.1, 0.8, 1.3), 3)
    segments = scene.segments()
    assert min(scene.share(segments, 2), scene.share(segments, 3)) > 0.85


def test_panes_belong_to_their_frame_and_what_is_far_behind_does_not() -> None:
    for behind, expected in ((2.02, True), (2.5, False)):
        scene = Scene(pitch=0)
        scene.box((-9, -9, behind), (9, 9, 3), 1)
        for x in (-0.5, -0.03, 0.44):
            scene.box((x, -0.5, 1.98), (x + 0.06, 0.5, 1.999), 2)
        for y in (-0.5, 0.44):
            scene.box((-0.5, y, 1.98), (0.5, y + 0.06, 1.999), 2)
        segments = scene.segments()
        frame, pane, wall = segments[119, 159], segments[119, 130], segments[119, 20]
        assert frame != wall
        assert (pane == frame) == expected
        assert (pane == wall) != expected


def test_a_top_and_the_front_below_it_are_one_and_a_low_thing_near_the_edge_is_not() -> None:
    scene = Scene()
    scene.box((-9, 1.4, -9), (9, 1.5, 9), 1)
    scene.box((-0.55, 0.7, 1.25), (0.55, 0.74, 2.0), 2)
    scene.box((-0.5, 0.74, 1.30), (0.5, 1.4, 1.95), 2)
    scene.box((-0.15, 0.68, 1.3), (0.15, 0.7, 1.5), 3)
    segments = scene.segments()
    assert scene.share(segments, 2) > 0.93
    assert scene.share(segments, 3) > 0.9


def test_pictures_of_one_depth_on_a_wall_are_several_and_a_wall_behind_a_pillar_is_one() -> None:
    scene = Scene(pitch=0)
    scene.box((-9, -9, 2.0), (9, 9, 2.1), 1)
    scene.box((-0.7, -0.3, 1.97), (-0.2, 0.3, 2.0), 2)
    scene.box((0.2, -0.3, 1.97), (0.7, 0.3, 2.0), 3)
    scene.box((-0.06, -9, 1.2), (0.06, 9, 1.3), 4)
    segments = scene.segments()
    assert len({segments[119, 110], segments[119, 210], segments[20, 20]}) == 3
    assert segments[20, 20] == segments[20, 300]


def chequered(with_mat: bool) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[:240, :320]
    color = np.where(((rows // 20 + columns // 20) % 2 == 0)[..., None], (215, 205, 190), (60, 65, 70)).astype(np.uint8)
    mat = (abs(rows - 110) < 32) & (abs(columns - 150) < 48)
    pattern = np.where(((rows // 6 + columns // 6) % 2 == 0)[..., None], (40, 80, 140), (190, 120, 60))
    if with_mat:
        color[mat] = pattern[mat]
    return color, mat


def test_a_patterned_mat_on_a_chequered_floor_is_a_thing_and_the_chequers_are_none() -> None:
    depth = np.full((240, 320), 1.5, np.float32)
    color, mat = chequered(True)
    segments = GeometricSegmenter().segment(color, depth, CAMERA)
    inside = segments == segments[110, 150]
    assert (inside & mat).sum() / (inside | mat).sum() > 0.85
    assert GeometricSegmenter().segment(chequered(False)[0], depth, CAMERA).max() == 1


def floor_and_island(x: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, segments (1 floor, 2 island, 3 wall) and pose of a camera at `x` that looks down on one side of it."""
    scene = Scene(pitch=40)
    for low, high, number in (
        ((-9.0, 1.5, -9.0), (9.0, 1.6, 9.0), 1),
        ((-0.5, 0.8, 0.2), (0.5, 1.5, 9.0), 2),
        ((-9.0, -9.0, 3.0), (9.0, 9.0, 3.1), 3),
    ):
        scene.box((low[0] - x, low[1], low[2]), (high[0] - x, high[1], high[2]), number)
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, c, s], [0, -s, c]]
    pose[:3, 3] = [x, 0, 0]
    return scene.depth.astype(np.float32), scene.ids.astype(np.uint16), pose


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_a_floor_on_both_sides_of_an_island_is_one_and_a_step_is_another(height: float) -> None:
    associator = Associator(AssociationSettings(mode="always"))
    depth, segments, pose = floor_and_island(-1.6)
    floor = int(associator.associate(segments, None, depth, CAMERA, pose).ids[segments == 1][0])
    depth, segments, pose = floor_and_island(1.6)
    pose[1, 3] += height
    nothing = MapView(np.zeros_like(segments), np.zeros_like(depth), np.zeros_like(depth))
    found = associator.associate(segments, nothing, depth, CAMERA, pose)
    assert (int(found.ids[segments == 1][0]) == floor) == (height == 0)
    assert floor not in found.created


def test_new_ground_between_known_corners_of_a_floor_is_floor() -> None:
    """Two corners of the floor right of the island are in the map as things of their own."""
    associator = Associator(AssociationSettings(mode="always"))
    depth, segments, pose = floor_and_island(1.6)
    segments[:190][segments[:190] == 1] = 0  # what lies farther away is hidden
    corners = np.zeros_like(segments)
    corners[210:, 275:], corners[210:, 200:240] = 1, 2
    seen = associator.associate(corners, None, depth, CAMERA, pose).ids
    assert len(np.unique(seen[corners > 0])) == 2
    shown = MapView(seen, (seen > 0).astype(np.float32), np.where(seen > 0, depth, 0))
    found = associator.associate(segments, shown, depth, CAMERA, pose).ids
    new_ground = (segments == 1) & (seen == 0)
    assert np.isin(found[new_ground], seen[corners > 0]).all()


def test_panes_beside_a_curtain_belong_to_their_frame() -> None:
    """The curtain hangs five centimetres before the outer edge of a pane: less than a frame may stand out."""
    scene = Scene(pitch=0)
    scene.box((-9, -9, 2.02), (9, 9, 3), 1)
    for x in (-0.5, -0.03, 0.44):
        scene.box((x, -0.5, 1.98), (x + 0.06, 0.5, 1.999), 2)
    for y in (-0.5, 0.44):
        scene.box((-0.5, y, 1.98), (0.5, y + 0.06, 1.999), 2)
    scene.box((-0.8, -0.7, 1.96), (-0.35, 0.7, 1.97), 3)
    segments = scene.segments()
    assert segments[119, 130] == segments[119, 159]  # the pane that the curtain hides in part, and the frame
    assert segments[119, 130] not in (segments[119, 90], segments[119, 20])  # curtain, wall


@pytest.mark.parametrize("painted", [False, True])
def test_a_slight_bend_parts_what_has_two_colours(painted: bool) -> None:
    """Two faces at 15 degrees: of one body, unless their colours say otherwise."""
    rays = CAMERA.rays().astype(np.float64)
    angle = np.radians(7.5)
    normal = np.array([np.sin(angle), 0, -np.cos(angle)])
    left = np.broadcast_to(np.arange(320) < 160, (240, 320))
    depth = np.where(left, -2 / (rays @ (normal * [-1, 1, 1])), -2 / (rays @ normal)).astype(np.float32)
    depth[:60] += 1  # a wall behind
    color = np.where((left & painted)[..., None], (190, 60, 50), (150, 150, 150)).astype(np.uint8)
    segments = GeometricSegmenter().segment(color, depth, CAMERA)
    assert (segments[119, 60] != segments[119, 260]) == painted
    blind = GeometricSegmenter(GeometricSettings(color_contrast=0)).segment(color, depth, CAMERA)
    assert blind[119, 60] == blind[119, 260]


def small_thing(height: float) -> Scene:
    """A table in the middle of a room and something of 8 cm on it, 1.4 m away: some 100 pixels."""
    scene = Scene()
    scene.box((-9, 1.4, -9), (9, 1.5, 9), 1)
    scene.box((-0.7, 0.7, 0.5), (0.7, 0.75, 2.2), 2)
    scene.box((0.1, 0.7 - height, 1.2), (0.18, 0.7, 1.26), 3)
    return scene


def test_a_small_thing_of_another_colour_on_a_table_is_a_thing_and_a_spot_is_none() -> None:
    scene = small_thing(0.012)
    color = np.where((scene.ids == 3)[..., None], (190, 60, 40), (150, 150, 150)).astype(np.uint8)
    assert 60 < (scene.ids == 3).sum() < 160
    assert scene.share(scene.segments(color), 3) > 0.8
    spot = small_thing(0.0005)
    assert spot.share(spot.segments(color), 3) < 0.1


def test_coloured_bumps_of_the_noise_of_a_table_are_no_things() -> None:
    scene = small_thing(0.001)
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=scene.depth.shape), (0, 0), 4.0)
    noise /= noise.std()
    depth = np.where(np.isfinite(scene.depth), scene.depth, 0)
    depth += 0.003 * depth**2 * noise  # some bumps rise above what planes tolerate
    color = np.where((noise > 1)[..., None], (190, 60, 40), (150, 150, 150)).astype(np.uint8)
    segments = GeometricSegmenter().segment(color, depth.astype(np.float32), CAMERA)
    assert len(np.unique(segments[scene.ids == 2])) == 1
