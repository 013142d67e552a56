# SPDX-License-Identifier: Apache-2.0
"""Points of drawn surfaces: where they lie, their colours, and the people that the codec's benchmarks make of them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.scene import Light, Scene
from ggslam.synthetic.walker import person_in_stride

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "benchmarks"))
import gpcc_clouds  # noqa: E402

LIGHT = Light(np.array([[2.0, 0.5, 2.0], [2.1, 0.5, 2.0]]), (1.5, 1.5, 1.5))


def test_surfaces_have_the_colours_that_a_camera_sees() -> None:
    shapes = [replace(s, casts_shadow=True) for s in person_in_stride(np.random.default_rng(3), 0.3)]
    caster = RayCaster(Scene(shapes, [LIGHT]), 0)
    camera = Camera(fx=400.0, fy=400.0, cx=159.5, cy=239.5, width=320, height=480)
    T_world_camera = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, 0, 1]])
    view, compared = caster.render(camera, T_world_camera), 0
    for number in range(len(shapes)):
        points, colors = caster.surface(number, 0.004)
        seen = points @ inverse(T_world_camera)[:3, :3].T + inverse(T_world_camera)[:3, 3]
        pixel = np.rint(seen[:, :2] / seen[:, 2:] * 400 + [159.5, 239.5]).astype(int)
        inside = ((pixel >= 0) & (pixel < [320, 480])).all(1)
        x, y = pixel[inside].T
        near = np.abs(view.depth[y, x] - seen[inside, 2]) < 0.004
        error = np.abs(view.color[y, x][near].astype(int) - colors[inside][near])
        compared += len(error)
        assert not len(error) or np.median(error) <= 3, number
    assert compared > 10_000


def test_people_are_closed_surfaces_and_the_same_every_time() -> None:
    one, again, other = (gpcc_clouds.person(seed, bits=7) for seed in (1, 1, 2))
    assert np.array_equal(one.grid, again.grid) and np.array_equal(one.colors, again.colors)
    assert one.grid.max() == 127 and not np.array_equal(one.colors[:999], other.colors[:999])
    occupied = np.zeros((130, 130, 130), bool)
    occupied[tuple(one.grid.T + 1)] = True
    inside = np.zeros_like(occupied)
    inside[0] = True  # what is reached from outside...
    while True:
        grown = inside.copy()
        for axis in range(3):
            for step in (1, -1):
                grown |= np.roll(inside, step, axis)
        grown &= ~occupied
        if grown.sum() == inside.sum():
            break
        inside = grown
    hidden = ~inside & ~occupied  # ...is not what the skin encloses
    assert hidden.sum() > len(one.grid) / 2
