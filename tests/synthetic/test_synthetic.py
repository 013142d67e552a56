# SPDX-License-Identifier: Apache-2.0
"""The generated recording: geometry held against plain calculations, exact poses and masks, repeatability."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.sequences import inspect_sequence, open_sequence
from ggslam.synthetic import RayCaster, Scene, SceneBuilder, camera_path, furnished_room, lighting
from ggslam.synthetic.layouts import LAYOUTS, depth_units
from ggslam.synthetic.materials import MaterialMaker
from ggslam.synthetic.scene import FACES, Kind, Shape
from ggslam.synthetic.sensor import noisy_depth
from ggslam.synthetic.surfaces import intersect, locate, surface_points
from ggslam.synthetic.writer import write_synthetic_sequence

MAKE = MaterialMaker(np.random.default_rng(0))
PLAIN = MAKE.plain((0.5, 0.5, 0.5))
CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)


@pytest.fixture(scope="module")
def room() -> Scene:
    return furnished_room(0)


@pytest.fixture(scope="module")
def caster(room: Scene) -> RayCaster:
    return RayCaster(room)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "room"
    return write_synthetic_sequence(folder, frames=6, width=64, height=48, scene=small_scene())


def small_scene() -> Scene:
    b = SceneBuilder()
    b.instance("floor").box((0, 0, -0.05), (4, 4, 0.1), MAKE.checker((0.9, 0.9, 0.9), (0.2, 0.2, 0.2)))
    b.instance("wall").box((0, 2.05, 1), (4, 0.1, 2.2), PLAIN)
    b.instance("ball").ellipsoid((0, 1.2, 0.3), (0.3, 0.3, 0.3), PLAIN)
    b.light(np.array([[0.0, 0.0, 2.0]]), (3, 3, 3))
    b.scene.walk, b.scene.interest = ((0.0, -1.2, 0.8), (0.3, 0.2)), np.array([[0.0, 1.5, 0.4]])
    return b.scene


def shape(kind: Kind, top: float = 1.0) -> Shape:
    half = {Kind.BOX: (0.5, 0.3, 0.2), Kind.ELLIPSOID: (0.5, 0.3, 0.2), Kind.FRUSTUM: (0.4, 0.4, 0.3)}[kind]
    return Shape(kind, half, np.eye(4), PLAIN, 1, top=top)


def is_inside(s: Shape, points: np.ndarray) -> np.ndarray:
    q = np.abs(points) / np.array(s.half)
    if s.kind == Kind.BOX:
        return (q < 1).all(1)
    if s.kind == Kind.ELLIPSOID:
        return (q**2).sum(1) < 1
    radius = s.half[0] * (1 + (s.top - 1) * (1 + points[:, 2] / s.half[2]) / 2)
    return (np.hypot(points[:, 0], points[:, 1]) < radius) & (q[:, 2] < 1)


@pytest.mark.parametrize(
    ("kind", "top"),
    [(Kind.BOX, 1.0), (Kind.ELLIPSOID, 1.0), (Kind.FRUSTUM, 1.0), (Kind.FRUSTUM, 0.5), (Kind.FRUSTUM, 1.7)],
)
def test_rays_enter_where_marching_says(kind: Kind, top: float) -> None:
    rng = np.random.default_rng(3)
    s = shape(kind, top)
    origin = rng.standard_normal((400, 3))
    origin *= 2 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.uniform(-0.4, 0.4, (400, 3)) - origin
    t = intersect(s, tuple(origin.T.astype(np.float32)), tuple(direction.T.astype(np.float32)))
    steps = np.linspace(0, 2.5, 2501)
    points = origin[:, None] + steps[None, :, None] * direction[:, None]
    inside = is_inside(s, points.reshape(-1, 3)).reshape(400, -1)
    first = np.where(inside.any(1), steps[inside.argmax(1)], np.inf)
    hit = np.isfinite(first)
    assert hit.sum() > 100
    assert (np.isfinite(t) == hit).mean() > 0.985  # grazing rays pass between the steps
    both = hit & np.isfinite(t)
    error = np.abs(t[both] - first[both])
    assert error.max() < 0.03 and np.median(error) < 1.1e-3


@pytest.mark.parametrize(("kind", "top"), [(Kind.BOX, 1.0), (Kind.ELLIPSOID, 1.0), (Kind.FRUSTUM, 0.6)])
def test_face_coordinates_return(kind: Kind, top: float) -> None:
    s = shape(kind, top)
    v, u = np.mgrid[0.35:0.7:5j, 0.3:0.7:6j].reshape(2, -1)
    for face in range(FACES[kind]):
        points, normals = surface_points(s, face, u, v)
        n = len(points)
        found, a, b, normal = locate(
            kind, points.astype(np.float32), np.tile(np.float32(s.half), (n, 1)), np.full(n, top, np.float32)
        )
        assert (found == face).all()
        np.testing.assert_allclose(np.stack([a, b]), np.stack([u, v]), atol=1e-5)
        np.testing.assert_allclose(normal / np.linalg.norm(normal, axis=1, keepdims=True), normals, atol=1e-5)
        assert (is_inside(s, points - 1e-4 * normals) & ~is_inside(s, points + 1e-4 * normals)).all()


def test_depth_and_mask_of_a_known_scene() -> None:
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along +y, z up
    T[:3, 3] = (0, -1, 0.3)
    images = RayCaster(small_scene()).render(CAMERA, T)
    u, v = 40, 30
    assert images.mask[v, u] == 3 and images.depth[v, u] == pytest.approx(1.9, abs=2e-3)
    assert images.mask[5, 40] == 2 and images.depth[5, 40] == pytest.approx(3.0, abs=1e-4)
    assert images.mask[58, 40] == 1 and images.depth[58, 40] == pytest.approx(0.3 * 60 / (58 - 29.5), rel=1e-4)
    assert images.color.dtype == np.uint8 and images.color[5, 40].min() > 0


def test_views_agree_with_one_another(room: Scene, caster: RayCaster) -> None:
    """Points of one view fall on the same depth, instance and colour in another."""
    poses = camera_path(room, 60)
    a, b = caster.render(CAMERA, poses[0]), caster.render(CAMERA, poses[4])
    assert (a.depth > 0).all()
    points = CAMERA.back_project(a.depth).reshape(-1, 3)
    T = inverse(poses[4]) @ poses[0]
    points = points @ T[:3, :3].T + T[:3, 3]
    u = np.rint(CAMERA.fx * points[:, 0] / points[:, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * points[:, 1] / points[:, 2] + CAMERA.cy).astype(int)
    inside = (u >= 0) & (u < 80) & (v >= 0) & (v < 60)
    seen = b.depth[v[inside], u[inside]]
    error = np.abs(seen - points[inside, 2]) / seen
    assert np.median(error) < 0.005 and (error < 0.03).mean() > 0.9
    assert (b.mask[v[inside], u[inside]] == a.mask.ravel()[inside]).mean() > 0.93
    difference = b.color[v[inside], u[inside]].astype(int) - a.color.reshape(-1, 3)[inside]
    assert np.median(np.abs(difference)) < 8


def test_room_is_furnished_and_free_to_walk(room: Scene) -> None:
    assert len(set(room.instance_names.values())) >= 30
    for trajectory in ("loop", "round", "pan"):
        poses = camera_path(room, 240, trajectory)
        assert all(s.distance(poses[:, :3, 3]).min() > 0.17 for s in room.shapes)
        step = inverse(poses[:-1]) @ poses[1:]
        assert np.linalg.norm(step[:, :3, 3], axis=1).max() < 0.06
        turn = np.arccos(np.clip((np.trace(step[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
        assert np.degrees(turn).max() < 3
    loop = camera_path(room, 60)
    assert np.linalg.norm(loop[-1, :3, 3] - loop[0, :3, 3]) < 0.06  # the end meets the beginning


def test_light_and_shadow() -> None:
    """The floor is darker under the ball than in the open."""
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, -0.8, 0.6], [0, -0.6, -0.8]]
    T[:3, 3] = (0.8, 0.0, 1.6)
    b = SceneBuilder()
    b.instance("floor").box((0, 0, -0.05), (6, 6, 0.1), PLAIN)
    b.instance("ball").ellipsoid((0, 0.8, 0.5), (0.3, 0.3, 0.3), PLAIN)
    b.light(np.array([[0.0, 0.8, 2.5]]), (3, 3, 3))
    images = RayCaster(b.scene).render(Camera(160, 120, 90, 90, 79.5, 59.5), T)
    point = inverse(T) @ np.array([[0.0, 0.8, 0, 1], [0.8, 1.6, 0, 1]]).T
    u, v = np.rint(90 * point[0] / point[2] + 79.5).astype(int), np.rint(90 * point[1] / point[2] + 59.5).astype(int)
    floor = images.color[images.mask == 1].astype(int).sum(1)
    assert images.mask[v[1], u[1]] == 1 and images.color[v[1], u[1]].astype(int).sum() > 1.5 * floor.min()


def test_shapes_that_are_not_looked_at_hide_no_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """The maps are to the bit those for which every shape is looked at from every patch."""
    rng, b = np.random.default_rng(1), SceneBuilder()
    b.instance("floor").box((0, 0, -0.05), (4, 4, 0.1), PLAIN)
    b.instance("wall").box((0, 2.05, 1), (4, 0.1, 2.2), PLAIN)
    for i in range(9):
        size, place = rng.uniform(0.1, 0.8, 3), rng.uniform((-1.5, -1.5, 0.1), (1.5, 1.9, 1.5))
        one = b.instance(f"{i}", tuple(place), rng.uniform(0, 90))
        if i % 3 == 0:
            one.box((0, 0, 0), tuple(size), PLAIN, tuple(rng.uniform(0, 90, 3)))
        elif i % 3 == 1:
            one.ellipsoid((0, 0, 0), tuple(size / 2), PLAIN)
        else:
            one.cylinder((0, 0, 0), size[0] / 2, size[2], PLAIN, tuple(rng.uniform(0, 90, 3)), top=rng.uniform(0.3, 2))
    b.light(rng.uniform((-1, -1, 2), (0, 0, 2.2), (4, 3)), (3, 3, 3))
    b.light(rng.uniform((1, 0.5, 0.4), (1.2, 0.8, 0.5), (3, 3)), (1, 1, 1), (-1.0, 0.0, 0.0))
    found = lighting.bake(b.scene).atlas

    def all_others(patches: lighting._Patches, number: int, shape: Shape, *_: object) -> np.ndarray:
        return np.nonzero(patches.owner != number)[0]

    monkeypatch.setattr(lighting._Patches, "near", all_others)
    monkeypatch.setattr(lighting._Patches, "shadow_candidates", all_others)
    every = lighting.bake(b.scene).atlas
    assert found.tobytes() == every.tobytes() and len(np.unique(every)) > 1000


def test_noise_of_the_sensor() -> None:
    z = np.full((120, 160), 2.0, np.float32)
    z[:, 80:] = 3.0
    noisy = noisy_depth(z, Camera(160, 120, 120, 120, 79.5, 59.5), np.random.default_rng(0))
    flat = noisy[:, :70]
    assert 0.97 < (flat > 0).mean() < 1
    sigma = 0.0012 + 0.0019 * 1.6**2
    assert flat[flat > 0].std() == pytest.approx(np.hypot(sigma, 0.00287 * 4 / np.sqrt(12)), rel=0.1)
    assert (noisy[:, 79:81] > 0).mean() < 0.5  # holes at the edge
    assert len(np.unique(flat)) < 20  # whole disparity steps


def test_written_recording(recording: Path) -> None:
    sequence = open_sequence(recording)
    assert (sequence.format, len(sequence), sequence.has_masks) == ("synthetic", 6, True)
    assert sequence.instance_names == {1: "floor", 2: "wall", 3: "ball"}
    assert sequence.camera == Camera(64, 48, 48.0, 48.0, 31.5, 23.5)
    report = inspect_sequence(sequence)
    assert report.posed_frames == 6 and report.pose_depth_error is not None and report.pose_depth_error < 0.02
    assert {p.name for p in recording.iterdir()} == {"rgb", "depth", "masks", "camera.yaml", "poses.txt"}
    assert [p.name for p in recording.parent.iterdir()] == ["room"]


def test_recording_repeats(recording: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    again = write_synthetic_sequence(
        tmp_path / "again",
        frames=6,
        width=64,
        height=48,
        scene=small_scene(),
        progress=lambda i, n: calls.append((i, n)),
    )
    assert calls == [(i + 1, 6) for i in range(6)]
    for name in ("depth/000003.png", "masks/000003.png", "poses.txt", "camera.yaml"):
        assert (again / name).read_bytes() == (recording / name).read_bytes()
    other = write_synthetic_sequence(tmp_path / "other", frames=6, width=64, height=48, scene=small_scene(), seed=1)
    assert (other / "depth/000003.png").read_bytes() != (recording / "depth/000003.png").read_bytes()


def test_refusals(tmp_path: Path, recording: Path) -> None:
    def write(folder: Path, **options: object) -> None:
        write_synthetic_sequence(folder, width=32, height=24, scene=small_scene(), **options)  # type: ignore[arg-type]

    with pytest.raises(SequenceError, match="loop, round, pan, route, walk, turns, still.*'fly'"):
        write(tmp_path / "a", trajectory="fly")
    with pytest.raises(SequenceError, match="frames: .*2.* 1"):
        write(tmp_path / "a", frames=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    with pytest.raises(SequenceError, match="full: "):
        write(tmp_path / "full", overwrite=True)
    assert (tmp_path / "full" / "letter.txt").exists()
    with pytest.raises(SequenceError, match="holds a generated recording already"):
        write(recording)
    small = tmp_path / "small"
    write(small, frames=3)
    write(small, frames=2, overwrite=True)
    assert len(open_sequence(small)) == 2

    def stop(done: int, count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "broken", frames=3, progress=stop)

    def fill(done: int, count: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(SequenceError, match="broken: .*No space left on device") as failure:
        write(tmp_path / "broken", frames=3, progress=fill)
    assert failure.value.exit_code == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full", "small"]  # nothing half-written


def test_replicas_layout_is_read_as_replica_and_holds_the_scene(tmp_path: Path) -> None:
    scene = small_scene()
    folder = write_synthetic_sequence(tmp_path / "room0", frames=3, width=120, height=68, scene=scene, noise=False,
                                      layout="replica")  # fmt: skip
    assert {path.name for path in folder.iterdir()} == {"results", "semantic_instance", "traj.txt", "cam_params.json"}
    sequence = open_sequence(folder)
    assert sequence.format == "replica"
    assert sequence.camera == Camera(120, 68, 60.0, 60.0, 59.5, 33.5)
    caster, poses = RayCaster(scene), camera_path(scene, 3, "loop", 0)
    for frame, pose in zip(sequence, poses, strict=True):
        exact = caster.render(sequence.camera, pose)
        assert frame.T_world_camera is not None and frame.mask is not None
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-10)
        np.testing.assert_allclose(frame.depth, exact.depth, atol=0.51 / 6553.5)
        np.testing.assert_array_equal(frame.mask, exact.mask)
        assert np.sqrt(np.mean((frame.color.astype(float) - exact.color) ** 2)) < 4  # JPEG


def test_replicas_layout_is_replaced_only_where_it_was_generated(tmp_path: Path) -> None:
    folder = tmp_path / "room0"
    for seed in (0, 1):
        write_synthetic_sequence(folder, frames=2, width=32, height=24, seed=seed, scene=small_scene(),
                                 layout="replica", overwrite=True)  # fmt: skip
    (folder / "cam_params.json").write_text('{"camera": {}}')
    with pytest.raises(SequenceError, match="not empty"):
        write_synthetic_sequence(folder, frames=2, layout="replica", overwrite=True)
    with pytest.raises(SequenceError, match="layout: expected one of plain, replica, found 'tum'"):
        write_synthetic_sequence(tmp_path / "other", layout="tum")


def test_depth_that_the_numbers_do_not_reach_is_none() -> None:
    for layout in LAYOUTS.values():
        most = 65535 / layout.depth_scale
        units = depth_units(np.array([0.0, 1.0, most, most + 0.01, 1e6], np.float32), layout.depth_scale)
        assert units.tolist() == [0, round(layout.depth_scale), 65535, 0, 0]
