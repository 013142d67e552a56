# SPDX-License-Identifier: Apache-2.0
"""OctoMap files of `ggslam volumes`: as the format is described (octomap_trees.py), and through OctoMap's own programs
where they are (Debian: octomap-tools)."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_line import succeed
from octomap_trees import Tree, read_tree
from scipy.spatial import cKDTree

from ggslam.runs.folder import RunFolder
from ggslam.sequences import open_sequence

VOXEL = 0.1


@pytest.fixture(scope="module")
def volumes(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("octomap") / "volumes"
    succeed("volumes", room_run.path, "--out", out, "--voxel", 0.08, "--occupancy", VOXEL, "--scale", 0.5)
    return out


def tool(name: str, *words: object) -> str:
    """What one of OctoMap's programs says."""
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not there (Debian: octomap-tools)")
    done = subprocess.run([name, *map(str, words)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def check_same(one: Tree, other: Tree) -> None:
    one, other = one.sorted(), other.sorted()
    assert one.resolution == other.resolution
    np.testing.assert_array_equal(one.levels, other.levels)
    np.testing.assert_array_equal(one.corners, other.corners)
    np.testing.assert_allclose(one.values, other.values, rtol=1e-6)


def test_both_files_say_the_same_of_every_place(volumes: Path) -> None:
    states, values = read_tree(volumes / "occupancy.bt"), read_tree(volumes / "occupancy.ot")
    assert states.resolution == values.resolution == VOXEL
    assert (values.values > 0).sum() > 500 and (values.values < 0).sum() > 2000
    np.testing.assert_array_equal(states.values_at(values.centers()) > 0, values.values > 0)
    volume = [(tree.sizes() ** 3).sum() for tree in (states, values)]
    assert volume[0] == pytest.approx(volume[1])


def test_what_the_camera_saw_is_occupied_and_what_lies_before_it_free(
    volumes: Path, room: Path, room_run: RunFolder
) -> None:
    tree, sequence = read_tree(volumes / "occupancy.bt"), open_sequence(room)
    camera, hits, free = sequence.camera, [], []
    for index, T in room_run.keyframes().poses().items():
        depth = sequence.frame(index).depth
        row, column = (values[::53] for values in np.nonzero((depth > 0) & (depth < 3)))
        z = depth[row, column].astype(float)
        points = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], 1)
        hits.append(tree.values_at(points @ T[:3, :3].T + T[:3, 3]))
        free.append(tree.values_at(0.7 * points @ T[:3, :3].T + T[:3, 3]))
    assert (np.concatenate(hits) > 0).mean() > 0.9
    assert (np.concatenate(free) < 0).mean() > 0.9


@pytest.mark.parametrize(("ours", "theirs"), [("bt", "bt"), ("ot", "ot"), ("ot", "bt")])
def test_octomap_converts_them(volumes: Path, tmp_path: Path, ours: str, theirs: str) -> None:
    tool("convert_octree", volumes / f"occupancy.{ours}", tmp_path / f"theirs.{theirs}")
    check_same(read_tree(tmp_path / f"theirs.{theirs}"), read_tree(volumes / f"occupancy.{theirs}"))


def test_octomap_says_that_a_map_and_its_copy_are_the_same(volumes: Path, tmp_path: Path) -> None:
    tool("convert_octree", volumes / "occupancy.ot", tmp_path / "copy.ot")
    said = tool("compare_octrees", volumes / "occupancy.ot", tmp_path / "copy.ot")
    assert float(re.findall(r"KLD.*?([-+.\deE]+)\s*$", said, re.MULTILINE)[-1]) == pytest.approx(0, abs=1e-9)


def test_octomap_lists_the_occupied_voxels(volumes: Path, tmp_path: Path) -> None:
    """As boxes of VRML, one for each leaf."""
    shutil.copyfile(volumes / "occupancy.bt", tmp_path / "map.bt")
    tool("bt2vrml", tmp_path / "map.bt")
    text = (tmp_path / "map.bt.wrl").read_text()
    boxes = np.array(re.findall(r"size (\S+) \S+ \S+ }", text), float)
    places = np.array(re.findall(r"translation (\S+) (\S+) (\S+)", text), float)
    tree = read_tree(volumes / "occupancy.bt")
    occupied = tree.values > 0
    rows = cKDTree(places).query(tree.centers()[occupied])
    assert len(places) == len(boxes) == occupied.sum() == len(np.unique(rows[1])) and rows[0].max() < 1e-4
    np.testing.assert_allclose(boxes[rows[1]], tree.sizes()[occupied], rtol=1e-5)
