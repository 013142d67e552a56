# SPDX-License-Identifier: Apache-2.0
"""What is published of a finished run is what its files say."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path as FilePath

import numpy as np

sys.path.insert(0, str(FilePath(__file__).parents[1] / "messages"))
from kept_outlet import KeptOutlet  # noqa: E402

from ggslam.jobs.serve import channels as c  # noqa: E402
from ggslam.jobs.serve.frames_tree import T_OPTICAL_CAMERA  # noqa: E402
from ggslam.jobs.serve.publishing import MapPublisher  # noqa: E402
from ggslam.jobs.serve.run_contents import RunContents, ServedRun  # noqa: E402
from ggslam.jobs.serve.run_volumes import RunVolumes  # noqa: E402
from ggslam.jobs.serve.tiles import TileTuning, tile_of  # noqa: E402
from ggslam.messages.contents import Transforms  # noqa: E402
from ggslam.runs.folder import RunFolder  # noqa: E402
from ggslam.scene.poses import inverse  # noqa: E402


@contextmanager
def served(run: RunFolder, outlet: KeptOutlet) -> Iterator[tuple[RunContents, MapPublisher]]:
    volumes = RunVolumes(run)
    contents = RunContents(run, volumes)
    publisher = MapPublisher([(outlet, False)], contents.channels())
    serving = ServedRun(contents, publisher)
    yield contents, publisher
    serving.close()
    publisher.close()
    volumes.close()


def until(happened: object, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not happened():  # type: ignore[operator]
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def chain(transforms: Transforms, *frames: str) -> np.ndarray:
    """T_first_last along edges parent to child."""
    edges = {(parent, child): T for parent, child, T in transforms.edges}
    T = np.eye(4)
    for parent, child in zip(frames[:-1], frames[1:], strict=True):
        T = T @ edges[parent, child]
    return T


def test_a_run_is_published(room_run: RunFolder) -> None:
    outlet = KeptOutlet(everybody=0)
    asked = (c.TF_STATIC, c.PATH, c.POINTS, c.POINT_TILES, c.SPLATS, c.OBJECTS, c.VERDICTS)
    outlet.heard = {channel.name: 1 for channel in asked}
    with served(room_run, outlet) as (_, publisher):
        until(lambda: {kept.channel.name for kept in outlet.sent} == {channel.name for channel in asked})
        assert publisher.wait_idle(5.0)
    trajectory, gaussians = room_run.trajectory(), room_run.gaussians()
    path = outlet.of(c.PATH.name)[0]
    np.testing.assert_allclose(path.poses @ inverse(T_OPTICAL_CAMERA), trajectory.T_world_camera, rtol=0, atol=2e-9)
    np.testing.assert_allclose(path.stamps, trajectory.timestamps, rtol=0, atol=1e-9)
    tree = outlet.of(c.TF_STATIC.name)[0]
    assert tree.fixed
    found = chain(tree, c.MAP, c.ODOM, c.CAMERA, c.OPTICAL)
    np.testing.assert_allclose(found, trajectory.T_world_camera[-1], rtol=0, atol=2e-9)
    solid = gaussians.opacities.numpy() >= TileTuning.min_opacity
    assert outlet.of(c.POINTS.name)[0].values["count"].sum() == solid.sum()
    tiles = outlet.of(c.POINT_TILES.name)
    assert sum(tile.values["count"].sum() for tile in tiles) == solid.sum()
    assert all(len(np.unique(tile_of(tile.xyz), axis=0)) == 1 for tile in tiles)
    assert {t.id for t in outlet.of(c.OBJECTS.name)[0].things} == set(room_run.object_table().ids())


def test_nothing_is_made_that_nobody_listens_to_and_who_joins_gets_all(room_run: RunFolder) -> None:
    outlet = KeptOutlet(everybody=0)
    with served(room_run, outlet) as (_, publisher):
        time.sleep(0.1)
        assert not outlet.sent and publisher.newest(c.POINT_TILES) == []
        outlet.join(c.POINT_TILES.name)
        until(lambda: outlet.of(c.POINT_TILES.name))
        publisher.wait_idle(5.0)
        first = len(outlet.of(c.POINT_TILES.name))
        outlet.join(c.POINT_TILES.name)  # a second one: all tiles again
        until(lambda: len(outlet.of(c.POINT_TILES.name)) == 2 * first)
        assert not outlet.of(c.POINTS.name)
