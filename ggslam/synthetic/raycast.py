# SPDX-License-Identifier: Apache-2.0
"""Renders a scene: exact depth and instance ids at the pixel centres, shaded colour with four rays a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.synthetic.lighting import LightMaps, bake, bake_further
from ggslam.synthetic.materials import Material
from ggslam.synthetic.scene import FACES, Kind, Scene, Shape
from ggslam.synthetic.surfaces import face_sizes, intersect, locate, surface_points
from ggslam.system.tuning import Tuning


class RaycastTuning(Tuning):
    """How shapes are drawn."""

    near_m = 0.02
    """Depth before which shapes are cut off when their outline is computed, in metres."""
    exposure = 1.25
    """Exposure of the camera: how fast light saturates."""


_BOX_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_BOX_EDGES = np.array([(i, j) for i in range(8) for j in range(i + 1, 8) if bin(i ^ j).count("1") == 1])


@dataclass(frozen=True)
class RayImages:
    """One view: colour uint8 [H, W, 3]; depth float32 [H, W], metres along the optical axis, 0 = nothing; mask
    uint16 [H, W]."""

    color: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


class RayCaster:
    """Renders views of one scene. Texture pyramids are prepared once, light maps when colour is first needed.

    Further shapes are lit by the scene but cast no shadows on it; these and the scene's own can be placed elsewhere.
    They take their light with them.
    """

    def __init__(self, scene: Scene, seed: int = 0, further: Sequence[Shape] = ()) -> None:
        self._scene = scene
        self._shapes = [*scene.shapes, *further]
        self._kinds = np.array([int(shape.kind) for shape in self._shapes])
        self._half = np.array([shape.half for shape in self._shapes], np.float32)
        self._top = np.array([shape.top for shape in self._shapes], np.float32)
        self._bounds = np.array([shape.bounds() for shape in self._shapes])
        self._T_shape_world = inverse(np.array([shape.T_world_shape for shape in self._shapes]))
        self._instances = np.array([0] + [shape.instance for shape in self._shapes], np.uint16)
        self._materials: list[Material] = []
        self._pyramids: list[list[np.ndarray]] = []
        self._prepare_faces(np.random.default_rng(seed))

    @cached_property
    def _lights(self) -> LightMaps:
        maps, further = bake(self._scene), self._shapes[len(self._scene.shapes) :]
        return bake_further(self._scene, maps, further) if further else maps

    def place(self, numbers: Sequence[int], T_world_shapes: np.ndarray) -> None:
        """Puts shapes elsewhere: their numbers, the scene's before the further ones, and poses [n, 4, 4]."""
        self._T_shape_world[list(numbers)] = inverse(T_world_shapes)

    def _prepare_faces(self, rng: np.random.Generator) -> None:
        """Per face: material, texture coordinates as an affine map of (u, v), and metres per texel."""
        numbers: dict[int, int] = {}
        self._first_face = np.cumsum([0] + [FACES[shape.kind] for shape in self._shapes])[:-1]
        material: list[int] = []
        affine: list[tuple[float, ...]] = []
        texel: list[float] = []
        for shape in self._shapes:
            offset = rng.uniform(0, 1, 2)
            for face, (width, height) in enumerate(face_sizes(shape)):
                m = shape.faces.get(face, shape.material)
                if id(m) not in numbers:
                    numbers[id(m)] = len(self._materials)
                    self._materials.append(m)
                    self._pyramids.append(m.pyramid())
                material.append(numbers[id(m)])
                rows, columns = m.image.shape[:2]
                if m.tile is None:
                    affine.append((1, 0, 0, 0, 1, 0))
                    texel.append(max(width / columns, height / rows))
                    continue
                a, b = width / m.tile, height / m.tile
                turned = m.grain and height > width
                affine.append((0, b, offset[0], a, 0, offset[1]) if turned else (a, 0, offset[0], 0, b, offset[1]))
                texel.append(m.tile / columns)
        self._face_material = np.array(material)
        self._face_affine = np.array(affine, np.float32)
        self._face_texel = np.array(texel, np.float32)

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> RayImages:
        """One view. `T_world_camera` [4, 4]."""
        T_shape_camera = self._T_shape_world @ T_world_camera
        depth, mask = self.measure(camera, T_world_camera)
        fine = camera.resize(2 * camera.width, 2 * camera.height)
        u = ((np.arange(fine.width) - fine.cx) / fine.fx).astype(np.float32)
        v = ((np.arange(fine.height) - fine.cy) / fine.fy).astype(np.float32)
        light = self._shade(u, v, *self._trace(u, v, T_shape_camera), T_shape_camera, 1 / fine.fx)
        light = cv2.resize(light, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return RayImages(_expose(light), depth, mask)

    def surface(self, number: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Points of a shape's surface, float64 [n, 3], and their colours uint8 [n, 3].

        Args:
            number: of the shape.
            spacing: between points, metres, about.
        """
        shape, points, colors = self._shapes[number], [], []
        T_world_shape = inverse(self._T_shape_world[number])
        for face, sides in enumerate(face_sizes(shape)):
            columns, rows = (max(1, int(np.ceil(side / spacing))) for side in sides)
            grid = np.mgrid[:rows, :columns].reshape(2, -1) + 0.5
            v, u = grid[0] / rows, grid[1] / columns
            own, _ = surface_points(shape, face, u, v)
            of = np.full(len(own), self._first_face[number] + face)
            light = self._light_of_faces(of, *(x.astype(np.float32) for x in (u, v, np.full(len(own), spacing))))
            points.append(own @ T_world_shape[:3, :3].T + T_world_shape[:3, 3])
            colors.append(_expose(light))
        return np.concatenate(points), np.concatenate(colors)

    def measure(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth and mask of one view, as in `RayImages`, without the cost of light and colour."""
        u = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
        v = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
        depth, hit = self._trace(u, v, self._T_shape_world @ T_world_camera)
        return np.where(hit >= 0, depth, np.float32(0)), self._instances[hit + 1]

    def _trace(self, u: np.ndarray, v: np.ndarray, T_shape_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth float32 [H, W] and number of the nearest shape int16 [H, W] (-1: none) on the rays (u, v, 1)."""
        depth = np.full((len(v), len(u)), np.inf, np.float32)
        hit = np.full((len(v), len(u)), -1, np.int16)
        boxes = _outlines(self._bounds, T_shape_camera)
        columns = np.searchsorted(u, boxes[:, (0, 2)])
        rows = np.searchsorted(v, boxes[:, (1, 3)])
        nearest_depth = self._nearest_depths(T_shape_camera)
        for number in np.nonzero((columns[:, 0] < columns[:, 1]) & (rows[:, 0] < rows[:, 1]))[0]:
            window = (slice(*rows[number]), slice(*columns[number]))
            if depth[window].max() <= nearest_depth[number]:
                continue  # hidden behind earlier shapes
            R, o = (part.astype(np.float32) for part in np.split(T_shape_camera[number, :3], [3], 1))
            across, down = u[window[1]][None, :], v[window[0]][:, None]
            direction = [R[k, 0] * across + (R[k, 1] * down + R[k, 2]) for k in range(3)]
            t = intersect(self._shapes[number], (o[0], o[1], o[2]), (direction[0], direction[1], direction[2]))
            nearest = depth[window]
            closer = t < nearest
            np.copyto(nearest, t, where=closer)
            np.copyto(hit[window], np.int16(number), where=closer)
        return depth, hit

    def _nearest_depths(self, T_shape_camera: np.ndarray) -> np.ndarray:
        """A lower bound [n] of the depth of each shape: of its bounding box, less a margin for rounding."""
        R, o = T_shape_camera[:, :3, :3], T_shape_camera[:, :3, 3]
        middle = -np.einsum("nk,nk->n", R[:, :, 2], o)
        return middle - np.einsum("nk,nk->n", np.abs(R[:, :, 2]), self._bounds) - 1e-3

    def _shade(
        self, u: np.ndarray, v: np.ndarray, depth: np.ndarray, hit: np.ndarray, T_shape_camera: np.ndarray, angle: float
    ) -> np.ndarray:
        """Linear light float32 [H, W, 3] that comes back along the rays; `angle` is the angle between them."""
        light = np.zeros((depth.size, 3), np.float32)
        flat_hit, flat_depth = hit.ravel().astype(np.int64), depth.ravel()
        T = T_shape_camera.astype(np.float32)
        kind_of_pixel = np.append(self._kinds, -1)[flat_hit]
        for kind in Kind:
            pixels = np.nonzero(kind_of_pixel == kind)[0]
            if not len(pixels):
                continue
            number, t = flat_hit[pixels], flat_depth[pixels]
            ray = np.stack([u[pixels % len(u)], v[pixels // len(u)], np.ones(len(pixels), np.float32)], 1)
            turned = np.einsum("nij,nj->ni", T[number, :3, :3], ray)
            points = T[number, :3, 3] + t[:, None] * turned
            face, a, b, normal = locate(kind, points, self._half[number], self._top[number])
            cosine = np.abs((normal * turned).sum(1)) / np.sqrt((normal**2).sum(1) * (turned**2).sum(1))
            face = face + self._first_face[number]
            light[pixels] = self._light_of_faces(face, a, b, t * np.float32(angle) / np.sqrt(np.maximum(cosine, 0.05)))
        return light.reshape(*depth.shape, 3)

    def _light_of_faces(self, face: np.ndarray, u: np.ndarray, v: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Light [n, 3] from points (u, v) on faces, `footprint` metres wide."""
        maps = self._lights
        columns, rows = maps.size[face].T.astype(np.float32)
        x = maps.corner[face, 0] + np.clip(u * columns - np.float32(0.5), 0, columns - 1)
        y = maps.corner[face, 1] + np.clip(v * rows - np.float32(0.5), 0, rows - 1)
        light = _sample(maps.atlas, x, y, cv2.BORDER_REPLICATE)
        affine = self._face_affine[face]
        s = affine[:, 0] * u + affine[:, 1] * v + affine[:, 2]
        t = affine[:, 3] * u + affine[:, 4] * v + affine[:, 5]
        level = np.clip(np.rint(np.log2(footprint / self._face_texel[face])), 0, 15).astype(np.int64)
        group = self._face_material[face] * 16 + level
        order = np.argsort(group.astype(np.int16), kind="stable")
        edges = np.nonzero(np.diff(group[order], prepend=-1, append=-1))[0]
        for start, stop in zip(edges[:-1], edges[1:], strict=True):
            chosen = order[start:stop]
            number, wanted = divmod(int(group[chosen[0]]), 16)
            material, pyramid = self._materials[number], self._pyramids[number]
            texture = _look_up(material, pyramid[min(wanted, len(pyramid) - 1)], s[chosen], t[chosen])
            light[chosen] = texture * (material.emission if material.emission else light[chosen])
        return light


def _expose(light: np.ndarray) -> np.ndarray:
    """Colour uint8 that a camera makes of linear light."""
    return np.rint(255 * (1 - np.exp(-RaycastTuning.exposure * light)) ** (1 / 2.2)).astype(np.uint8)


def _look_up(material: Material, image: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Reflectance [n, 3] at texture coordinates (1 = one copy of the image)."""
    rows, columns = image.shape[:2]
    if material.tile is None:
        x, y = np.clip(s * columns - 0.5, 0, columns - 1), np.clip(t * rows - 0.5, 0, rows - 1)
        return _sample(image, x, y, cv2.BORDER_REPLICATE)
    return _sample(image, s % 1 * columns - 0.5, t % 1 * rows - 0.5, cv2.BORDER_WRAP)


def _sample(image: np.ndarray, x: np.ndarray, y: np.ndarray, border: int) -> np.ndarray:
    """Bilinear samples [n, 3] of an image at columns x and rows y."""
    width = 1024  # OpenCV limits the sides of a map to 32767
    count = len(x)
    padding = -count % width
    maps = [np.pad(a.astype(np.float32), (0, padding)).reshape(-1, width) for a in (x, y)]
    return cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=border).reshape(-1, 3)[:count]


def _outlines(bounds: np.ndarray, T_shape_camera: np.ndarray) -> np.ndarray:
    """Rectangles around the images of bounding boxes: left, top, right, bottom [n, 4] in units of x/z and y/z (left >
    right for boxes behind the camera).

    Args:
        bounds: half extents [n, 3]; T_shape_camera: [n, 4, 4].
    """
    R, o = T_shape_camera[:, :3, :3], T_shape_camera[:, None, :3, 3]
    corners = (_BOX_CORNERS * bounds[:, None] - o) @ R  # in the camera frame, [n, 8, 3]
    first, second = corners[:, _BOX_EDGES[:, 0]], corners[:, _BOX_EDGES[:, 1]]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where edges cross the near plane, the points on it bound the image.
        share = (RaycastTuning.near_m - first[..., 2:]) / (second[..., 2:] - first[..., 2:])
        cuts = first + share * (second - first)
        points = np.concatenate([corners, cuts], 1)
        projected = points[..., :2] / points[..., 2:]
    front = corners[..., 2] > RaycastTuning.near_m
    crossing = front[:, _BOX_EDGES[:, 0]] != front[:, _BOX_EDGES[:, 1]]
    used = np.concatenate([front, crossing], 1)[..., None]
    low = np.where(used, projected, np.inf).min(1) - 1e-4
    high = np.where(used, projected, -np.inf).max(1) + 1e-4
    return np.concatenate([low, high], 1)
