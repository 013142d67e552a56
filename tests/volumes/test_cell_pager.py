# SPDX-License-Identifier: Apache-2.0
"""A TSDF that is partly on disk is fused as one in memory, bit for bit, and follows its keyframes after corrections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paged_corridor import SETTINGS, corridor, fuse, views

from ggslam.scene.poses import se3_exp
from ggslam.volumes.cell_rebuild import StoredView
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.mesh import Mesh
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.tsdf_file import tsdf_to_bytes


@pytest.fixture(scope="module")
def seen() -> list[PosedView]:
    return views()


def triangles(mesh: Mesh) -> set[bytes]:
    corners = np.concatenate([mesh.vertices + 0.0, mesh.normals + 0.0], 1)
    return {row.tobytes() for row in corners[mesh.triangles]}


def assert_same_distances(a: np.ndarray, b: np.ndarray) -> None:
    """Each field holds its own surface points, within 1/16 voxel of the map's."""
    assert np.array_equal(np.isnan(a), np.isnan(b))
    assert np.nanmax(np.abs(a - b), initial=0) <= SETTINGS.tsdf.voxel / 8 + 1e-6


@pytest.mark.parametrize(("esdf", "decay_every"), [(False, 0), (False, 7), (True, 0)])
def test_what_was_on_disk_is_as_if_it_had_stayed(
    esdf: bool, decay_every: int, seen: list[PosedView], tmp_path: Path
) -> None:
    settings = replace(SETTINGS, decay_every=decay_every, esdf_every=5)
    whole = fuse(seen, None, settings, esdf)
    budget = 11_000_000 if esdf else 1_500_000
    paged = fuse(seen, Paging(tmp_path / "cells", lambda held: budget), settings, esdf)
    pager = paged.pager
    assert pager is not None and pager.written > 10 and (esdf or pager.read > 5) and len(pager) > 5
    assert pager.most_bytes <= budget < (13_000 if esdf else 5120) * whole.tsdf.dense_blocks
    assert len(list((tmp_path / "cells").iterdir())) == len(pager)
    paged.finish(), whole.finish()
    paged.save_tsdf(tmp_path / "tsdf.npz")
    assert (tmp_path / "tsdf.npz").read_bytes() == tsdf_to_bytes(whole.tsdf)
    assert paged.block_counts() == (len(whole.tsdf), whole.tsdf.dense_blocks)
    assert triangles(paged.mesh(20)) == triangles(whole.mesh(20))
    assert len(paged.tsdf) == 0 and pager.most_bytes <= budget  # files are made of what is on disk
    assert not esdf or (paged.field is not None and len(paged.field) == 0)
    pager._load(pager.keys())
    assert len(pager) == 0 and tsdf_to_bytes(paged.tsdf) == tsdf_to_bytes(whole.tsdf)
    if esdf:
        assert paged.field is not None and whole.field is not None
        paged.field.update()
        at = whole.field.coordinates()
        assert_same_distances(paged.field.read(at), whole.field.read(at))
        assert all("cells" in row for row in paged.times.rows)


def test_distances_around_the_camera_do_not_miss_what_is_on_disk(seen: list[PosedView], tmp_path: Path) -> None:
    """After every fifth view of the way back, where it stands: within the distance that the field reaches."""
    settings = replace(SETTINGS, esdf_every=1)
    maps, whole = VolumeMaps(settings, esdf=True), VolumeMaps(settings, esdf=True)
    maps.paging = Paging(tmp_path / "cells", lambda held: 4_000_000)
    for number, view in enumerate(seen):
        maps.add_together([view]), whole.add_together([view])
        if number % 5:
            continue
        assert maps.field is not None and whole.field is not None
        around = replace(view, depth=np.where(view.depth < 4.0, view.depth, 0)).points()[::50]
        found, expected = maps.field.query(around), whole.field.query(around)
        assert np.array_equal(found.known, expected.known)
        assert_same_distances(found.distance, expected.distance)
    assert maps.pager is not None and maps.pager.written > 5


def test_a_correction_moves_cells_with_their_keyframes(seen: list[PosedView], tmp_path: Path) -> None:
    """The way there was thought to bend; then the loop was closed. Cells of the way that are on disk are fused again
    where the keyframes are now."""
    drifted = [
        replace(view, T_world_camera=se3_exp(np.array([0, 0.01 * k, 0, 0, 0, 0.003 * k])) @ view.T_world_camera)
        for k, view in enumerate(seen[:27])
    ]
    stored = [StoredView(v.camera, v.T_world_camera, float(v.depth.max()), lambda v=v: v) for v in seen[:27]]
    paged = fuse(drifted, Paging(tmp_path / "cells", lambda held: 1_500_000))
    off = np.abs(corridor().distance(paged.mesh(20).vertices.astype(float)))
    assert np.median(off) > 0.02  # what it is about
    paged.rebuild(stored)
    assert len(paged.tsdf) == 0 and not list(tmp_path.glob("cells/*"))  # nothing is fused before it is needed
    whole = fuse(seen[:27])
    for view in seen[27:40]:
        paged.add_together([view]), whole.add_together([view])
        assert paged.pager is not None and paged.pager.most_bytes < 4_000_000
    paged.finish(), whole.finish()
    paged.save_tsdf(tmp_path / "tsdf.npz")
    assert (tmp_path / "tsdf.npz").read_bytes() == tsdf_to_bytes(whole.tsdf)
    off = np.abs(corridor().distance(paged.mesh(20).vertices.astype(float)))
    assert np.median(off) < 0.002 and np.percentile(off, 95) < 0.03  # metres, of voxels of 8 cm


def test_objects_on_disk_get_their_new_ids(seen: list[PosedView], tmp_path: Path) -> None:
    labelled = [replace(view, labels=np.where(view.depth < 2.5, 3, 7).astype(np.uint16)) for view in seen[:50]]
    table = np.arange(65536, dtype=np.uint16)
    table[3], table[7] = 9, 0
    paged, whole = fuse(labelled, Paging(tmp_path / "cells", lambda held: 1_500_000)), fuse(labelled)
    for maps in (paged, whole):
        maps.relabel(table)
        maps.finish()
    paged.save_tsdf(tmp_path / "tsdf.npz")
    assert whole.mesh().objects() == [9]
    assert (tmp_path / "tsdf.npz").read_bytes() == tsdf_to_bytes(whole.tsdf)


def test_nothing_goes_while_all_fits(seen: list[PosedView], tmp_path: Path) -> None:
    maps = fuse(seen[:20], Paging(tmp_path / "cells", lambda held: None))
    assert maps.pager is not None and maps.pager.written == 0 and not (tmp_path / "cells").exists()
