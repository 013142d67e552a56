# SPDX-License-Identifier: Apache-2.0
"""Mesh, grids and distances of a run that goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree, rmtree

import numpy as np
import pytest
from scipy.spatial import cKDTree
from serve_tools import KeptOutlet, until

import ggslam
from ggslam.driving.bands import HeightLayers, floor_plane
from ggslam.driving.robot import Robot
from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.keyframe_volumes import Floor, FusedKeyframes, PlacedKeyframe
from ggslam.jobs.serve.live_contents import LiveContents, LiveContentsTuning
from ggslam.jobs.serve.live_functions import LiveFunctions
from ggslam.jobs.serve.live_serving import AFTER, LIVE
from ggslam.jobs.serve.live_volumes import GrowingVolumes, LiveVolumesTuning
from ggslam.jobs.serve.pausing import Pause
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_volumes import RunVolumes
from ggslam.jobs.serve.volume_contents import grid_of, layers_of
from ggslam.jobs.volumes.fuse_volumes import fuse_volumes
from ggslam.mapping.keyframe import make_keyframe
from ggslam.messages.contents import Grid
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, transform_points
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.room import furnished_room
from ggslam.system.tuning import overridden

MOVE = se3_exp(np.array([0.4, 0.1, -0.2, 0, 0.15, 0]))
FLOOR = Floor(np.eye(4), True)  # the room's own axes: z up from the floor
CHANNELS = (*LIVE, *AFTER, c.grid_channel(""))


class ExactRoom:
    """Exact depth of the generated room at the true poses, as keyframes; and points of its exact surface."""

    def __init__(self, recording: Path) -> None:
        truth = ggslam.open_sequence(recording).ground_truth
        assert truth is not None
        self.poses = np.stack([truth[k] for k in range(24)])
        caster, self.views, exact = RayCaster(furnished_room(0)), list[PlacedKeyframe](), []
        camera = Camera(160, 120, 140, 140, 79.5, 59.5)
        color = np.full((120, 160, 3), 128, np.uint8)
        for k, T in enumerate(self.poses):
            frame = Frame(k, k, k / 10, color, caster.measure(camera, T)[0], camera)
            self.views.append(PlacedKeyframe(make_keyframe(k, frame, T), inverse(T)))
            fine = camera.resize(640, 480)
            points = fine.back_project(caster.measure(fine, T)[0])[::2, ::2].reshape(-1, 3)
            exact.append(transform_points(points[points[:, 2] > 0].astype(float), T))
        self.surface = cKDTree(np.concatenate(exact))


@pytest.fixture(scope="module")
def exact(room: Path) -> ExactRoom:
    return ExactRoom(room)


@contextmanager
def growing(outlet: KeptOutlet) -> Iterator[tuple[GrowingVolumes, MapPublisher]]:
    publisher = MapPublisher([(outlet, True)], CHANNELS)
    yield GrowingVolumes(publisher, {"": Robot()}), publisher
    publisher.close()


def mesh_of(outlet: KeptOutlet) -> np.ndarray:
    """Vertices of all parts that there are."""
    parts = {part.part: part for part in outlet.of(c.MESH.name)}
    return np.concatenate([part.vertices for part in parts.values()])


def grid_from(outlet: KeptOutlet) -> Grid:
    """The grid as who has all messages knows it."""
    whole, cells = None, np.zeros((0, 0), np.int8)
    for grid in outlet.of("ggslam/grid"):
        if grid.at is None:
            whole, cells = grid, grid.cells.copy()
        else:
            (row, column), (height, width) = grid.at, grid.cells.shape
            cells[row : row + height, column : column + width] = grid.cells
    assert whole is not None
    return Grid(whole.frame, whole.T_frame_origin, whole.cell_m, cells)


def test_the_mesh_grows_where_it_changed_and_follows_a_correction(exact: ExactRoom) -> None:
    outlet = KeptOutlet()
    with growing(outlet) as (volumes, publisher):
        volumes.show(exact.views[:6], 1.0, FLOOR, exact.poses, 0.0)
        assert publisher.wait_idle(5.0)
        first = len(outlet.of(c.MESH.name))
        volumes.show(exact.views[:6], 1.0, FLOOR, exact.poses, 1.0)  # nothing is new
        assert publisher.wait_idle(5.0) and len(outlet.of(c.MESH.name)) == first > 3
        volumes.show(exact.views[:7], 1.0, FLOOR, exact.poses, 2.0)
        assert publisher.wait_idle(5.0)
        again = len(outlet.of(c.MESH.name)) - first
        assert again < first / 2
        volumes.show(exact.views, 1.0, FLOOR, exact.poses, 3.0, final=True)
        assert publisher.wait_idle(5.0) and volumes.fused == 24
        off = exact.surface.query(mesh_of(outlet))[0]
        assert np.median(off) < 0.005 and np.quantile(off, 0.8) < 0.025  # the rest: rims of 5 cm voxels
        moved = [PlacedKeyframe(v.keyframe, v.T_camera_world @ inverse(MOVE)) for v in exact.views]
        with overridden(LiveVolumesTuning, pass_s=0.0):  # a keyframe a pass: the mesh as it was is shown until then
            for _ in moved[1:]:
                before = len(outlet.of(c.MESH.name))
                volumes.show(moved, 1.0, FLOOR, exact.poses, 4.0)
                assert publisher.wait_idle(5.0) and len(outlet.of(c.MESH.name)) == before
            volumes.show(moved, 1.0, FLOOR, exact.poses, 5.0)
        assert publisher.wait_idle(5.0) and volumes.fused == 48
        off = exact.surface.query(transform_points(mesh_of(outlet).astype(float), inverse(MOVE)))[0]
        assert np.median(off) < 0.005 and np.quantile(off, 0.8) < 0.025  # the rest: rims of 5 cm voxels


def test_grids_come_whole_or_as_what_changed(exact: ExactRoom) -> None:
    outlet = KeptOutlet()
    with growing(outlet) as (volumes, publisher):
        for count in range(1, 25):
            volumes.show(exact.views[:count], 1.0, FLOOR if count > 1 else None, exact.poses, float(count))
            assert publisher.wait_idle(5.0)
            assert count > 1 or not outlet.of("ggslam/grid")
    fused = FusedKeyframes(1.0)
    fused.add(exact.views)
    expected = grid_of(layers_of(fused.field, FLOOR.T_floor_map, True), Robot())
    np.testing.assert_array_equal(grid_from(outlet).cells, expected.cells)
    parts = [grid for grid in outlet.of("ggslam/grid") if grid.at is not None]
    assert parts and all(part.cells.size <= expected.cells.size / 2 for part in parts)
    cut = outlet.of(c.DISTANCE.name)[-1]
    assert len(cut.xyz) > 500 and np.ptp(cut.xyz[:, 2]) < 1e-4


def test_nothing_is_fused_while_nobody_asks(exact: ExactRoom) -> None:
    with growing(KeptOutlet(everybody=0)) as (volumes, publisher):
        volumes.show(exact.views, 1.0, FLOOR, exact.poses, 0.0)
        assert volumes.fused == 0 and not publisher.newest(c.MESH)
        with pytest.raises(ConfigError, match="ask again"):
            volumes.query(np.zeros((1, 3)))
        volumes.show(exact.views[:3], 1.0, FLOOR, exact.poses, 0.0)
        assert volumes.fused == 3 and not publisher.newest(c.MESH)
        found = volumes.query(exact.surface.data[2000:2100])  # of the first view
        assert found.known.all() and np.abs(found.distance).max() < 0.06
        functions = LiveFunctions(publisher, Pause(), Path())
        functions.distances = volumes
        told = functions.query_distance({"points": [*exact.surface.data[2000:2002].tolist(), [50, 0, 0]]})
        assert told["distance"] == [*found.distance[:2].tolist(), None] and told["most_m"] > 0.5


def test_who_joins_gets_a_whole_grid_and_what_changed_since(exact: ExactRoom) -> None:
    outlet = KeptOutlet(everybody=0)
    outlet.heard = {"ggslam/grid": 1}
    publisher = MapPublisher([(outlet, False)], CHANNELS)
    volumes = GrowingVolumes(publisher, {"": Robot()})
    for count in range(2, 25):
        volumes.show(exact.views[:count], 1.0, FLOOR, exact.poses, float(count))
    assert publisher.wait_idle(5.0)
    outlet.sent.clear()
    outlet.join("ggslam/grid")
    until(lambda: outlet.sent)
    assert publisher.wait_idle(5.0)
    publisher.close()
    fused = FusedKeyframes(1.0)
    fused.add(exact.views)
    np.testing.assert_array_equal(
        grid_from(outlet).cells, grid_of(layers_of(fused.field, FLOOR.T_floor_map, True), Robot()).cells
    )


def test_a_run_shows_volumes_and_has_them_without_a_recording(room: Path, tmp_path: Path) -> None:
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], CHANNELS)
    few = ["mapping.iterations_per_frame=2", "refine_iterations=10"]
    recording = Path(copytree(room, tmp_path / "recording"))
    request = RunRequest(SequenceRequest(recording), out=tmp_path / "run", overrides=few, evaluate=False, check=False)
    with overridden(LiveContentsTuning, min_rest_s=0.0, map_share=10.0, image_share=10.0):
        contents = LiveContents(publisher, robots={"": Robot()})
        outcome = execute(request, follower=contents.follow)
        live = len(outlet.of(c.MESH.name))
        contents.finish(outcome.result)
    assert publisher.wait_idle(10.0)
    publisher.close()
    assert live > 0 and contents.volumes.fused >= len(outcome.result.keyframes)
    made = fuse_volumes(outcome.folder.path, tmp_path / "volumes", esdf=True, objects=False, voxel=0.05)
    assert made.error is None
    rmtree(recording)  # as that of a live camera, which is none
    alone = RunVolumes(outcome.folder, keyframes=contents.keyframe_volumes(outcome.result))
    kept = alone.grid("")
    np.testing.assert_array_equal(kept.cells, grid_from(outlet).cells)
    field = alone.field()
    (tmp_path / "volumes").rename(outcome.folder.path / "volumes")
    other = RunVolumes(outcome.folder).field()
    plane = floor_plane(other, alone.floor())  # the same cells, of all frames and of the keyframes
    few_views, all_views = (grid_of(HeightLayers(f, plane, 0.05), Robot()).cells for f in (field, other))
    both = (few_views >= 0) & (all_views >= 0)
    assert both.sum() > 1000 and (few_views == all_views)[both].mean() >= 0.99
    places = np.random.default_rng(0).uniform(-1, 1, (500, 3)) + [0, 0, 1.5]
    a, b = field.query(places), other.query(places)
    both = a.known & b.known
    assert both.sum() > 100 and np.median(np.abs(a.distance - b.distance)[both]) < 0.02
    (outcome.folder.path / "volumes").rename(tmp_path / "away")
    assert alone.mesh_parts() and len(alone.distance_slice(outcome.result.trajectory()).xyz) > 100
    alone.close()
    with pytest.raises(GgslamError, match="recording"):
        RunVolumes(outcome.folder).place()
