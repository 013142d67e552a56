# SPDX-License-Identifier: Apache-2.0
"""Nothing that is given to the compiled core ends the process: it is refused, or done within a budget of memory."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from ggslam.abi.core import (
    DECLARED,
    AlignPoints,
    AlignResult,
    AlignSettings,
    CoreFault,
    FusionInput,
    FusionSettings,
    FusionStats,
    InsertResult,
    OctreeSettings,
    RahtSettings,
)
from ggslam.errors import CoreInputError, CoreMemoryError, GgslamError, NativeCoreError
from ggslam.mapping.cpu.insertion import new_gaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

SOURCES = Path(__file__).parents[2] / "ggslam" / "native" / "src"
INT_MIN = -(2**31)
WITHOUT_SANITIZER = "GGSLAM_SANITIZER" not in os.environ
"""With one, memory and addresses are those of the sanitizer."""
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def wall(depth: float = 2.0, camera: Camera = CAMERA) -> np.ndarray:
    return np.full((camera.height, camera.width), depth, np.float32)


def pose_at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


# --- every entry is guarded ------------------------------------------------------------------------------------------

WITHOUT_GUARD = {"ggslam_abi_hash", "ggslam_structure_sizes", "ggslam_source_hash", "ggslam_last_error"}
"""They return constants, or what the guard noted."""


def test_every_function_of_the_core_catches_all_exceptions() -> None:
    found = set()
    for path in sorted(SOURCES.glob("*/*.cpp")):
        text = path.read_text()
        for match in re.finditer(r"^GGSLAM_EXPORT [^;{]*?\b(ggslam_\w+)\([^)]*\)([^{]*)\{", text, re.M):
            name, guard = match[1], match[2].strip()
            found.add(name)
            if name in WITHOUT_GUARD:
                continue
            end = text.index("\n}", match.end())
            assert guard == "try" and text[end:].startswith("\n} GGSLAM_CATCH_ALL\n"), f"{path.name}: {name}"
    assert found == set(DECLARED.functions)
    other = [p for p in SOURCES.rglob("*.?pp") if 'extern "C"' in p.read_text() or "std::thread(" in p.read_text()]
    assert not other, "functions and threads outside the guard"


def test_every_failure_is_told_by_the_result() -> None:
    results = {result for result, _ in DECLARED.functions.values()}
    told = {ctypes.c_void_p, ctypes.c_char_p, ctypes.c_double, ctypes.c_int32, ctypes.c_uint32, ctypes.c_int64,
            ctypes.c_uint64}  # fmt: skip
    assert results <= told


# --- what the guard says ---------------------------------------------------------------------------------------------


def test_null_pointers_are_refused() -> None:
    library = load_library()
    with pytest.raises(CoreInputError, match="ggslam_tsdf_size: .*null") as caught:
        library.ggslam_tsdf_size(None)
    assert caught.value.exit_code == 2 and isinstance(caught.value, ValueError)
    for function, arguments in [
        (library.ggslam_esdf_create, (None, 1.0)),
        (library.ggslam_rasterizer_create, (None,)),
        (library.ggslam_gpcc_leaves, (None,)),
        (library.ggslam_occupancy_leaves, (None, 0.0, 0)),
        (library.ggslam_gicp_target_size, (None, 0)),
        (library.ggslam_gpcc_plane_counts, (None, None, 0, None)),
    ]:
        with pytest.raises(CoreInputError, match="null"):
            function(*arguments)


def test_objects_that_are_not_ready_are_refused() -> None:
    library, context = load_library(), NativeContext(1)
    numbers = np.zeros(64)
    place = numbers.ctypes.data
    slice_, target = library.ggslam_gpcc_slice_create(), library.ggslam_gicp_target_create()
    raht, octree = RahtSettings(components=3, bit_depth=8, index=-1), OctreeSettings(depth=4)
    points = AlignPoints(place, place, place, place, None, 3)
    pose = np.eye(4)
    align = (context.handle, target, ctypes.byref(points), ctypes.byref(AlignSettings()))
    try:
        with pytest.raises(CoreInputError, match="depth: .*0.*4"):
            library.ggslam_gpcc_encode_geometry(context.handle, slice_, ctypes.byref(octree))
        with pytest.raises(CoreInputError, match="slice: .*octree"):
            library.ggslam_gpcc_encode_attribute(context.handle, slice_, ctypes.byref(raht), place)
        with pytest.raises(CoreInputError, match="slice: .*octree"):
            library.ggslam_gpcc_decode_attribute(context.handle, slice_, ctypes.byref(raht), place, 9, place)
        with pytest.raises(CoreInputError, match=r"points: .*2\^4"):
            library.ggslam_gpcc_build(context.handle, slice_, np.full(3, 16, np.int32).ctypes.data, 1, 4, place)
        with pytest.raises(CoreInputError, match="level: "):
            library.ggslam_gpcc_nodes(slice_, 0)
        with pytest.raises(CoreInputError, match="target: "):
            library.ggslam_gicp_align(*align, None, None, pose.ctypes.data, place, place, ctypes.byref(AlignResult()))
        with pytest.raises(CoreInputError, match="pose: "):
            bad = np.full(16, np.nan)
            library.ggslam_gicp_align(*align, None, None, bad.ctypes.data, place, place, ctypes.byref(AlignResult()))
    finally:
        library.ggslam_gpcc_slice_destroy(slice_)
        library.ggslam_gicp_target_destroy(target)


def test_arrays_that_are_nowhere_and_negative_sizes_are_refused() -> None:
    library, tsdf = load_library(), TsdfMap()
    with pytest.raises(CoreInputError, match="coordinates: .*7.*null"):
        library.ggslam_tsdf_write_free(tsdf.handle, 7, None, None)
    with pytest.raises(CoreInputError, match="coordinates: .*-1"):
        library.ggslam_tsdf_erase(tsdf.handle, -1, None)
    with pytest.raises(CoreInputError, match="expected the size of an array"):
        library.ggslam_quantize(tsdf.context.handle, 0.1, None, 2**62, None, None)


def test_an_error_is_told_once_and_to_its_thread() -> None:
    library = load_library()
    silent = ctypes.CDLL(library._name)
    silent.ggslam_tsdf_size.restype, silent.ggslam_tsdf_size.argtypes = ctypes.c_int64, [ctypes.c_void_p]
    message = ctypes.create_string_buffer(100)
    assert silent.ggslam_tsdf_size(None) == -1
    elsewhere: list[int] = []
    thread = threading.Thread(target=lambda: elsewhere.append(library.ggslam_last_error(None, 0)))
    thread.start(), thread.join()
    assert elsewhere == [CoreFault.NO_FAULT]
    assert library.ggslam_last_error(message, 20) == CoreFault.BAD_INPUT
    assert message.value == b"expected an object,"
    assert library.ggslam_last_error(message, 100) == CoreFault.NO_FAULT


def test_results_that_look_like_failures_are_none() -> None:
    """-1 is also an answer of some functions."""
    library, occupancy = load_library(), OccupancyMap(0.1)
    settings = occupancy.native_settings(np.array([1e9, 0, 0]), None)
    size = library.ggslam_occupancy_scan_keys(
        occupancy.context.handle, occupancy.handle, None, 0, ctypes.byref(settings), ctypes.byref(InsertResult())
    )
    assert size == -1


@pytest.mark.long("four million blocks are made until they are refused")
def test_threads_hand_on_what_they_throw() -> None:
    """Rays across the whole grid are refused by the thread that walks them; the pool goes on working."""
    occupancy = OccupancyMap(0.01, context=NativeContext(threads=4))
    directions = np.random.default_rng(0).normal(size=(20_000, 3)).astype(np.float32)
    far = 300 * directions / np.abs(directions).max(axis=1, keepdims=True)
    with pytest.raises(CoreInputError, match="4194304"):
        occupancy.insert(far, np.zeros(3))
    assert occupancy.summary().blocks == 0
    assert occupancy.insert(far, np.zeros(3), max_range=0.2).free > 0


def test_threads_share_a_pool() -> None:
    """Jobs of several threads take turns, the shortest too: each gets what it would get alone."""
    context = NativeContext(threads=4)
    images = [np.random.default_rng(k).integers(0, 255, (40 + k, 37, 3)).astype(np.uint8) for k in range(3)]

    def places(image: np.ndarray, context: NativeContext) -> list[bytes]:
        height, width = image.shape[:2]
        depth, camera = image[..., 0] / np.float32(100), Camera(width, height, 30.0, 30.0, width / 2, height / 2)
        new = new_gaussians(image, depth, camera, np.eye(4), None, InsertionSettings(), context)
        return [array.tobytes() for array in (new.means, new.log_scales, new.rgb, new.pixels)]

    with ThreadPoolExecutor(len(images)) as beside:
        found = list(beside.map(lambda k: places(images[k % 3], context), range(600)))
    alone = [places(image, NativeContext(threads=1)) for image in images]
    assert all(result == alone[k % 3] for k, result in enumerate(found))


# --- numbers that cannot be ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [INT_MIN, 2**31 - 1, 2**27 + 1])
def test_blocks_beyond_what_can_be_numbered_are_refused(at: int) -> None:
    tsdf = TsdfMap()
    coordinates = np.array([[0, 0, 0], [at, 0, 0]], np.int32)
    with pytest.raises(CoreInputError, match="coordinates: "):
        tsdf.write_free(coordinates, np.full(2, 100, np.uint16))
    with pytest.raises(CoreInputError, match="coordinates: "):
        tsdf.write(coordinates, weight=np.ones((2, 512), np.uint16))
    assert len(tsdf) == 0
    tsdf.erase(coordinates)  # there is nothing to erase
    assert not tsdf.read(coordinates).weight.any()


def test_the_farthest_blocks_have_a_distance_field() -> None:
    tsdf = TsdfMap()
    values = np.linspace(32767, -32767, 8).astype(np.int16).repeat(64)[None].repeat(2, 0)
    at = np.array([[2**27, -(2**27), 2**27], [-(2**27), 0, 5]])
    tsdf.write(at, value=values, weight=np.full((2, 512), 9, np.uint16))
    field = DistanceField(tsdf)
    stats = field.update()
    assert len(field) == 2 and stats.changed_sites == 128


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("camera fx", {"fx": 0.8}), ("camera fy", {"fy": float("nan")}), ("camera fx", {"fx": -500.0}),
        ("camera cx", {"cx": float("inf")}), ("camera cy", {"cy": 1e9}), ("camera width", {"width": -1}),
        ("camera height", {"height": 2**30}),
    ],
)  # fmt: skip
def test_impossible_cameras_are_refused(name: str, values: dict[str, float]) -> None:
    tsdf, depth = TsdfMap(), wall()
    view = FusionInput(
        depth.ctypes.data, None, None, 64, 48, 50, 50, 31.5, 23.5, tuple(np.eye(3).ravel()), (0.0, 0.0, 0.0)
    )
    for key, value in values.items():
        setattr(view, key, value)
    settings = FusionSettings(0.1, 7, 0.9, 0.04, 0.5, 1)
    with pytest.raises(CoreInputError, match=name):
        load_library().ggslam_tsdf_integrate(
            tsdf.handle, tsdf.context.handle, ctypes.byref(view), ctypes.byref(settings), ctypes.byref(FusionStats())
        )
    assert len(tsdf) == 0 and tsdf.revision == TsdfMap().revision


def test_impossible_poses_are_refused() -> None:
    tsdf, depth = TsdfMap(), wall()
    for rotation, translation in [
        (np.zeros(9), np.zeros(3)), (np.full(9, np.nan), np.zeros(3)), (np.eye(3).ravel(), np.array([0, np.inf, 0])),
        (np.eye(3).ravel(), np.array([0, 1e12, 0])),
    ]:  # fmt: skip
        view = FusionInput(
            depth.ctypes.data, None, None, 64, 48, 50, 50, 31.5, 23.5, tuple(rotation), tuple(translation)
        )
        settings = FusionSettings(0.1, 7, 0.9, 0.04, 0.5, 1)
        with pytest.raises(CoreInputError, match=r"pose: |position: "):
            load_library().ggslam_tsdf_integrate(
                tsdf.handle, tsdf.context.handle, ctypes.byref(view), ctypes.byref(settings),
                ctypes.byref(FusionStats()),
            )  # fmt: skip


@pytest.mark.parametrize("threads", [0, -1, 10**6])
def test_impossible_numbers_of_threads_are_refused(threads: int) -> None:
    with pytest.raises(GgslamError):
        NativeContext(threads)


def test_points_that_are_no_numbers_have_grid_coordinates() -> None:
    from ggslam.abi.core import Grid, Points

    points = np.array([[np.nan, np.inf, -np.inf], [1.0, 2.0, 3.0]])
    out = np.full((2, 3), -7, np.int32)
    grid = Grid(1.0, 0.0, (0, 0, 0), (10, 10, 10), 0)
    what = Points(points.ctypes.data, None, 2, 3)
    load_library().ggslam_gpcc_on_grid(ctypes.byref(what), ctypes.byref(grid), out.ctypes.data)
    assert out.tolist() == [[0, 10, 0], [1, 2, 3]]


# --- distances between things ----------------------------------------------------------------------------------------

LIMITED = """
import os, resource, sys, time
if "GGSLAM_SANITIZER" not in os.environ:  # which takes terabytes of addresses
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
import numpy as np
from ggslam.errors import GgslamError
from ggslam.scene.camera import Camera
from ggslam.system.process_memory import peak_memory_bytes
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
def pose_at(x):
    T = np.eye(4)
    T[0, 3] = x
    return T
depth = np.full((480, 640), 3.0, np.float32)
good = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
before = peak_memory_bytes()
try:
{body}
except GgslamError as error:
    print("refused:", error)
print("MB:", (peak_memory_bytes() - before) // 1_000_000)
"""


def limited(body: str) -> str:
    """What a process of at most 6 GB prints that does this."""
    text = LIMITED.replace("{body}", "\n".join(f"    {line}" for line in body.strip().splitlines()))
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(SOURCES.parents[2])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.long("a process of its own, which must not abort")
def test_a_pose_100_km_off_takes_no_more_memory_than_one_nearby() -> None:
    said = limited(
        """
tsdf = TsdfMap(TsdfSettings(voxel=0.02))
tsdf.integrate(depth, good, pose_at(0))
tsdf.integrate(depth, good, pose_at(1e5))
field = DistanceField(tsdf)
field.update()
print(field.query(np.array([[0, 0, 2.5], [1e5, 0, 2.5], [5e4, 0, 2.5]])))
"""
    )
    assert "refused" not in said and "known=array([ True,  True, False])" in said
    assert not WITHOUT_SANITIZER or int(said.split("MB:")[1]) < 300


def test_a_field_of_far_parts_is_that_of_each_part() -> None:
    settings = TsdfSettings(voxel=0.05)
    both, alone = TsdfMap(settings), TsdfMap(settings)
    both.integrate(wall(), CAMERA, pose_at(0))
    both.integrate(wall(), CAMERA, pose_at(50_000))  # whole blocks
    alone.integrate(wall(), CAMERA, pose_at(0))
    fields = DistanceField(both, FieldSettings(1.0)), DistanceField(alone, FieldSettings(1.0))
    for field in fields:
        field.update()
    at = fields[1].coordinates()
    np.testing.assert_array_equal(fields[0].read(at), fields[1].read(at))
    # A change in one part after the other has been computed: only what is near is computed anew.
    both.integrate(wall(1.5), CAMERA, pose_at(0)), alone.integrate(wall(1.5), CAMERA, pose_at(0))
    updates = [field.update() for field in fields]
    assert updates[0].recomputed_blocks == updates[1].recomputed_blocks < len(fields[0])
    at = fields[1].coordinates()
    np.testing.assert_array_equal(fields[0].read(at), fields[1].read(at))


@pytest.mark.long("a process of its own, which must not abort")
def test_blocks_250_m_apart_are_a_matter_of_a_moment() -> None:
    said = limited(
        """
tsdf = TsdfMap(TsdfSettings(voxel=0.02))
ramp = np.linspace(32767, -32767, 8).astype(np.int16).repeat(64)[None].repeat(3, 0)
apart = round(250 / 0.16)
at = np.array([[0, 0, 0], [apart, apart, 0], [0, apart, apart]])
tsdf.write(at, value=ramp, weight=np.full((3, 512), 900, np.uint16))
field = DistanceField(tsdf)
field.update()
field = None
start = time.process_time()
field = DistanceField(tsdf)
print(field.update().changed_sites)
assert time.process_time() - start < 2, time.process_time() - start
"""
    )
    assert said.startswith("192") and (not WITHOUT_SANITIZER or int(said.split("MB:")[1]) < 200)


@pytest.mark.long("a process of its own, which must not abort")
@pytest.mark.parametrize(
    ("camera", "reason"),
    [("640, 480, 0.8, 1.07, 0.5, 0.5", "camera fx"), ("640, 480, 13.0, 13.0, 319.5, 239.5", "more than"),
     ("640, 480, 500.0, 500.0, 1e7, 239.5", "camera cx")],
)  # fmt: skip
def test_cameras_that_would_carve_without_end_are_refused(camera: str, reason: str) -> None:
    said = limited(
        f"""
try:
    TsdfMap(TsdfSettings(voxel=0.01)).integrate(depth, Camera({camera}), pose_at(0))
except GgslamError as error:
    print("refused:", error)
OccupancyMap(0.003).insert_depth(depth, Camera({camera}), pose_at(0))
"""
    )
    assert said.count("refused") == 2 and reason in said, said
    assert not WITHOUT_SANITIZER or int(said.split("MB:")[1]) < 1500


@pytest.mark.long("a process of its own, which must not abort")
def test_a_principal_point_far_outside_takes_no_more_than_its_budget() -> None:
    said = limited(
        """
TsdfMap(TsdfSettings(voxel=0.01)).integrate(depth, Camera(640, 480, 500.0, 500.0, 3e5, 239.5), pose_at(0))
OccupancyMap(0.01).insert_depth(depth, Camera(640, 480, 500.0, 500.0, 3e5, 239.5), pose_at(0))
"""
    )
    assert "refused" in said or int(said.split("MB:")[1]) < 1500 or not WITHOUT_SANITIZER


@pytest.mark.skipif(not WITHOUT_SANITIZER, reason="sanitizers end the process where memory runs out")
def test_memory_that_ran_out_is_an_error_of_ours() -> None:
    """More codes than there is memory for: nothing is written, the process goes on."""
    library, context = load_library(), NativeContext(1)
    points = np.zeros((1, 3), np.float32)
    keys = np.zeros((1, 3), np.uint16)
    with pytest.raises(CoreMemoryError, match="ggslam_quantize: .*memory") as caught:
        library.ggslam_quantize(context.handle, 0.1, points.ctypes.data, 2**44, keys.ctypes.data, None)
    assert isinstance(caught.value, NativeCoreError | MemoryError) and caught.value.exit_code == 1
