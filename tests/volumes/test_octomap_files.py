# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyoctomap_bridge
import pytest

from ggslam.errors import FormatError
from ggslam.volumes.occupancy import FREE, OCCUPIED, OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings, log_odds
from ggslam.volumes.octomap_files import (
    binary_octomap,
    decode_octomap,
    full_octomap,
    read_octomap,
    write_octomap,
)

HEADER = b"# Octomap OcTree binary file\nid OcTree\nsize %d\nres 0.1\ndata\n"
FULL_HEADER = b"# Octomap OcTree file\nid OcTree\nsize %d\nres 0.1\ndata\n"


def random_map(resolution: float = 0.1, scans: int = 4, seed: int = 0) -> OccupancyMap:
    random = np.random.default_rng(seed)
    occupancy = OccupancyMap(resolution)
    for _ in range(scans):
        directions = random.normal(size=(3000, 3))
        points = 2.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        occupancy.insert(points, random.uniform(-0.5, 0.5, 3))
    return occupancy


def leaves_of(tree: Any) -> dict[tuple[float, ...], tuple[float, bool]]:
    return {
        tuple(np.round(leaf.getCoordinate(), 4)): (round(leaf.getSize(), 4), tree.isNodeOccupied(leaf))
        for leaf in tree.begin_leafs()
    }


def test_full_files_keep_everything(tmp_path: Path) -> None:
    occupancy = random_map(1 / 3)
    write_octomap(occupancy, tmp_path / "map.ot")
    again = read_octomap(tmp_path / "map.ot")
    assert again.resolution == occupancy.resolution
    for before, after in zip(vars(occupancy.leaves()).values(), vars(again.leaves()).values(), strict=True):
        np.testing.assert_array_equal(before, after)
    assert full_octomap(again) == full_octomap(occupancy)


def test_binary_files_keep_the_states(tmp_path: Path) -> None:
    occupancy = random_map()
    write_octomap(occupancy, tmp_path / "map.bt")
    again = read_octomap(tmp_path / "map.bt")
    centers = occupancy.leaves().centers - 0.01
    np.testing.assert_array_equal(again.states(centers), occupancy.states(centers))
    before, after = occupancy.summary(), again.summary()
    assert (before.occupied, before.free) == (after.occupied, after.free)
    assert len(again.leaves().sizes) < len(centers)  # equal states of unequal values are one leaf
    assert set(np.unique(again.leaves().log_odds)) == {np.float32(log_odds(0.1192)), np.float32(log_odds(0.971))}
    assert binary_octomap(again) == binary_octomap(occupancy)


def test_a_building_from_elsewhere_is_written_as_it_was_read(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "clouds" / "geb079.bt"
    occupancy = read_octomap(source)
    write_octomap(occupancy, tmp_path / "copy.bt")
    assert (tmp_path / "copy.bt").read_bytes() == source.read_bytes()
    assert b"size 532566\n" in source.read_bytes()


def test_an_empty_map(tmp_path: Path) -> None:
    for name in ("map.bt", "map.ot"):
        write_octomap(OccupancyMap(0.1), tmp_path / name)
        assert b"size 0\n" in (tmp_path / name).read_bytes()
        assert read_octomap(tmp_path / name).summary().known_box is None


def test_huge_leaves_cost_nothing_and_can_be_updated() -> None:
    data = HEADER % 9 + bytes([0b01010101, 0b01100101])  # all of space free but the octant x < 0, y > 0, z > 0
    occupancy = decode_octomap(data, "space.bt")
    summary = occupancy.summary()
    assert (summary.free, summary.occupied, summary.blocks) == (7 * 2**45, 2**45, 0)
    assert binary_octomap(occupancy).split(b"data\n")[1] == data.split(b"data\n")[1]
    corners = 100.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    np.testing.assert_array_equal(corners[occupancy.states(corners) == OCCUPIED], [[-100, 100, 100]])
    for _ in range(3):
        occupancy.insert(np.array([[1.05, 1.05, 1.05]]), np.array([0.05, 0.05, 0.05]))
    assert occupancy.states(np.array([[1.05, 1.05, 1.05], [1.15, 1.05, 1.05]])).tolist() == [OCCUPIED, FREE]
    assert occupancy.summary().blocks < 4
    assert occupancy.summary().occupied == 2**45 + 1


def test_all_of_space_as_one_leaf() -> None:
    occupancy = decode_octomap(FULL_HEADER % 1 + np.float32(1.5).tobytes() + b"\0", "space.ot")
    assert occupancy.log_odds(np.array([[1.0, 2, 3]])) == 1.5
    assert decode_octomap(binary_octomap(occupancy), "again.bt").summary().occupied == 2**48
    assert decode_octomap(full_octomap(occupancy), "again.ot").summary().occupied == 2**48


@pytest.mark.parametrize("encode", [binary_octomap, full_octomap])
def test_cut_off_files_are_refused(encode: Any, tmp_path: Path) -> None:
    data = encode(random_map(0.4, scans=1))
    path = tmp_path / "cut.bt"
    for size in np.linspace(0, len(data) - 1, 120).astype(int):
        path.write_bytes(data[:size])
        with pytest.raises(FormatError, match=r"cut\.bt"):
            read_octomap(path)


@pytest.mark.parametrize("encode", [binary_octomap, full_octomap])
def test_damaged_files_are_refused_or_read_but_never_worse(encode: Any) -> None:
    random = np.random.default_rng(4)
    data = encode(random_map(0.4, scans=1))
    start, refused = data.index(b"data\n") + 5, 0
    for trial in range(400):
        damaged = bytearray(data)
        for _ in range(random.integers(1, 4)):
            damaged[random.integers(start if trial % 2 else 0, len(data))] = random.integers(256)
        try:
            occupancy = decode_octomap(bytes(damaged), "damaged")
        except FormatError as error:
            assert str(error).startswith("damaged: ")
            refused += 1
        else:
            decode_octomap(full_octomap(occupancy), "again")
    assert refused > 100


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "# Octomap OcTree"),
        (b"#OcTree legacy", "# Octomap OcTree"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize 1\nres 0.1\n", "'data'"),
        (HEADER.replace(b"OcTree\ns", b"ColorOcTree\ns") % 9 + b"UU", "ColorOcTree"),
        (HEADER.replace(b"0.1", b"nan") % 9 + b"UU", "res.*'nan'"),
        (HEADER.replace(b"0.1", b"-3") % 9 + b"UU", "res.* -3"),
        (HEADER.replace(b"0.1", b"1e300") % 9 + b"UU", "res.*1e300"),
        (HEADER.replace(b"0.1", b"ten") % 9 + b"UU", "res.*'ten'"),
        (HEADER.replace(b"res 0.1\n", b"") % 9 + b"UU", "'res'"),
        (HEADER.replace(b"%d", b"-9") + b"UU", "size.* -9"),
        (HEADER % 10**15 + b"UU", "1000000000000000.* 9$"),
        (HEADER % 9 + b"U", " 9 .* 1$"),
        (HEADER % 1 + b"\0\0", "no children"),
        (HEADER % 17 + b"\x03\0" * 17, "finest level"),
        (FULL_HEADER % 1 + b"\0\0\xc0\x7f\0", "finite"),
    ],
)
def test_wrong_files_are_refused_with_the_reason(data: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.bt"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=reason) as caught:
        read_octomap(path)
    assert "wrong.bt" in str(caught.value)


def test_maps_beyond_the_memory_allowed_are_refused() -> None:
    data = full_octomap(random_map())
    with pytest.raises(FormatError, match=r"map\.ot.*0\.0 GiB"):
        decode_octomap(data, "map.ot", memory_limit=20000)


def test_missing_files_and_other_endings(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"absent\.bt"):
        read_octomap(tmp_path / "absent.bt")
    with pytest.raises(FormatError, match=r"map\.ply.*\.bt.*\.ot"):
        write_octomap(OccupancyMap(0.1), tmp_path / "map.ply")


def test_octomap_reads_what_we_write(tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    occupancy = random_map()
    write_octomap(occupancy, tmp_path / "map.bt")
    write_octomap(occupancy, tmp_path / "map.ot")
    tree = pyoctomap.OcTree(0.5)
    assert tree.readBinary(str(tmp_path / "map.bt"))
    again = read_octomap(tmp_path / "map.bt").leaves()
    ours = {
        tuple(np.round(center.astype(float), 4)): (round(float(size), 4), value > 0)
        for center, size, value in zip(again.centers, again.sizes, again.log_odds, strict=True)
    }
    assert leaves_of(tree) == ours
    assert pyoctomap.OcTree(0.5).read(str(tmp_path / "map.ot")).write() == (tmp_path / "map.ot").read_bytes()


def test_we_read_what_octomap_writes(tmp_path: Path) -> None:
    pytest.importorskip("pyoctomap")
    tree = pyoctomap_bridge.to_octomap(random_map())
    tree.write(str(tmp_path / "map.ot"))
    assert full_octomap(read_octomap(tmp_path / "map.ot")) == tree.write()
    tree.writeBinary(str(tmp_path / "map.bt"))
    assert binary_octomap(read_octomap(tmp_path / "map.bt")) == (tmp_path / "map.bt").read_bytes()


@pytest.mark.parametrize("quantize", [True, False])
def test_insertion_into_an_octomap_tree(quantize: bool) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    random = np.random.default_rng(5)
    plain, batched, rebuilt = (pyoctomap.OcTree(0.1) for _ in range(3))
    for tree in (plain, batched, rebuilt):
        tree.setProbHit(0.8)
    for _ in range(4):
        points, origin = random.normal(0, 1.5, (2000, 3)).astype(np.float32), random.uniform(-0.5, 0.5, 3)
        origin = origin.astype(np.float32)
        plain.insertPointCloud(points.astype(float), origin.astype(float), max_range=2.0, discretize=quantize)
        pyoctomap_bridge.insert_batched(batched, points, origin, 2.0, quantize=quantize)
        rebuilt = pyoctomap_bridge.insert_rebuilding(rebuilt, points, origin, 2.0, quantize=quantize)
    assert batched.write() == plain.write()
    assert rebuilt.write() == plain.write()
    assert rebuilt.getProbHitLog() == plain.getProbHitLog()


def test_an_octomap_tree_carries_the_settings() -> None:
    pytest.importorskip("pyoctomap")
    settings = OccupancySettings.with_raised_odds()
    again = pyoctomap_bridge.from_octomap(pyoctomap_bridge.to_octomap(OccupancyMap(0.1, settings))).settings
    assert [log_odds(getattr(again, name)) for name in ("probability_hit", "probability_miss")] == [
        log_odds(0.85),
        log_odds(0.3),
    ]
