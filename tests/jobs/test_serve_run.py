# SPDX-License-Identifier: Apache-2.0
"""What is published of a finished run is what its files say."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path as FilePath
from shutil import copytree

import numpy as np
from scipy.spatial import cKDTree
from serve_tools import KeptOutlet, chain, until

from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.frames_tree import T_OPTICAL_CAMERA
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_contents import RunContents, ServedRun
from ggslam.jobs.serve.run_volumes import VOLUMES, RunVolumes
from ggslam.jobs.serve.tiles import tile_of
from ggslam.jobs.serve.volume_contents import VolumeContentsTuning
from ggslam.jobs.volumes.fuse_volumes import fuse_volumes
from ggslam.runs.folder import RunFolder
from ggslam.runs.opened_points import surface_points
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import overridden
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.tsdf_file import load_tsdf


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


def test_a_run_is_published(room_run: RunFolder) -> None:
    outlet = KeptOutlet(everybody=0)
    asked = (c.TF_STATIC, c.PATH, c.POINTS, c.POINT_TILES, c.SPLATS, c.OBJECTS, c.VERDICTS)
    outlet.heard = {channel.name: 1 for channel in asked}
    with served(room_run, outlet) as (_, publisher):
        until(lambda: {kept.channel.name for kept in outlet.sent} == {channel.name for channel in asked})
        assert publisher.wait_idle(5.0)
    trajectory = room_run.trajectory()
    path = outlet.of(c.PATH.name)[0]
    np.testing.assert_allclose(path.poses @ inverse(T_OPTICAL_CAMERA), trajectory.T_world_camera, rtol=0, atol=2e-9)
    np.testing.assert_allclose(path.stamps, trajectory.timestamps, rtol=0, atol=1e-9)
    tree = outlet.of(c.TF_STATIC.name)[0]
    assert tree.fixed
    found = chain(tree, c.MAP, c.ODOM, c.CAMERA, c.OPTICAL)
    np.testing.assert_allclose(found, trajectory.T_world_camera[-1], rtol=0, atol=2e-9)
    surface = surface_points(room_run, None)
    assert len(outlet.of(c.POINTS.name)) == len(outlet.of(c.SPLATS.name)) == 1
    points, tiles = outlet.of(c.POINTS.name)[0], outlet.of(c.POINT_TILES.name)
    assert points.values["count"].sum() == len(surface) == sum(tile.values["count"].sum() for tile in tiles)
    assert cKDTree(surface.points).query(points.xyz)[0].max() < 1e-6  # each is a point of the surface, no mean of some
    assert all(len(np.unique(tile_of(tile.xyz), axis=0)) == 1 for tile in tiles)
    assert {t.id for t in outlet.of(c.OBJECTS.name)[0].things} == set(room_run.object_table().ids())


def test_nothing_is_made_that_nobody_listens_to_and_who_joins_gets_all(room_run: RunFolder) -> None:
    outlet = KeptOutlet(everybody=0)
    tiles = len(np.unique(tile_of(surface_points(room_run, None).points), axis=0))
    with served(room_run, outlet) as (_, publisher):
        time.sleep(0.1)
        assert not outlet.sent and publisher.newest(c.POINT_TILES) == []
        outlet.join(c.POINT_TILES.name)
        until(lambda: len(outlet.of(c.POINT_TILES.name)) >= tiles)  # idle between two tiles is not the end of them
        assert publisher.wait_idle(5.0) and len(outlet.of(c.POINT_TILES.name)) == tiles
        outlet.join(c.POINT_TILES.name)  # a second one: all tiles again
        until(lambda: len(outlet.of(c.POINT_TILES.name)) >= 2 * tiles)
        assert publisher.wait_idle(5.0) and len(outlet.of(c.POINT_TILES.name)) == 2 * tiles
        assert not outlet.of(c.POINTS.name)


def test_volumes_are_those_of_the_files(room_run: RunFolder, tmp_path: FilePath) -> None:
    """Of the files that `ggslam volumes` wrote: distances, grids, mesh, the floor's frame."""
    run = RunFolder.open(copytree(room_run.path, tmp_path / "run"))
    fuse_volumes(run.path, esdf=True, objects=False, voxel=0.04, robots=["low:0.4,0.2"])
    volumes = RunVolumes(run, ["tall:1.2,0.3"])
    assert volumes.robots() == ["low", "tall"] and volumes.place() == run.path / VOLUMES
    contents = RunContents(run, volumes)
    field = DistanceField(load_tsdf(run.path / VOLUMES / "tsdf.npz"))
    field.update()
    cut = volumes.distance_slice(contents.poses)
    np.testing.assert_allclose(cut.values["distance"], field.query(cut.xyz).distance, atol=2e-5)
    assert len(cut.xyz) > 100
    heights = transform_points(cut.xyz, volumes.floor())[:, 2]
    assert np.ptp(heights) < 1e-4  # a level slice
    low, tall = volumes.grid("low"), volumes.grid("tall")
    assert low.cell_m == tall.cell_m and low.frame == c.FLOOR
    assert (low.cells == 0).any() and (tall.cells == 100).sum() >= (low.cells == 100).sum() > 0
    made = RunVolumes(run, ["low:0.4,0.2"]).grid("low")  # from the field instead of the file
    np.testing.assert_array_equal(made.cells, low.cells)
    np.testing.assert_allclose(made.T_frame_origin, low.T_frame_origin, atol=1e-6)
    parts = volumes.mesh_parts()
    assert len({part.part for part in parts}) == len(parts) and sum(len(part.triangles) for part in parts) > 100
    assert np.abs(field.query(np.concatenate([part.vertices for part in parts])).distance).max() < 0.04
    fine = sum(len(part.triangles) for part in parts)
    with overridden(VolumeContentsTuning, most_triangles=fine // 3, part_triangles=50):
        coarse = volumes.mesh_parts()
    assert fine // 30 < sum(len(part.triangles) for part in coarse) <= fine // 3
    assert max(len(part.triangles) for part in coarse) <= 50
    assert np.abs(field.query(np.concatenate([part.vertices for part in coarse])).distance).max() < 0.15
    np.testing.assert_array_equal(
        volumes.T_floor_map(run.gaussians, contents.poses), volumes.floor(), err_msg="floor.yaml is what counts"
    )


def test_a_run_without_volumes_gets_them_when_asked(room_run: RunFolder) -> None:
    volumes = RunVolumes(room_run)
    place = volumes.place()
    assert (place / "tsdf.npz").is_file() and not (room_run.path / VOLUMES).exists()
    volumes.close()
    assert not place.exists()
